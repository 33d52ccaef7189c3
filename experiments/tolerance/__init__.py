"""Answers to within a tolerance: what they claim, what is true, what they cost."""
