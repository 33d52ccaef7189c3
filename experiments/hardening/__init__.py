"""Test the library with damaged files and with random calls of the public functions."""
