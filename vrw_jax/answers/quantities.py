"""Quantities of one step that every model has: seven numbers, and the measures that follow from
them."""

from collections.abc import Callable, Sequence

import numpy as np

N_QUANTITIES, N_DURATIONS = 7, 3
"""Numbers of quantities and of durations. The quantities are times on two feet, on one and in
flight, s; step length, m; and the paper's section state."""


def _period(t: np.ndarray) -> np.ndarray:
    return t[..., 0] + t[..., 1] + t[..., 2]


def _own(place: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda t: t[..., place]


MADE: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "speed": lambda t: t[..., 3] / _period(t),
    "period": _period,
    "dls_fraction": lambda t: t[..., 0] / _period(t),
    "step_length": _own(3),
    "duration_dls": _own(0),
    "duration_single": _own(1),
    "duration_flight": _own(2),
    "theta_touchdown": _own(4),
    "dtheta_touchdown": _own(5),
    "dL1_touchdown": _own(6),
}
"""Measures that every model has, by their names in `results.ALL_MEASURES`."""

TINY = 1e-30


def measured(names: Sequence[str], t: np.ndarray) -> np.ndarray:
    """Return measures (elements, measures) from quantities (elements, 7). They are NaN, without a
    warning, if a step failed."""
    with np.errstate(invalid="ignore"):
        return np.stack([MADE[name](t) for name in names], -1)


def slopes(names: Sequence[str], t: np.ndarray) -> np.ndarray:
    """Return derivatives of measures with respect to the quantities, (elements, measures, 7), by
    complex steps."""
    steps = t[:, None, :] + 1j * TINY * np.eye(N_QUANTITIES)
    return np.stack([MADE[name](steps).imag / TINY for name in names], 1)
