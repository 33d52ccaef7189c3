"""Helpers of all experiments: command lines, tables, timing and random wheels."""
