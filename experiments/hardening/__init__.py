"""Hardening: damaged files, and random calls of the public functions."""
