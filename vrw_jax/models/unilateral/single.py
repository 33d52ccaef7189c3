"""A single wheel on real ground by the machine code of lanes, within programs of JAX.

`told_by_lanes` is a function of one wheel that `jax.vmap` maps onto lanes; for derivatives each
direction is a lane of its own beside the wheel's motion.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.models.lane_step import by_argument
from vrw_jax.models.unilateral.along import walked_along
from vrw_jax.models.unilateral.lanes import Lean, Walk, Walked, told_like, walked
from vrw_jax.numerics import Forward, explicit_tableau, one_wheel
from vrw_jax.runtime import lane_function
from vrw_jax.wheel import parameters_of


class Setting(NamedTuple):
    """What a step depends on besides its arrays."""

    structure: Any  # of (wheel, params, x, options), whose leaves are the arrays
    detailed: bool

    def given(self, leaves: tuple[Array, ...]) -> tuple[Array, Array, Any]:
        """Columns and section states of lanes, and the other choices."""
        wheel, params, x, options = jax.tree.unflatten(self.structure, leaves)
        return jnp.stack([*parameters_of(params), wheel.friction]), x, (wheel, params, options)

    def walk(self, others: Any) -> Walk:
        """One step of lanes."""
        wheel, params, options = others
        tableau = explicit_tableau(options.solver)
        assert tableau is not None  # the caller looked
        rules = wheel.max_events, wheel.one_sided, wheel.by_paper, self.detailed
        return Walk(params.n_legs, 1, *rules, options, tableau)

    def like(self, *leaves: Array) -> tuple:
        """Trees of what is told."""
        params = self.given(leaves)[2][1]
        return _parted(told_like(params.n_legs, leaves[0].dtype, self.detailed))

    def told(self, *leaves: Array) -> tuple:
        """Of lanes, which the leaves have on their last axis."""
        columns, x, others = self.given(leaves)
        return _parted(walked(self.walk(others), columns, x))

    def told_along(self, leaves: tuple[Array, ...], ways: tuple[Array, ...]) -> tuple:
        """How its floats move along a direction of each lane, the floats, and the rest."""
        columns, x, others = self.given(leaves)
        d_columns, d_x = (rows[None] for rows in self.given(ways)[:2])
        one = jnp.ones_like(columns[0], jnp.int32)
        walk, moves = walked_along(self.walk(others), columns, x, d_columns, d_x, one)
        moves = jax.tree.map(lambda leaf: leaf[0], moves)
        return _parted(walk._replace(told=moves))[0], *_parted(walk)


def _parted(walk: Walked) -> tuple[Any, Any]:
    """Floats of a step and the rest: of all that it tells, or of an `Advance`'s four."""
    step = walk.told
    if isinstance(step, Lean):
        step = step.section_state, step.durations, walk.outcome, walk.tried
    return eqx.partition(step, eqx.is_inexact_array)


def told_by_lanes(structure: Any, detailed: bool) -> Forward:
    """The step over the leaves of (wheel, params, x, options), as `any_mode` takes it."""
    setting = Setting(structure, detailed)
    key = "step on real ground", str(structure), detailed
    return one_wheel(lane_function(setting.told, setting.like, key))


def moved_by_lanes(structure: Any, detailed: bool, moved: tuple[int, ...]) -> Forward:
    """(Jacobian by the leaves `moved`, floats) and the other outputs of `told_by_lanes`."""
    setting = Setting(structure, detailed)

    def like(leaves: tuple[Array, ...], _ways: tuple[Array, ...]) -> tuple:
        value, other = setting.like(*leaves)
        return value, value, other

    key = "step on real ground along directions", str(structure), detailed
    along = one_wheel(lane_function(setting.told_along, like, key))

    def jacobian(*leaves: Array) -> tuple:
        *others, options = jax.tree.unflatten(structure, leaves)
        leaves = tuple(jax.tree.leaves((*others, options.for_derivatives())))
        units = np.eye(sum(np.size(leaves[i]) for i in moved))
        ways, begin = [jnp.zeros_like(leaf) for leaf in leaves], 0
        for i in moved:
            rows = units[:, begin : (begin := begin + np.size(leaves[i]))]
            ways[i] = jnp.asarray(rows.reshape(-1, *jnp.shape(leaves[i])), leaves[i].dtype)
        axes = tuple(0 if i in moved else None for i in range(len(leaves)))
        columns, value, other = jax.vmap(along, (None, axes))(leaves, tuple(ways))
        value, other = jax.tree.map(lambda x: x[0], (value, other))
        return (by_argument(columns, leaves, moved), value), other

    return jacobian
