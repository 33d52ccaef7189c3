"""`python -m vrw_jax` is `vrw`."""

from vrw_jax.cli import main

main()
