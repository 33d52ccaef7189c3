"""Measure the cost of steps, cycles, scans and compilation, also against other programs and
commits."""
