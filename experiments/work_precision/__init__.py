"""Measure work against precision of every engine and of other programs."""
