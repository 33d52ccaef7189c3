"""Steps of the paper's wheel between landings with both feet on the ground: its two-number section.

Just after such a landing the wheel has two free numbers, and the ground of its step is two lines.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.batches.programs import run_compiled
from vrw_jax.integrator import load_explicit_tableau
from vrw_jax.models import N_STEP_INPUTS, ViscoelasticWheel, jacobian_columns, step_after_landing
from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import PARAMETER_NAMES, wheel_from_parameters

INPUTS = (*PARAMETER_NAMES, "theta", "dtheta", "slope_ahead")
"""What a step moves with, in the order of the columns of `LandingSteps.jacobian`."""


class LandingSteps(NamedTuple):
    """Steps of a batch; lanes are the last axis.

    A step ends just after the next landing; where it failed (`outcome`) its numbers are zeros, but
    for `stopper_margin`, which is NaN only where SLS-I was not reached.
    """

    state: np.ndarray
    """(theta+, dtheta+) just after the next landing with both feet held, in the frame of the line
    ahead, (2, lanes), rad, rad/s."""
    rear_impulse: np.ndarray
    """Normal impulse of the rear foot in that landing, N s: where it is negative, the landing frees
    the foot, and the two numbers are not the wheel's."""
    stopper_margin: np.ndarray
    """Positive where Leg 2 met its stopper before the next foot lands, negative where that foot
    landed first, m^2/s; it and its first derivatives are continuous where both come at once."""
    outcome: np.ndarray
    durations: np.ndarray  # of DLS, SLS-I, SLS-II, (3, lanes), s
    jacobian: np.ndarray | None
    """Of (theta+, dtheta+, rear_impulse, stopper_margin) by `moved`: (moved, 4, lanes)."""


def step_batch_after_landing(
    wheels: np.ndarray,
    states: np.ndarray,
    ahead: np.ndarray,
    *,
    n_legs: int = 8,
    model: ViscoelasticWheel | None = None,
    options: StepOptions | None = None,
    moved: Sequence[str] = (),
) -> LandingSteps:
    """Return one step of every lane from landing to landing on uneven ground.

    Args:
        wheels: parameters in the order of PARAMETER_NAMES, (9, lanes); the slope is that of the
            line under both feet.
        states: (theta+, dtheta+) just after a landing with both feet held, in the frame of that
            line, (2, lanes), rad, rad/s.
        ahead: slopes of the lines on which the steps end, (lanes,), rad.
        n_legs: of all wheels.
        model: says whether a foot that would have to be pulled ends a step.
        options: numerical choices.
        moved: `INPUTS` by which derivatives are wanted.
    """
    model, options = model or ViscoelasticWheel(), options or StepOptions()
    tableau = load_explicit_tableau(options.solver)
    if tableau is None:
        raise ValueError(
            f"solver is {options.solver}, but lanes need an explicit one: take Dopri8."
        )
    dynamic, structure = jax.tree.flatten(options)
    uniform = [np.asarray(leaf, wheels.dtype) for leaf in dynamic]
    n, stop = len(PARAMETER_NAMES), model.stop_at_lift_off
    places = tuple(INPUTS.index(name) for name in moved)

    def step(uniform: Any, lanes: Any, few: Array | None = None) -> tuple:
        known = jax.tree.unflatten(structure, uniform)
        known = known.with_derivative_tolerances() if places else known

        def told(*lanes: Array) -> tuple:
            params = wheel_from_parameters(lanes[:n], n_legs, lanes[-1])
            step = step_after_landing(params, lanes[n:-1], known, tableau, stop, few)
            return step.numbers, (step.unfinished, step.outcome, jnp.stack(step.durations))

        if not places:
            numbers, others = told(*lanes)
            return (*others, numbers)
        columns, numbers, others = jacobian_columns(told, lanes, places)
        return (*others, numbers, columns)

    settings = ("step after landing", n_legs, stop, structure, places)
    small = (N_STEP_INPUTS,) if places else ()
    given = [*wheels, *states, ahead]
    _, outcome, durations, numbers, *columns = run_compiled(step, uniform, given, settings, *small)
    margin = np.where(durations[1] > 0.0, numbers[3], np.nan)
    told = numbers[:2], numbers[2], margin, outcome, durations
    return LandingSteps(*told, columns[0] if columns else None)
