"""Steps of batches of up to sixteen wheels, compiled once for many tests."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from support import reference_values
from vrw_jax import Outcome
from vrw_jax.wheel import PARAMETER_NAMES

BATCH_SIZE = 16
TABLE_1_VALUES = reference_values.REFERENCE_PARAMETERS[0]
TABLE_1_SECTION_STATE = reference_values.stack_quantity("cycle", "section_state")[0]
NAMES = PARAMETER_NAMES
TIME_LIMIT_CASES = (
    (0.3, Outcome.NO_TOUCHDOWN_IN_TIME),
    (0.999, Outcome.NO_TOUCHDOWN_IN_TIME),
    (1.001, Outcome.STEPPED),
)
"""Time allowed over that of the longest phase, and how the step ends."""


def make_parameter_rows(**changes):
    """Return rows of parameters: those of Table 1 with some columns changed."""
    count = max(np.size(value) for value in changes.values()) if changes else 1
    rows = np.tile(TABLE_1_VALUES, (count, 1))
    for name, value in changes.items():
        rows[:, NAMES.index(name)] = value
    return rows


OUTCOME_CASES = {
    Outcome.STEPPED: (make_parameter_rows(), TABLE_1_SECTION_STATE),
    Outcome.TOUCHDOWN_BEFORE_STOPPER: (make_parameter_rows(), [0.1027, 2.3, -0.109]),
    Outcome.STOPPER_IN_DOUBLE_SUPPORT: (
        make_parameter_rows(damping=157.864, stiffness=464.623, natural_length=1.137, slope=0.315),
        [0.298, 0.543, -0.589],
    ),
    Outcome.FELL_BACK: (make_parameter_rows(slope=0.05), [0.1027, 1.0, -0.109]),
    Outcome.COLLAPSED: (
        make_parameter_rows(damping=56.866, stiffness=78.927, natural_length=0.963, slope=0.5),
        [-0.33, 5.4, -1.989],
    ),
    Outcome.LEG_1_LIFTED_OFF: (make_parameter_rows(), [0.1027, 6.0, -0.109]),
    Outcome.CAME_TO_REST: (
        make_parameter_rows(
            damping=508.0, stiffness=1229.0, natural_length=0.962, slope=0.1, leg_mass=0.53
        ),
        [0.207, 0.824, -0.659],
    ),
    Outcome.BAD_INPUT: (make_parameter_rows(damping=np.nan), TABLE_1_SECTION_STATE),
}
"""Of each outcome a wheel and a start that end so."""


def pad_to_batch(rows, width):
    """Return rows repeated to a batch of `BATCH_SIZE`, and the number of original rows."""
    rows = np.atleast_2d(np.asarray(rows, dtype=float))
    assert rows.shape[1] == width
    assert rows.shape[0] <= BATCH_SIZE
    return np.concatenate([rows, np.tile(rows[-1], (BATCH_SIZE - rows.shape[0], 1))])


@eqx.filter_jit
def _compute_full_steps(vectors, starts, options, model, uses_lane_engine):
    options = options.with_engine("lanes" if uses_lane_engine else "diffrax")
    step_one = lambda vector, start: model.take_step(
        reference_values.make_wheel(vector), start, options
    )
    return jax.vmap(step_one)(vectors, starts)


def compute_full_steps(vectors, starts, options=None, model=None, uses_lane_engine=True):
    """Return the step results of wheels (rows of parameters) from section states."""
    count = max(np.atleast_2d(vectors).shape[0], np.atleast_2d(starts).shape[0])
    result = _compute_full_steps(
        jnp.asarray(pad_to_batch(vectors, 9)),
        jnp.asarray(pad_to_batch(starts, 3)),
        vrw.StepOptions() if options is None else options,
        vrw.ViscoelasticWheel() if model is None else model,
        uses_lane_engine,
    )
    return jax.tree.map(lambda leaf: leaf[:count], result)


def compute_state_and_work(vector, start, options):
    """Return state and durations of a step without margins, and the number of solver steps."""
    result = vrw.ViscoelasticWheel().advance(reference_values.make_wheel(vector), start, options)
    return jnp.concatenate([result.section_state, result.durations]), result.solver_steps


compute_states_and_work = jax.jit(jax.vmap(compute_state_and_work, (0, 0, None)))
_jacobian = jax.jacfwd(lambda *arguments: compute_state_and_work(*arguments)[0], argnums=(0, 1))
compute_jacobians = jax.jit(jax.vmap(_jacobian, (0, 0, None)))
