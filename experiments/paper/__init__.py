"""Draw the figures of the paper from computed gaits."""
