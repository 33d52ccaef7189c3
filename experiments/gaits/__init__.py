"""Which gaits there are: orbits beyond the borders, basins, the surface that guesses them."""
