"""The walkers of the gallery."""
