"""Quantities of one step that every model has: seven numbers, and the measures that follow from
them."""

from collections.abc import Callable, Sequence

import numpy as np

N_STEP_QUANTITIES, N_DURATIONS = 7, 3
"""Numbers of quantities and of durations. The quantities are times on two feet, on one and in
flight, s; step length, m; and the paper's section state."""


def _period_of_quantities(quantities: np.ndarray) -> np.ndarray:
    return quantities[..., 0] + quantities[..., 1] + quantities[..., 2]


def _read_quantity(quantity_index: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda quantities: quantities[..., quantity_index]


MEASURE_FUNCTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "speed": lambda t: t[..., 3] / _period_of_quantities(t),
    "period": _period_of_quantities,
    "dls_fraction": lambda t: t[..., 0] / _period_of_quantities(t),
    "step_length": _read_quantity(3),
    "duration_dls": _read_quantity(0),
    "duration_single": _read_quantity(1),
    "duration_flight": _read_quantity(2),
    "theta_touchdown": _read_quantity(4),
    "dtheta_touchdown": _read_quantity(5),
    "dL1_touchdown": _read_quantity(6),
}
"""Measures that every model has, by their names in `measures.MEASURES`."""

COMPLEX_STEP = 1e-30


def evaluate_measures(names: Sequence[str], quantities: np.ndarray) -> np.ndarray:
    """Return measures (elements, measures) from quantities (elements, 7). They are NaN, without a
    warning, if a step failed."""
    with np.errstate(invalid="ignore"):
        return np.stack([MEASURE_FUNCTIONS[name](quantities) for name in names], -1)


def measure_derivatives(names: Sequence[str], quantities: np.ndarray) -> np.ndarray:
    """Return derivatives of measures with respect to the quantities, (elements, measures, 7), by
    complex steps."""
    complex_quantities = quantities[:, None, :] + 1j * COMPLEX_STEP * np.eye(N_STEP_QUANTITIES)
    return np.stack(
        [MEASURE_FUNCTIONS[name](complex_quantities).imag / COMPLEX_STEP for name in names], 1
    )
