"""Compiled once, used by many tests: steps of up to sixteen wheels at a time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from support import truth
from vrw_jax.wheel import PARAMETER_NAMES, Outcome

SIZE = 16
TABLE_1 = truth.PARAMETERS[0]
GAIT = truth.table("cycle", "section_state")[0]
NAMES = PARAMETER_NAMES
IN_TIME = (
    (0.3, Outcome.NO_TOUCHDOWN_IN_TIME),
    (0.999, Outcome.NO_TOUCHDOWN_IN_TIME),
    (1.001, Outcome.STEPPED),
)
"""Time allowed over that of the longest phase, and how the step ends."""


def wheels_like(**changes):
    """Rows of parameters: Table 1 with some columns changed."""
    count = max(np.size(value) for value in changes.values()) if changes else 1
    rows = np.tile(TABLE_1, (count, 1))
    for name, value in changes.items():
        rows[:, NAMES.index(name)] = value
    return rows


PROVOKED = {
    Outcome.STEPPED: (wheels_like(), GAIT),
    Outcome.TOUCHDOWN_BEFORE_STOPPER: (wheels_like(), [0.1027, 2.3, -0.109]),
    Outcome.STOPPER_IN_DOUBLE_SUPPORT: (
        wheels_like(damping=157.864, stiffness=464.623, natural_length=1.137, slope=0.315),
        [0.298, 0.543, -0.589],
    ),
    Outcome.FELL_BACK: (wheels_like(slope=0.05), [0.1027, 1.0, -0.109]),
    Outcome.COLLAPSED: (
        wheels_like(damping=56.866, stiffness=78.927, natural_length=0.963, slope=0.5),
        [-0.33, 5.4, -1.989],
    ),
    Outcome.LEG_1_LIFTED_OFF: (wheels_like(), [0.1027, 6.0, -0.109]),
    Outcome.BAD_INPUT: (wheels_like(damping=np.nan), GAIT),
}
"""Of each outcome a wheel and a start that end so."""


def padded(rows, width):
    """Rows repeated to a batch of SIZE, and how many are real."""
    rows = np.atleast_2d(np.asarray(rows, dtype=float))
    assert rows.shape[1] == width
    assert rows.shape[0] <= SIZE
    return np.concatenate([rows, np.tile(rows[-1], (SIZE - rows.shape[0], 1))])


@eqx.filter_jit
def _full(vectors, starts, options, model, by_lanes):
    options = options.by("lanes" if by_lanes else "diffrax")
    one = lambda vector, start: model.step(truth.wheel(vector), start, options)
    return jax.vmap(one)(vectors, starts)


def full_steps(vectors, starts, options=None, model=None, by_lanes=False):
    """Full step results of a batch of wheels (rows of parameters) from section states."""
    count = max(np.atleast_2d(vectors).shape[0], np.atleast_2d(starts).shape[0])
    result = _full(
        jnp.asarray(padded(vectors, 9)),
        jnp.asarray(padded(starts, 3)),
        vrw.Options() if options is None else options,
        vrw.ViscoelasticWheel() if model is None else model,
        by_lanes,
    )
    return jax.tree.map(lambda leaf: leaf[:count], result)


def told(vector, start, options):
    """State and durations, and the solver's steps, of one lean step."""
    result = vrw.ViscoelasticWheel().advance(truth.wheel(vector), start, options)
    return jnp.concatenate([result.section_state, result.durations]), result.solver_steps


lean_steps = jax.jit(jax.vmap(told, (0, 0, None)))
_jacobian = jax.jacfwd(lambda *arguments: told(*arguments)[0], argnums=(0, 1))
jacobians = jax.jit(jax.vmap(_jacobian, (0, 0, None)))
