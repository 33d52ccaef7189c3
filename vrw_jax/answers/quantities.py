"""What one step tells of a gait on any rung: seven numbers, and the measures that they make."""

from collections.abc import Callable, Sequence

import numpy as np

N_QUANTITIES, N_DURATIONS = 7, 3
"""Time on two feet, on one, in flight, s; step length, m; section state of the paper's."""


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
"""Measures that every rung tells, by their names in `results.MEASURES`."""

TINY = 1e-30


def measured(names: Sequence[str], t: np.ndarray) -> np.ndarray:
    """(lanes, names) of quantities (lanes, 7); NaN, and no warning, where a step failed."""
    with np.errstate(invalid="ignore"):
        return np.stack([MADE[name](t) for name in names], -1)


def slopes(names: Sequence[str], t: np.ndarray) -> np.ndarray:
    """Their derivatives by the quantities, (lanes, names, 7), by complex steps."""
    steps = t[:, None, :] + 1j * TINY * np.eye(N_QUANTITIES)
    return np.stack([MADE[name](steps).imag / TINY for name in names], 1)
