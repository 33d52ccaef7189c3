"""The command line: configurations in, reports out."""

from vrw_jax.cli import commands, config, scanning
from vrw_jax.cli.commands import main
