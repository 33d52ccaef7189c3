"""`python -m vrw_jax` is `vrw`."""

from vrw_jax.app import main

main()
