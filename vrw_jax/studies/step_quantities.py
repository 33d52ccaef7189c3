"""Quantities of one walking step that every model provides, and the measures computed from them."""

from collections.abc import Callable, Sequence
from operator import itemgetter

import numpy as np

QUANTITY_NAMES = (
    "duration_dls",
    "duration_single",
    "duration_flight",
    "step_length",
    "theta_touchdown",
    "dtheta_touchdown",
    "dL1_touchdown",
)
"""Names of the step quantities.

The first three are durations with two feet, one foot and no foot on the ground, s. The others are
the step length, m, and the section state (theta-, dtheta-, dL1-) of the paper after the step.
"""

N_STEP_QUANTITIES = len(QUANTITY_NAMES)
"""Number of quantities of a walking step."""

N_DURATIONS = 3
"""Number of durations, which are the first entries of the step quantities."""


def _compute_step_period(step_quantities: np.ndarray) -> np.ndarray:
    """Return the duration of a walking step, s, which is the sum of its first three quantities."""
    return step_quantities[..., 0] + step_quantities[..., 1] + step_quantities[..., 2]


MEASURE_FUNCTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "speed": lambda t: t[..., 3] / _compute_step_period(t),
    "period": _compute_step_period,
    "dls_fraction": lambda t: t[..., 0] / _compute_step_period(t),
} | {
    quantity_name: itemgetter((..., quantity_index))
    for quantity_index, quantity_name in enumerate(QUANTITY_NAMES)
}
"""Functions that compute the measures of every model from the step quantities.

The keys are names in `measures.MEASURES`.
"""

COMPLEX_STEP = 1e-30
"""Imaginary increment of complex-step derivatives, chosen so that its square has no effect."""


def evaluate_measures(measure_names: Sequence[str], step_quantities: np.ndarray) -> np.ndarray:
    """Return the measures, (wheels, measures), computed from step quantities, (wheels, 7).

    The measures of a failed walking step are NaN.
    """
    with np.errstate(invalid="ignore"):
        return np.stack(
            [MEASURE_FUNCTIONS[measure_name](step_quantities) for measure_name in measure_names], -1
        )


def compute_measure_derivatives(
    measure_names: Sequence[str], step_quantities: np.ndarray
) -> np.ndarray:
    """Return the derivatives of measures with respect to step quantities, (wheels, measures, 7).

    The derivatives are computed by the complex-step method.
    """
    complex_quantities = step_quantities[:, None, :] + 1j * COMPLEX_STEP * np.eye(N_STEP_QUANTITIES)
    return np.stack(
        [
            MEASURE_FUNCTIONS[measure_name](complex_quantities).imag / COMPLEX_STEP
            for measure_name in measure_names
        ],
        1,
    )
