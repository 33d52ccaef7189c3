"""The command line: reads configurations and writes reports."""

from vrw_jax.app.cli import main
