"""What a tuned gait must keep, as callers say it: least values of measures, or ranges."""

from collections.abc import Mapping, Sequence

from vrw_jax.cycles import AbstractGaitFinder, default_margins
from vrw_jax.tuning.objective import MOST
from vrw_jax.wheel import WheelParams
from vrw_jax.wording import names_of, range_of, real, require_known

Margins = Mapping[str, float | tuple[float, float]] | Sequence[str]


def margins_of(
    params: WheelParams, constraints: Margins | None, finder: AbstractGaitFinder
) -> dict[str, float]:
    """Least values by measure, or by `MOST` and a measure of its negative."""
    if constraints is None:
        premises = default_margins(params)
        return {name: least for name, least in premises.items() if finder.from_nothing}
    margins: dict[str, float] = {}
    if isinstance(constraints, Mapping):
        for name, least in constraints.items():
            if isinstance(least, tuple):
                least, most = range_of(f"the range of {name}", least)
                margins[MOST + name] = -most
            margins[name] = real(f"the margin of {name}", least)
    else:
        margins = dict.fromkeys(names_of("constraints", constraints), 0.0)
    if "clearance_sls1" in margins:
        # It has a slope where the clearance has none.
        margins.setdefault("takeoff_acceleration", 0.0)
    for name in margins:
        require_known(name.removeprefix(MOST), finder.readable, "measure for a constraint")
    return margins


def bound_of(name: str, least: float) -> float:
    """A constraint's bound as it was given."""
    return float(-least if name.startswith(MOST) else least)
