"""Independent references of the wheel, which share no code and no derivation with the library."""
