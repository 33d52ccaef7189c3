"""Peers that want a Python of their own: each prints its answers as JSON."""
