"""Measures to a given tolerance: claimed errors, true errors and costs."""
