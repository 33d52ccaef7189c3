"""Entry point of `python -m vrw_jax`, which is the command `vrw`."""

from vrw_jax.app.commands import main

main()
