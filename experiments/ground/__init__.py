"""The wheel on real ground, and what the rungs below it miss."""
