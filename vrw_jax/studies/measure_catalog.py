"""Measures that a scan can compute, by name: measures of the steady gait, and derivatives of
measures.
"""

import re
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from vrw_jax.base.checks import format_name_suggestion
from vrw_jax.base.results import Measure
from vrw_jax.gaits.unilateral_finder import UnilateralFinder
from vrw_jax.gaits.wheel_finders import CollocationFinder
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.ladder import SELECTION_VARIABLE_ATTRIBUTES
from vrw_jax.models.measures import (
    MARGIN_MEASURES,
    MEASURES,
    PASSAGE_MEASURES,
    STEP_MEASURES,
    make_measure_attributes,
)
from vrw_jax.studies.fidelity import MEASURE_FUNCTIONS
from vrw_jax.wheel.params import PARAMETER_NAMES

ValuesByVariable = dict[str, np.ndarray]
"""Values of each variable for samples, by the name of the variable; the sample axes come first."""

ALWAYS_INCLUDED_VARIABLES = ("outcome", "spectral_radius", *MARGIN_MEASURES)
"""Names of the variables that every scan contains, requested or not: outcome, spectral radius and
margins of the gait.
"""

DIFFERENTIABLE_MEASURES = CollocationFinder.cycle_measures
"""Names of the measures that are computed from the limit cycle alone. Only these measures have
derivatives.
"""


class MeasureCatalog(NamedTuple):
    """Names of the variables that a scan with one model can compute."""

    requestable_measures: tuple[str, ...]
    always_included_variables: tuple[str, ...]  # measures in every scan, requested or not
    differentiable_measures: tuple[str, ...]
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
PAPER_MEASURE_CATALOG = MeasureCatalog(
    tuple(
        measure_name
        for measure_name in dict.fromkeys((*DIFFERENTIABLE_MEASURES, *STEP_MEASURES))
        if measure_name != "outcome"
    ),
    ALWAYS_INCLUDED_VARIABLES,
    DIFFERENTIABLE_MEASURES,
    PARAMETER_NAMES,
    (
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
    ),
    1024,
)
UNILATERAL_MEASURE_CATALOG = MeasureCatalog(
    (*UnilateralFinder.differentiable_measures, "spectral_margin"),
    ("outcome", "spectral_radius"),
    UnilateralFinder.differentiable_measures,
    PARAMETER_NAMES,
    _CONTACT_DEFAULT_MEASURES,
    16,
)
MODEL_SELECTION_MEASURE_CATALOG = MeasureCatalog(
    UNILATERAL_MEASURE_CATALOG.requestable_measures,
    ("outcome", "spectral_radius", *SELECTION_VARIABLE_ATTRIBUTES),
    tuple(
        measure_name
        for measure_name in UnilateralFinder.differentiable_measures
        if measure_name in DIFFERENTIABLE_MEASURES
    ),
    PARAMETER_NAMES,
    _CONTACT_DEFAULT_MEASURES,
    64,
)
TOLERANCE_MEASURE_CATALOG = MeasureCatalog(
    tuple(MEASURE_FUNCTIONS), ("outcome", "rung"), (), (), ("dls_fraction", "speed", "period"), 16
)
"""Measure catalog for scans to a tolerance, in which each measure has an error."""
ERROR_VARIABLE_SUFFIX = "_error"
"""Suffix that distinguishes the variable with the error of a measure from that with its value."""


def select_measure_catalog(
    wheel_model: AbstractWheel,
    error_tolerance: float | None,
    slope_standard_deviation: float | None,
) -> MeasureCatalog:
    """Return the catalog of measures that a scan with `wheel_model` can compute.

    For a model without scans, it is that of the paper's model.
    If `error_tolerance` is given, the catalog is that for scans to a tolerance. If
    `slope_standard_deviation` is given, the catalog also contains measures of walks over random
    slopes.
    """
    if error_tolerance is not None:
        return TOLERANCE_MEASURE_CATALOG
    measure_catalog = MODEL_SELECTION_MEASURE_CATALOG
    if wheel_model.fallback_model is wheel_model:
        has_legs = wheel_model.batch_kernel == "legs"
        measure_catalog = UNILATERAL_MEASURE_CATALOG if has_legs else PAPER_MEASURE_CATALOG
        measure_catalog = measure_catalog._replace(
            differentiation_parameters=wheel_model.parameter_names
        )
    if slope_standard_deviation is None:
        return measure_catalog
    # The measures of such walks take about one second per sample.
    return measure_catalog._replace(
        requestable_measures=(*measure_catalog.requestable_measures, *PASSAGE_MEASURES),
        default_measures=tuple(PASSAGE_MEASURES),
        forecast_samples_per_core=1,
    )


_DERIVATIVE_NAME_PATTERN = re.compile(r"d[ _](\w+?)(?: */ *d |_d_)([\w.]+)")


class MeasureDerivative(NamedTuple):
    """Derivative of a limit cycle's measure with respect to a parameter, on the branch of limit
    cycles.
    """

    measure_name: str
    parameter_name: str

    @property
    def variable_name(self) -> str:
        """Return the name of the dataset variable that contains the derivative."""
        return f"d_{self.measure_name}_d_{self.parameter_name}"

    def describe_variable(
        self, measure_description: Measure, parameter_description: Measure
    ) -> dict[str, object]:
        """Return unit, long name, symbol and description of the derivative, by attribute name."""
        derivative_unit = f"{measure_description.unit}/({parameter_description.unit})"
        if parameter_description.unit == "1":
            derivative_unit = measure_description.unit
        return {
            "units": derivative_unit,
            "long_name": f"derivative of {measure_description.long_name} by "
            f"{parameter_description.long_name}",
            "symbol": f"∂({measure_description.symbol})/∂{parameter_description.symbol}",
            "description": "Along the branch of limit cycles, by the implicit function theorem.",
        }


def parse_derivative(variable_name: str) -> MeasureDerivative | None:
    """Return the derivative that `variable_name` denotes, such as 'd dls_fraction / d damping'.

    Return None for any other name.
    """
    derivative_name_match = _DERIVATIVE_NAME_PATTERN.fullmatch(variable_name.strip())
    return MeasureDerivative(*derivative_name_match.groups()) if derivative_name_match else None


def canonicalize_variable_name(measure_name: str) -> str:
    """Return the name of the variable that contains the requested measure.

    The returned name is valid as a file name.
    """
    requested_derivative = parse_derivative(measure_name)
    return (
        measure_name.strip() if requested_derivative is None else requested_derivative.variable_name
    )


def check_measure_names(
    measure_names: Iterable[str], measure_catalog: MeasureCatalog
) -> tuple[str, ...]:
    """Return the names of the variables for the requested measures, each once.

    Variables that every scan contains are omitted. Raise a ValueError for an unknown name.
    """
    checked_variable_names: dict[str, None] = {}
    known_variable_names = (
        *measure_catalog.requestable_measures,
        *measure_catalog.always_included_variables,
    )
    for measure_name in measure_names:
        requested_derivative = parse_derivative(measure_name)
        if requested_derivative is None:
            if measure_name in PASSAGE_MEASURES and measure_name not in known_variable_names:
                raise ValueError(
                    f"{measure_name!r} is a measure of walks over random slopes, whose standard "
                    "deviation is missing: give slope_sd, in rad, and no tol."
                )
            if measure_name not in known_variable_names:
                derivatives = [
                    f", or a derivative such as 'd {measure} / d {parameter}'"
                    for measure, parameter in zip(
                        measure_catalog.differentiable_measures,
                        measure_catalog.differentiation_parameters,
                        strict=False,
                    )
                ]
                raise ValueError(
                    f"{measure_name!r} is no measure of a "
                    f"scan{format_name_suggestion(measure_name, known_variable_names)}: choose "
                    f"from {', '.join(measure_catalog.requestable_measures)}"
                    f"{''.join(derivatives[:1])}."
                )
            if measure_name not in measure_catalog.always_included_variables:
                checked_variable_names[measure_name] = None
            continue
        if not measure_catalog.differentiable_measures:
            raise ValueError(
                f"{measure_name!r} is a derivative, but a scan to a tolerance computes only "
                "measures: drop it, or scan without tol."
            )
        differentiable_measures = measure_catalog.differentiable_measures
        differentiated_measure_name = requested_derivative.measure_name
        if differentiated_measure_name not in differentiable_measures:
            raise ValueError(
                f"{measure_name!r} asks for a derivative of {differentiated_measure_name!r}"
                f"{format_name_suggestion(differentiated_measure_name, differentiable_measures)}, "
                f"but a scan differentiates only {', '.join(differentiable_measures)}: choose one "
                "of these."
            )
        differentiation_parameters = measure_catalog.differentiation_parameters
        parameter_name = requested_derivative.parameter_name
        if parameter_name not in differentiation_parameters:
            raise ValueError(
                f"{measure_name!r} asks for a derivative by {parameter_name!r}"
                f"{format_name_suggestion(parameter_name, differentiation_parameters)}, but it "
                f"must be by a parameter: choose from {', '.join(differentiation_parameters)}."
            )
        checked_variable_names[requested_derivative.variable_name] = None
    return tuple(checked_variable_names)


def get_variable_attributes(variable_name: str) -> dict[str, object]:
    """Return unit, long name and description of a variable of a scan, by attribute name."""
    if variable_name in SELECTION_VARIABLE_ATTRIBUTES:
        return dict(SELECTION_VARIABLE_ATTRIBUTES[variable_name])
    measure_name = variable_name.removesuffix(ERROR_VARIABLE_SUFFIX)
    if measure_name != variable_name and measure_name in MEASURE_FUNCTIONS:
        measure_description = MEASURES[measure_name]
        return {
            "units": measure_description.unit,
            "long_name": f"bound of the error of {measure_description.long_name}",
        }
    measure_derivative = parse_derivative(variable_name)
    return (
        make_measure_attributes(variable_name)
        if measure_derivative is None
        else measure_derivative.describe_variable(
            MEASURES[measure_derivative.measure_name], MEASURES[measure_derivative.parameter_name]
        )
    )
