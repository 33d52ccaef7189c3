"""Selection of the cheapest solver for a wheel from the stiffness of its airborne leg."""

import functools

import numpy as np

from vrw_jax.integrator import load_explicit_tableau, real_stability_limit
from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import PARAMETER_NAMES

NAMED_SOLVER_INDEX, STABLE_SOLVER_INDEX, IMPLICIT_SOLVER_INDEX = range(3)
"""Indices of the solvers: the one in the options, and two for stiff wheels."""
STABLE_SOLVER, TSIT5_TOLERANCE_FACTOR = "Tsit5", 4.0
"""Explicit solver of wheels whose steps are limited by stability, and the factor by which its
tolerance is tightened.

Of diffrax's solvers of order 5 and more it has the largest stable step per evaluation: 0.58 over
the mode's rate, against 0.40 for Dopri8. The factor is chosen because it costs little, and for
tolerances of 1e-6 and below the error is then no larger than Dopri8's at the named one.
"""
IMPLICIT_SOLVER = "Kvaerno5"
"""Solver of wheels that are too stiff for explicit ones."""
IMPLICIT_COST_EVALS = 6e4
"""Number of evaluations of an explicit solver with the same cost as IMPLICIT_SOLVER at a tolerance
of 1e-6 (docs/verification/failures.md). The cost of the implicit solver scales as the tolerance to
the power of -0.17, from 1e-4 to 1e-10. At the limit of stability the cost of explicit solvers does
not depend on it."""


def select_solver(parameters: np.ndarray, options: StepOptions) -> np.ndarray:
    """Return the index of the cheapest solver for each lane.

    The airborne leg's fast mode decays at 1.03 c/m for some 0.67 sqrt(L0 / g), s, if legs are
    light. A step times that rate must stay below an explicit solver's limit of stability; rejected
    steps add a tenth. If accuracy requires more steps of the stable solver, about its tolerance to
    the power of -1/5, the solver of `options` is kept. A solver that would need more than
    `max_solver_steps` is excluded.
    """
    damping, mass, length, gravity = (
        parameters[PARAMETER_NAMES.index(name)]
        for name in ("damping", "leg_mass", "locked_length", "gravity")
    )
    tolerance = float(options.rtol)
    with np.errstate(all="ignore"):
        decay_count = 1.03 * damping / mass * 0.74 * np.sqrt(length / gravity)

        def evaluations(solver: str) -> tuple[np.ndarray, np.ndarray]:
            n_stages, stability_limit = _stages_and_limit(solver)
            n_solver_steps = decay_count / stability_limit
            return n_solver_steps, np.where(
                n_solver_steps > options.max_solver_steps, np.inf, n_solver_steps * n_stages
            )

        _, named_cost = evaluations(options.solver)
        n_solver_steps, stable_cost = evaluations(STABLE_SOLVER)
        is_stability_limited = n_solver_steps > (tolerance / TSIT5_TOLERANCE_FACTOR) ** -0.2
        implicit_cost = np.full_like(decay_count, IMPLICIT_COST_EVALS * (1e-6 / tolerance) ** 0.17)
        costs = named_cost, np.where(is_stability_limited, stable_cost, np.inf), implicit_cost
        return np.argmin(costs, axis=0).astype(np.int32)  # invalid wheels: the first


@functools.cache
def _stages_and_limit(solver: str) -> tuple[int, float]:
    """Return an explicit solver's evaluations per step, and the limit of step length times decay
    rate."""
    tableau = load_explicit_tableau(solver)
    assert tableau is not None  # the caller checked
    return len(tableau.nodes) - 1, real_stability_limit(tableau)
