"""Quantities of one step that every model has, and the measures that follow from them."""

from collections.abc import Callable, Sequence

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
"""Names of the quantities: durations with two feet, one foot and no foot on the ground, s; step
length, m; and the paper's section state.
"""

N_STEP_QUANTITIES = len(QUANTITY_NAMES)
"""Number of quantities of a step."""

N_DURATIONS = 3
"""Number of durations, which are the first quantities."""


def _period_of_quantities(quantities: np.ndarray) -> np.ndarray:
    """Return the duration of a step, the sum of its durations in each support, s."""
    return quantities[..., 0] + quantities[..., 1] + quantities[..., 2]


MEASURE_FUNCTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "speed": lambda t: t[..., 3] / _period_of_quantities(t),
    "period": _period_of_quantities,
    "dls_fraction": lambda t: t[..., 0] / _period_of_quantities(t),
    "step_length": lambda t: t[..., 3],
    "duration_dls": lambda t: t[..., 0],
    "duration_single": lambda t: t[..., 1],
    "duration_flight": lambda t: t[..., 2],
    "theta_touchdown": lambda t: t[..., 4],
    "dtheta_touchdown": lambda t: t[..., 5],
    "dL1_touchdown": lambda t: t[..., 6],
}
"""Functions that compute the measures every model has, by their names in `measures.MEASURES`."""

COMPLEX_STEP = 1e-30
"""Imaginary step of complex-step derivatives, chosen so small that its square has no effect."""


def evaluate_measures(names: Sequence[str], quantities: np.ndarray) -> np.ndarray:
    """Return measures (elements, measures) from quantities (elements, 7); NaN if a step failed."""
    with np.errstate(invalid="ignore"):
        return np.stack([MEASURE_FUNCTIONS[name](quantities) for name in names], -1)


def compute_measure_derivatives(names: Sequence[str], quantities: np.ndarray) -> np.ndarray:
    """Return derivatives of measures with respect to quantities, (elements, measures, 7), by
    complex steps.
    """
    complex_quantities = quantities[:, None, :] + 1j * COMPLEX_STEP * np.eye(N_STEP_QUANTITIES)
    return np.stack(
        [MEASURE_FUNCTIONS[name](complex_quantities).imag / COMPLEX_STEP for name in names], 1
    )
