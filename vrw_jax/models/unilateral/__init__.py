"""Real ground: one-sided contacts with friction, and stoppers that may let go."""
