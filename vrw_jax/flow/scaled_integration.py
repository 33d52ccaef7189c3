"""Integrate phases in scaled units, which also apply to the tolerances of the solver."""

from jax import lax
from jaxtyping import Array, Bool, Float

from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Scalar
from vrw_jax.flow.integrate import PhaseEnd
from vrw_jax.flow.phase_integration import (
    GuardsAndMargins,
    StateArray,
    VectorField,
    integrate_phase,
    sample_phase,
)


def integrate_phase_in_scaled_units(
    vector_field: VectorField,
    guards_and_margins: GuardsAndMargins,
    start_state: StateArray,
    is_active: Bool[Array, ""],
    options: StepOptions,
    state_units: StateArray,
    time_unit: Scalar,
) -> PhaseEnd:
    """Return the result of `integrate_phase` in SI units, computed in scaled units.

    - `state_units`: SI value of one scaled unit for each coordinate of the state;
    - `time_unit`: scaled unit of time, s.

    The tolerances, the first step length and the time limit of `options` are in scaled units. All
    other arguments are in SI units, including guards and margins.
    """
    state_units, time_unit = lax.stop_gradient((state_units, time_unit))
    evaluate_guards_and_margins_in_si = lambda y: guards_and_margins.evaluate_guards_and_margins(
        y * state_units
    )
    phase_end = integrate_phase(
        _make_scaled_vector_field(vector_field, state_units, time_unit),
        guards_and_margins._replace(evaluate_guards_and_margins=evaluate_guards_and_margins_in_si),
        start_state / state_units,
        is_active,
        options,
    )
    return phase_end._replace(
        state=phase_end.state * state_units, duration=phase_end.duration * time_unit
    )


def sample_phase_in_scaled_units(
    vector_field: VectorField,
    start_state: StateArray,
    duration: Scalar,
    n_samples: int,
    options: StepOptions,
    state_units: StateArray,
    time_unit: Scalar,
) -> Float[Array, "n_samples dim"]:
    """Return the result of `sample_phase` in SI units, computed in scaled units.

    The arguments are those of `integrate_phase_in_scaled_units`.
    """
    state_units, time_unit = lax.stop_gradient((state_units, time_unit))
    scaled_vector_field = _make_scaled_vector_field(vector_field, state_units, time_unit)
    start_state, duration = start_state / state_units, duration / time_unit
    return (
        sample_phase(scaled_vector_field, start_state, duration, n_samples, options) * state_units
    )


def _make_scaled_vector_field(
    vector_field: VectorField, state_units: StateArray, time_unit: Scalar
) -> VectorField:
    scaled_rate_factors = time_unit / state_units
    return lambda y: vector_field(y * state_units) * scaled_rate_factors
