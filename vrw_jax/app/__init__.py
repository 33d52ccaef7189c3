"""Figures, command line, tables of the paper and web page."""
