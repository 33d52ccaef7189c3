"""Independent oracle of the wheel: shares no code and no derivation with the library."""
