"""Study the intervals of fits and the choice among laws of the legs."""
