"""Which solver takes a wheel at the least cost: by how stiff its airborne leg is."""

import functools

import numpy as np

from vrw_jax.numerics import Options, explicit_tableau, real_stability_limit
from vrw_jax.wheel import PARAMETER_NAMES

NAMED, STABLE, IMPLICIT = range(3)
"""Solvers that take a lane: that of the options, and two for stiff wheels."""
STABLE_SOLVER, TIGHTER = "Tsit5", 4.0
"""Explicit solver of wheels whose steps stability limits, and how much tighter it is set.

Of diffrax's of order 5 and more it goes farthest for an evaluation there: 0.58 over the mode's
rate, Dopri8 0.40. So much tighter it costs little more, and from a tolerance of 1e-6 down its error
is no larger than Dopri8's at the named one."""
IMPLICIT_SOLVER = "Kvaerno5"
"""Solver of wheels that are too stiff for explicit ones."""
WORTH = 6e4
"""Evaluations by an explicit solver that cost what IMPLICIT_SOLVER does at a tolerance of 1e-6
(docs/stability_atlas.md). Its own cost goes with the tolerance's power of -0.17, from 1e-4 to
1e-10; at the limit of stability theirs does not."""


def cheapest_solver(wheels: np.ndarray, options: Options) -> np.ndarray:
    """Which solver takes each lane at the least cost: NAMED, STABLE or IMPLICIT.

    The airborne leg's fast mode decays at 1.03 c/m for some 0.67 sqrt(L0 / g), s, where legs are
    light, and a step times that rate must stay below an explicit solver's limit of stability;
    rejected steps add a tenth. Where accuracy asks STABLE for more steps than that, about its
    tolerance to the power of -1/5, the solver remains that of `options`. More than
    `max_solver_steps` are no choice.
    """
    damping, mass, length, gravity = (
        wheels[PARAMETER_NAMES.index(name)]
        for name in ("damping", "leg_mass", "locked_length", "gravity")
    )
    tolerance = float(options.rtol)
    with np.errstate(all="ignore"):
        decays = 1.03 * damping / mass * 0.74 * np.sqrt(length / gravity)

        def evaluations(solver: str) -> tuple[np.ndarray, np.ndarray]:
            stages, bears = _stages_and_limit(solver)
            steps = decays / bears
            return steps, np.where(steps > options.max_solver_steps, np.inf, steps * stages)

        _, named = evaluations(options.solver)
        steps, stable = evaluations(STABLE_SOLVER)
        limited = steps > (tolerance / TIGHTER) ** -0.2
        implicit = np.full_like(decays, WORTH * (1e-6 / tolerance) ** 0.17)
        costs = named, np.where(limited, stable, np.inf), implicit
        return np.argmin(costs, axis=0).astype(np.int32)  # a wheel that is none: the first


@functools.cache
def _stages_and_limit(solver: str) -> tuple[int, float]:
    """Of an explicit solver: evaluations of a step; its length times a mode's rate, at most."""
    tableau = explicit_tableau(solver)
    assert tableau is not None  # the caller looked
    return len(tableau.places) - 1, real_stability_limit(tableau)
