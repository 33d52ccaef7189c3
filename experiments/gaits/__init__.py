"""Study which gaits exist: orbits of several steps, basins, special points and the surface of
guesses."""
