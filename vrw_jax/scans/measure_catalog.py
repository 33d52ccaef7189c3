"""Measures that a scan can compute: those of the steady gait, and their derivatives, by name."""

import re
from collections.abc import Iterable
from typing import NamedTuple

from vrw_jax.cycles import CollocationFinder
from vrw_jax.measures import (
    MARGIN_MEASURES,
    MEASURES,
    PASSAGE_MEASURES,
    STEP_MEASURES,
    UNILATERAL_DIFFERENTIABLE_NAMES,
    measure_attrs,
)
from vrw_jax.models import AbstractWheel, GaitMethod
from vrw_jax.selection import SELECTION_ATTRS
from vrw_jax.tolerance import MEASURE_FUNCTIONS
from vrw_jax.validation import suggest_name
from vrw_jax.wheel import FRICTION_NAME, PARAMETER_NAMES

ALWAYS_INCLUDED = ("outcome", "spectral_radius", *MARGIN_MEASURES)
"""Variables of every scan, requested or not: outcome, stability and margins of the gait."""

DIFFERENTIABLE_MEASURES = CollocationFinder.cycle_measures
"""Measures that are computed from the limit cycle itself; only these have derivatives."""

REQUESTABLE_MEASURES = (
    *DIFFERENTIABLE_MEASURES,
    *(name for name in STEP_MEASURES if name not in (*DIFFERENTIABLE_MEASURES, "outcome")),
)

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


class MeasureCatalog(NamedTuple):
    """Names of the variables that a scan of one model can compute."""

    requestable: tuple[str, ...]
    always_included: tuple[str, ...]  # measures in every scan, requested or not
    differentiable: tuple[str, ...]
    # parameters by which measures can be differentiated
    differentiation_parameters: tuple[str, ...]
    default_measures: tuple[str, ...]
    forecast_samples_per_core: int  # number of samples per core that a forecast computes


_CONTACT_DEFAULT_MEASURES = (
    "dls_fraction",
    "speed",
    "period",
    "step_length",
    "slip",
    "energy_lost_impacts",
)
PAPER_CATALOG = MeasureCatalog(
    REQUESTABLE_MEASURES,
    ALWAYS_INCLUDED,
    DIFFERENTIABLE_MEASURES,
    PARAMETER_NAMES,
    DEFAULT_MEASURES,
    1024,
)
UNILATERAL_CATALOG = MeasureCatalog(
    (*UNILATERAL_DIFFERENTIABLE_NAMES, "spectral_margin"),
    ("outcome", "spectral_radius"),
    UNILATERAL_DIFFERENTIABLE_NAMES,
    (*PARAMETER_NAMES, FRICTION_NAME),
    _CONTACT_DEFAULT_MEASURES,
    16,
)
LADDER_CATALOG = MeasureCatalog(
    (*UNILATERAL_DIFFERENTIABLE_NAMES, "spectral_margin"),
    ("outcome", "spectral_radius", *SELECTION_ATTRS),
    tuple(name for name in UNILATERAL_DIFFERENTIABLE_NAMES if name in DIFFERENTIABLE_MEASURES),
    PARAMETER_NAMES,
    _CONTACT_DEFAULT_MEASURES,
    64,
)
CATALOGS = {
    GaitMethod.COLLOCATION: PAPER_CATALOG,
    GaitMethod.CONTACT_WALKS: UNILATERAL_CATALOG,
    GaitMethod.SELECTION: LADDER_CATALOG,
}
"""Catalogs by gait method, for the methods that scans support."""
TOLERANCE_CATALOG = MeasureCatalog(
    tuple(MEASURE_FUNCTIONS), ("outcome", "rung"), (), (), ("dls_fraction", "speed", "period"), 16
)
"""Catalog of scans to a tolerance, in which each measure has an error."""
ERROR_SUFFIX = "_error"
"""Suffix of the variable that contains the error of a measure."""


def select_catalog(
    model: AbstractWheel, tol: float | None = None, slope_sd: float | None = None
) -> MeasureCatalog:
    """Return the catalog of a model, or that of scans to a tolerance if `tol` is given.

    If `slope_sd` is given, it contains measures of walks over random slopes too.
    """
    if tol is not None:
        return TOLERANCE_CATALOG
    catalog = CATALOGS[model.capabilities.gait_method]
    return catalog if slope_sd is None else add_passage_measures(catalog)


def add_passage_measures(catalog: MeasureCatalog) -> MeasureCatalog:
    """Return a catalog with the measures of walks over random slopes, which take a second each."""
    return catalog._replace(
        requestable=(*catalog.requestable, *PASSAGE_MEASURES),
        default_measures=tuple(PASSAGE_MEASURES),
        forecast_samples_per_core=1,
    )


def error_variable_name(measure: str) -> str:
    """Return the name of the variable that contains the error of a measure."""
    return measure + ERROR_SUFFIX


_DERIVATIVE_PATTERN = re.compile(r"d[ _](\w+?)(?: */ *d |_d_)(\w+)")


class MeasureDerivative(NamedTuple):
    """Derivative of a measure with respect to a parameter, along the branch of limit cycles."""

    measure: str
    parameter: str

    @property
    def name(self) -> str:
        """Return the name of the variable that contains the derivative."""
        return f"d_{self.measure}_d_{self.parameter}"

    @property
    def variable_attrs(self) -> dict[str, object]:
        """Return unit, name, symbol and description of the derivative."""
        measure, parameter = MEASURES[self.measure], MEASURES[self.parameter]
        unit = f"{measure.unit}/({parameter.unit})"
        if parameter.unit == "1":
            unit = measure.unit
        return {
            "units": unit,
            "long_name": f"derivative of {measure.long_name} by {parameter.long_name}",
            "symbol": f"∂({measure.symbol})/∂{parameter.symbol}",
            "description": "Along the branch of limit cycles, by the implicit function theorem.",
        }


def parse_derivative(name: str) -> MeasureDerivative | None:
    """Return the derivative named as in 'd dls_fraction / d damping', or None for a measure."""
    match = _DERIVATIVE_PATTERN.fullmatch(name.strip())
    return MeasureDerivative(*match.groups()) if match else None


def canonicalize_name(name: str) -> str:
    """Return the name of the variable that contains the requested measure, valid as a file name."""
    requested_derivative = parse_derivative(name)
    return name.strip() if requested_derivative is None else requested_derivative.name


def check_measures(names: Iterable[str], catalog: MeasureCatalog) -> tuple[str, ...]:
    """Return the names of the requested variables, each once, without those that every scan has.

    Raise a ValueError for an unknown name.
    """
    checked_names: dict[str, None] = {}
    known_names = (*catalog.requestable, *catalog.always_included)
    for name in names:
        requested_derivative = parse_derivative(name)
        if requested_derivative is None:
            if name in PASSAGE_MEASURES and name not in known_names:
                raise ValueError(
                    f"{name!r} is a measure of walks over random slopes, whose standard deviation "
                    "is missing: give slope_sd, in rad, and no tol."
                )
            if name not in known_names:
                raise ValueError(
                    f"{name!r} is no measure of a scan{suggest_name(name, known_names)}: "
                    f"choose from {', '.join(catalog.requestable)}, or a derivative such as "
                    "'d dls_fraction / d damping'."
                )
            if name not in catalog.always_included:
                checked_names[name] = None
            continue
        if not catalog.differentiable:
            raise ValueError(
                f"{name!r} is a derivative, but a scan to a tolerance computes only measures: "
                "drop it, or scan without tol."
            )
        if requested_derivative.measure not in catalog.differentiable:
            raise ValueError(
                f"{name!r} asks for a derivative of {requested_derivative.measure!r}"
                f"{suggest_name(requested_derivative.measure, catalog.differentiable)}, but a scan "
                f"differentiates only {', '.join(catalog.differentiable)}: choose one of these."
            )
        parameters = catalog.differentiation_parameters
        if requested_derivative.parameter not in parameters:
            raise ValueError(
                f"{name!r} asks for a derivative by {requested_derivative.parameter!r}"
                f"{suggest_name(requested_derivative.parameter, parameters)}, but it must be by a "
                f"parameter: choose from {', '.join(parameters)}."
            )
        checked_names[requested_derivative.name] = None
    return tuple(checked_names)


def get_variable_attrs(name: str) -> dict[str, object]:
    """Return unit, name and description of the variable `name` of a scan."""
    if name in SELECTION_ATTRS:
        return dict(SELECTION_ATTRS[name])
    if name.removesuffix(ERROR_SUFFIX) in MEASURE_FUNCTIONS and name.endswith(ERROR_SUFFIX):
        measure = MEASURES[name.removesuffix(ERROR_SUFFIX)]
        return {"units": measure.unit, "long_name": f"bound of the error of {measure.long_name}"}
    derivative = parse_derivative(name)
    return measure_attrs(name) if derivative is None else derivative.variable_attrs
