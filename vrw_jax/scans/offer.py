"""Measures that a scan can compute: those of the steady gait, and their derivatives, by name."""

import re
from collections.abc import Iterable
from typing import NamedTuple

from vrw_jax.answers import MADE
from vrw_jax.cycles import CollocationFinder
from vrw_jax.models import SERVED, AbstractWheel
from vrw_jax.results import MARGINS, MEASURES, ON_GROUND, STEP, attrs_of
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES
from vrw_jax.wording import nearest

ALWAYS = ("outcome", "spectral_radius", *MARGINS)
"""Variables of every scan, requested or not: outcome, stability and margins of the gait."""

OF_CYCLE = CollocationFinder.of_cycle
"""Measures that are computed from the limit cycle itself; these have derivatives."""

ON_REQUEST = (*OF_CYCLE, *(name for name in STEP if name not in (*OF_CYCLE, "outcome")))

DEFAULT_MEASURES = (
    "dls_fraction",
    "speed",
    "period",
    "step_length",
    "duration_dls",
    "duration_sls1",
    "duration_sls2",
    "lambda_I4",
    "lambda_2_plus",
    "lambda_4_plus",
)


class Offer(NamedTuple):
    """Names of the variables that a scan of one model can compute."""

    on_request: tuple[str, ...]
    always: tuple[str, ...]  # in every scan, requested or not
    differentiable: tuple[str, ...]
    by: tuple[str, ...]  # parameters with respect to which derivatives are taken
    default: tuple[str, ...]
    tried: int  # samples per core that a forecast computes


_DEFAULT = ("dls_fraction", "speed", "period", "step_length", "slip", "energy_lost_impacts")
PAPER = Offer(ON_REQUEST, ALWAYS, OF_CYCLE, PARAMETER_NAMES, DEFAULT_MEASURES, 1024)
REAL_GROUND = Offer(
    (*ON_GROUND, "spectral_margin"),
    ("outcome", "spectral_radius"),
    ON_GROUND,
    (*PARAMETER_NAMES, FRICTION),
    _DEFAULT,
    16,
)
LADDER = Offer(
    (*ON_GROUND, "spectral_margin"),
    ("outcome", "spectral_radius", *SERVED),
    tuple(name for name in ON_GROUND if name in OF_CYCLE),
    PARAMETER_NAMES,
    _DEFAULT,
    64,
)
OFFERS = {"viscoelastic": PAPER, "unilateral": REAL_GROUND, "ladder": LADDER}
"""Catalogs by model, for the models with compliant legs."""
TO_TOLERANCE = Offer(
    tuple(MADE), ("outcome", "rung"), (), (), ("dls_fraction", "speed", "period"), 16
)
"""Catalog of scans to a tolerance, in which each measure has an error."""
ERROR = "_error"
"""Suffix of the variable that holds the error of a measure."""


def offer_of(model: AbstractWheel, tol: float | None = None) -> Offer:
    """Return the catalog of a model, or that of scans to a tolerance if `tol` is given."""
    return OFFERS[model.rung] if tol is None else TO_TOLERANCE


def error_of(measure: str) -> str:
    """Return the name of the variable that holds the error of a measure."""
    return measure + ERROR


_DERIVATIVE = re.compile(r"d[ _](\w+?)(?: */ *d |_d_)(\w+)")


class Derivative(NamedTuple):
    """Derivative of a measure with respect to a parameter, along the branch of limit cycles."""

    measure: str
    parameter: str

    @property
    def name(self) -> str:
        """Return the name of the variable that holds the derivative."""
        return f"d_{self.measure}_d_{self.parameter}"

    @property
    def attrs(self) -> dict[str, object]:
        """Return unit, name, symbol and description of the derivative."""
        above, below = MEASURES[self.measure], MEASURES[self.parameter]
        units = {unit for unit in (above.unit, below.unit) if unit != "1"}
        unit = "1" if not units else above.unit if below.unit == "1" else None
        return {
            "units": unit or f"{above.unit}/({below.unit})",
            "long_name": f"derivative of {above.long_name} by {below.long_name}",
            "symbol": f"∂({above.symbol})/∂{below.symbol}",
            "description": "Along the branch of limit cycles, by the implicit function theorem.",
        }


def derivative(name: str) -> Derivative | None:
    """Return the derivative named as in 'd dls_fraction / d damping', or None for a measure."""
    found = _DERIVATIVE.fullmatch(name.strip())
    return Derivative(*found.groups()) if found else None


def canonical(name: str) -> str:
    """Return the name of the variable that holds `name`, as a name that a file system accepts."""
    wanted = derivative(name)
    return name.strip() if wanted is None else wanted.name


def check_measures(names: Iterable[str], offer: Offer) -> tuple[str, ...]:
    """Return the variables' names, each once and without those in every scan; raise if unknown."""
    checked: dict[str, None] = {}
    known = (*offer.on_request, *offer.always)
    for name in names:
        wanted = derivative(name)
        if wanted is None:
            if name not in known:
                raise ValueError(
                    f"{name!r} is no measure of a scan{nearest(name, known)}: "
                    f"choose from {', '.join(offer.on_request)}, or a derivative such as "
                    "'d dls_fraction / d damping'."
                )
            if name not in offer.always:
                checked[name] = None
            continue
        if not offer.differentiable:
            raise ValueError(
                f"{name!r} is a derivative, but a scan to a tolerance computes only measures: "
                "drop it, or scan without tol."
            )
        if wanted.measure not in offer.differentiable:
            raise ValueError(
                f"{name!r} asks for a derivative of {wanted.measure!r}"
                f"{nearest(wanted.measure, offer.differentiable)}, but a scan differentiates only "
                f"{', '.join(offer.differentiable)}: choose one of these."
            )
        if wanted.parameter not in offer.by:
            raise ValueError(
                f"{name!r} asks for a derivative by {wanted.parameter!r}"
                f"{nearest(wanted.parameter, offer.by)}, but it must be by a parameter: "
                f"choose from {', '.join(offer.by)}."
            )
        checked[wanted.name] = None
    return tuple(checked)


def variable_attrs(name: str) -> dict[str, object]:
    """Return unit, name and description of the variable `name` of a scan."""
    if name in SERVED:
        return dict(SERVED[name])
    if name.removesuffix(ERROR) in MADE and name.endswith(ERROR):
        of = MEASURES[name.removesuffix(ERROR)]
        return {"units": of.unit, "long_name": f"bound of the error of {of.long_name}"}
    wanted = derivative(name)
    return attrs_of(name) if wanted is None else wanted.attrs
