"""What quantities are called and how results show themselves."""

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
