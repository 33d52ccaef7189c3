"""Selection of the cheapest solver for a wheel from the stiffness of its airborne leg."""

import functools
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from vrw_jax.integrator import load_explicit_tableau, real_stability_limit
from vrw_jax.numerics import SolverName, StepOptions
from vrw_jax.wheel import PARAMETER_NAMES


class SolverIndex(IntEnum):
    """Index of a solver in `StepBatchResult.solver_names`."""

    NAMED = 0  # the solver of the step options
    STABLE = 1  # an explicit one for wheels whose solver steps are limited by stability
    IMPLICIT = 2  # one for wheels that are too stiff for explicit solvers


@dataclass(frozen=True)
class SolverSelectionOptions:
    """Solvers of stiff wheels, and their costs, which are compared by `select_solver`."""

    stable_solver: SolverName = "Tsit5"
    """Explicit solver for steps limited by stability.

    It is chosen because of diffrax's solvers of order 5 and more it has the largest stable step per
    evaluation: 0.58 over the mode's rate, against 0.40 for Dopri8.
    """
    stable_tolerance_factor: float = 4.0
    """Factor by which the tolerance of the stable solver is tightened.

    It is chosen because it costs little. At tolerances of 1e-6 and below the error is then no
    larger than that of Dopri8.
    """
    implicit_solver: SolverName = "Kvaerno5"
    """Solver for wheels that are too stiff for explicit ones."""
    implicit_cost: float = 6e4
    """Cost of the implicit solver at a tolerance of 1e-6, in evaluations of an explicit solver.

    It was measured (docs/verification/failures.md). It scales as the tolerance to the power of
    -0.17. The cost of explicit solvers at the limit of stability does not depend on the tolerance.
    """


SOLVER_SELECTION_OPTIONS = SolverSelectionOptions()


def select_solver(
    parameters: np.ndarray,
    options: StepOptions,
    selection: SolverSelectionOptions = SOLVER_SELECTION_OPTIONS,
) -> np.ndarray:
    """Return the `SolverIndex` of the cheapest solver for each lane.

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
        n_solver_steps, stable_cost = evaluations(selection.stable_solver)
        stable_tolerance = tolerance / selection.stable_tolerance_factor
        is_stability_limited = n_solver_steps > stable_tolerance**-0.2
        implicit_cost = selection.implicit_cost * (1e-6 / tolerance) ** 0.17
        costs = (
            named_cost,
            np.where(is_stability_limited, stable_cost, np.inf),
            np.full_like(decay_count, implicit_cost),
        )
        return np.argmin(costs, axis=0).astype(np.int32)  # for an invalid wheel the first


@functools.cache
def _stages_and_limit(solver: str) -> tuple[int, float]:
    """Return an explicit solver's evaluations per step, and the limit of step length times decay
    rate."""
    tableau = load_explicit_tableau(solver)
    assert tableau is not None  # the caller checked
    return len(tableau.nodes) - 1, real_stability_limit(tableau)
