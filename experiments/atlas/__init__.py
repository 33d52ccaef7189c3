"""Where methods fail: stiffness, events, borders of derivatives, long walks, formulations."""
