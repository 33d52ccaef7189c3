"""Selection of the cheapest solver for each wheel, based on the stiffness of its airborne leg."""

from enum import IntEnum

import numpy as np

from vrw_jax.base.options import SolverName, StepOptions
from vrw_jax.flow.tableaus import compute_real_stability_limit, load_explicit_tableau
from vrw_jax.wheel.params import PARAMETER_NAMES


class SolverIndex(IntEnum):
    """Index of a solver in `StepBatchResult.solver_names`."""

    REQUESTED_SOLVER = 0  # of the step options
    STABLE_SOLVER = 1  # explicit, for steps that stability limits
    IMPLICIT_SOLVER = 2  # for wheels that are too stiff for explicit solvers


# Explicit solver for wheels whose solver steps are limited by stability. Tsit5 is chosen because it
# has the largest stable solver step per evaluation among diffrax's solvers of order 5 and more.
# That step is 0.58 divided by the rate of the mode, and 0.40 for Dopri8.
STABLE_SOLVER_NAME: SolverName = "Tsit5"
# Factor by which the tolerances of the stable solver are divided. The factor is chosen because the
# tighter tolerance costs little. At tolerances of 1e-6 and below, the error is then at most that of
# Dopri8.
STABLE_SOLVER_TIGHTENING_FACTOR = 4.0
# Solver for wheels that are too stiff for explicit solvers.
IMPLICIT_SOLVER_NAME: SolverName = "Kvaerno5"
# Cost of the implicit solver at a tolerance of 1e-6, in evaluations of an explicit solver. The cost
# was measured (docs/verification/failures.md) and grows as the tolerance to the power of -0.17. The
# cost of explicit solvers at the limit of stability does not depend on the tolerance.
IMPLICIT_SOLVER_COST_EVALUATIONS = 6e4


def select_cheapest_solver(parameter_matrix: np.ndarray, options: StepOptions) -> np.ndarray:
    """Return the `SolverIndex` of the cheapest solver for each lane, shape (lanes,).

    Let c be the damping of a leg and m its mass. If legs are light, the airborne leg's fast mode
    decays at the rate 1.03 c/m for about 0.67 sqrt(L0 / g), s. Stability limits the product of
    solver step and decay rate. A tenth is added to the number of solver steps for rejected ones.
    The requested solver stays selected if accuracy requires more steps of the stable solver than
    stability does. The number that accuracy requires is about the tolerance to the power of -1/5. A
    solver that would need more than `max_solver_steps` is excluded.

    - `parameter_matrix`: parameters in the order of `PARAMETER_NAMES`, shape (9, lanes).
    """
    leg_damping, leg_mass, locked_length, gravity_acceleration = (
        parameter_matrix[PARAMETER_NAMES.index(parameter_name)]
        for parameter_name in ("damping", "leg_mass", "locked_length", "gravity")
    )
    relative_tolerance = float(options.rtol)
    with np.errstate(all="ignore"):
        n_decay_times = (
            1.03 * leg_damping / leg_mass * 0.74 * np.sqrt(locked_length / gravity_acceleration)
        )

        def estimate_solver_cost(solver_name: str) -> tuple[np.ndarray, np.ndarray]:
            solver_tableau = load_explicit_tableau(solver_name)
            assert solver_tableau is not None  # The caller has checked the solver.
            n_evaluations_per_step = len(solver_tableau.stage_nodes) - 1
            n_solver_steps = n_decay_times / compute_real_stability_limit(solver_tableau)
            return n_solver_steps, np.where(
                n_solver_steps > options.max_solver_steps,
                np.inf,
                n_solver_steps * n_evaluations_per_step,
            )

        _, requested_solver_cost = estimate_solver_cost(options.solver)
        n_solver_steps, stable_solver_cost = estimate_solver_cost(STABLE_SOLVER_NAME)
        stable_solver_tolerance = relative_tolerance / STABLE_SOLVER_TIGHTENING_FACTOR
        is_stability_limited = n_solver_steps > stable_solver_tolerance**-0.2
        implicit_solver_cost = (
            IMPLICIT_SOLVER_COST_EVALUATIONS * (1e-6 / relative_tolerance) ** 0.17
        )
        solver_costs = (
            requested_solver_cost,
            np.where(is_stability_limited, stable_solver_cost, np.inf),
            np.full_like(n_decay_times, implicit_solver_cost),
        )
        return np.argmin(solver_costs, axis=0).astype(np.int32)  # 0 for an invalid wheel
