"""The command line: configurations in, reports out."""

from vrw_jax.app.cli import main
