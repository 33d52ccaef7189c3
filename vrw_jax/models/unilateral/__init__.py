"""Unilateral contact: one-sided contacts with friction, and stoppers that may be one-sided."""
