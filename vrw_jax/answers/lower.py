"""Gaits of the models below unilateral contact, with the matrices that propagate a defect to
measures."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.answers.quantities import N_QUANTITIES
from vrw_jax.batches import steps
from vrw_jax.cycles import finder_of
from vrw_jax.gaits import SHAPES, reached
from vrw_jax.models import RigidWheel
from vrw_jax.numerics import Options, in_batches, taken, with_jacobian
from vrw_jax.wheel import Outcome, WheelParams

NONE, RIGID, PAPER, GROUND = 0, 1, 2, 3
RUNGS = ("none", "rigid", "viscoelastic", "unilateral")
"""Names of the models by index."""

START = "section_state"

SETTLED = (Outcome.STEPPED, Outcome.ORDER_DIFFERS)
"""Outcomes of a search after which no walk is tried. Of 210 wheels with 6 to 12 legs whose solution
has another order of phases, walks lead 3 to a gait."""


class Lower(NamedTuple):
    """One gait of each element, in a model whose section state is the paper's; the batch axis comes
    first."""

    rung: np.ndarray  # NO_MODEL if there is no gait
    x: np.ndarray  # (elements, 3)
    told: np.ndarray  # (elements, 7): quantities of the step from it
    carry: np.ndarray  # (elements, 3, 3): (I - DP)^-1
    moved: np.ndarray  # (elements, 7, 3): derivatives of the quantities
    own: np.ndarray  # (elements, 3): numerical defect of the gait times `newton_matrix`
    outcome: np.ndarray


def no_gaits(n: int) -> Lower:
    """Return empty gaits for a batch."""
    return Lower(
        np.full(n, NONE), np.zeros((n, 3)), np.zeros((n, N_QUANTITIES)), np.zeros((n, 3, 3)),
        np.zeros((n, N_QUANTITIES, 3)), np.zeros((n, 3)), np.full(n, int(Outcome.NO_CYCLE_FOUND)),
    )  # fmt: skip


def put(into: Lower, lanes: np.ndarray, some: Lower) -> None:
    """Replace the gaits at these indices."""
    for whole, part in zip(into, some, strict=True):
        whole[lanes] = part


def paper_gaits(params: WheelParams, options: Options) -> Lower:
    """Return gaits by collocation, with derivatives from one step by machine code."""

    finder = finder_of(None, params.n_legs)
    cycles = in_batches(finder.cycles, SHAPES, params)
    x, outcome = np.array(cycles.section_state), np.array(cycles.outcome)
    (lost,) = np.nonzero(~np.isin(outcome, SETTLED))
    if len(lost):  # one mesh for all keeps digits independent of the batch
        cycles = reached(finder, *jax.device_put(taken((params, cycles), lost)))
        x[lost], outcome[lost] = cycles.section_state, cycles.outcome
    lower = no_gaits(len(x))
    lower.outcome[:] = outcome
    (good,) = np.nonzero(outcome == Outcome.STEPPED)
    if not len(good):
        return lower
    some = jax.device_put(taken(params, good))
    step = steps(some, x[good], options=options, derivatives=[START])
    by = jax.tree.map(np.asarray, step.derivatives[START])
    y, d = np.asarray(step.section_state), np.asarray(step.durations)
    stepped = np.asarray(step.outcome) == Outcome.STEPPED
    reach = _reach(some) / np.cos(y[:, 0])
    none = np.zeros(len(good))
    told = np.column_stack([d[:, 0], d[:, 1] + d[:, 2], none, reach, y])
    longer = (reach * np.tan(y[:, 0]))[:, None] * by.section_state[:, 0]
    both, first, second = np.moveaxis(by.durations, 1, 0)
    rows = [both, first + second, 0.0 * both, longer]
    moved = np.concatenate([np.stack(rows, 1), by.section_state], 1)
    gaits = _gaits(PAPER, x[good], y, told, by.section_state, moved)
    put(lower, good[stepped], Lower(*(part[stepped] for part in gaits)))
    lower.outcome[good[~stepped]] = np.asarray(step.outcome)[~stepped]
    return lower


def rigid_gaits(params: WheelParams) -> Lower:
    """Return the rigid gaits in closed form: rolling with the classic landing, whose rear foot
    leaves.

    Stiff legs with unilateral contact approach this gait. The paper's landing, whose rear foot is
    held, has a gait half as fast again.
    """
    x, y, length, duration, jacobian, slope = map(np.asarray, in_batches(_rolling, SHAPES, params))
    none = np.zeros_like(duration)
    told = np.column_stack([none, duration, none, length, y])
    flat = 0.0 * slope
    moved = np.concatenate([np.stack([flat, slope, flat, flat], 1), jacobian], 1)
    return _gaits(RIGID, x, y, told, jacobian, moved)


def contraction(params: WheelParams) -> np.ndarray:
    """Return the static contraction of a leg over its length, which is the order of the rigid
    model's error."""
    s = jax.tree.map(np.asarray, params.symbols())
    return s.Mt * s.g / (np.asarray(params.stiffness) * s.L0)


def _reach(params: WheelParams) -> np.ndarray:
    """Return the distance between both feet at touchdown, times cos(theta-): L0 sin(alpha), m."""
    return np.asarray(params.locked_length) * np.sin(params.leg_angle)


def _gaits(
    rung: int, x: np.ndarray, y: np.ndarray, told: np.ndarray, jacobian: np.ndarray,
    moved: np.ndarray,
) -> Lower:  # fmt: skip
    with np.errstate(all="ignore"):
        carry = np.linalg.inv(np.eye(3) - jacobian)
    own = np.einsum("ijk,ik->ij", carry, y - x)
    stepped = np.full(len(x), int(Outcome.STEPPED))
    return Lower(np.full(len(x), rung), x, told, carry, moved, own, stepped)


@jax.jit
def _rolling(params: WheelParams) -> tuple:
    model, options = RigidWheel(stop_at_lift_off=False), Options()

    def one(params: WheelParams) -> tuple:
        def take(x: jax.Array) -> tuple:
            step = model.step(params, x, options)
            return step.section_state, step.step_length, jnp.sum(step.durations)

        x = model.start(params)
        (y, length, duration), (jacobian, _, slope) = with_jacobian(take, x)
        return x, y, length, duration, jacobian, slope

    return jax.vmap(one)(params)
