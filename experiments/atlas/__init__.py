"""Study conditions under which methods fail: stiffness, events, derivatives, long walks,
formulations."""
