"""Command line that reads configs and writes reports."""

from vrw_jax.cli import commands, config, scanning
from vrw_jax.cli.commands import main
