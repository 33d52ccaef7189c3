"""Names, units and attributes of all quantities, and the provenance of results."""

from vrw_jax.results.measures import (
    CONTACTS,
    CYCLE,
    GROUND,
    MARGINS,
    MEASURES,
    ON_GROUND,
    PHASES,
    STEP,
    STOPPERS,
    TRAJECTORY,
    attrs_of,
    flags,
    locked_legs,
    measure_of,
    variables,
    what_breaks,
)
from vrw_jax.results.origin import provenance
