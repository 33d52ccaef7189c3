"""A walk as a labelled trajectory: motion, forces, energy and points, with units and origin.

The slope's frame: x downhill along the slope, z normal to it; the first foot stands at the origin.
Angles and leg labels are those of the present step, so theta and the lengths jump at a landing.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.models import SERVED, AbstractWheel, SectionState, Trajectory
from vrw_jax.numerics import Engine, Options
from vrw_jax.results import TRAJECTORY, provenance, variables
from vrw_jax.runtime import xarray as xr
from vrw_jax.walks.ground_trajectory import over_contacts
from vrw_jax.walks.samples import Stretches, Telling, joined
from vrw_jax.walks.stepping import ModelLike, SectionLike, checked, one_wheel, rung_of
from vrw_jax.wheel import (
    Motion,
    Outcome,
    WheelParams,
    damping_power,
    landing_direction,
    rear_direction,
)
from vrw_jax.wording import untraced, whole


@eqx.filter_jit
def _columns(
    model: AbstractWheel, params: WheelParams, x: SectionState, options: Options, n_samples: int
) -> tuple[Trajectory, dict[str, Array]]:
    """One step, also by the names of `TRAJECTORY`, (phase, sample), Leg 1's foot at the origin.

    `ahead` is added: where the landing leg stands or will stand, m.
    """
    s, moved = params.symbols(), model.trace(params, x, options, n_samples)
    theta, L1, L2, dtheta, dL1, dL2 = jnp.moveaxis(moved.state, -1, 0)
    kinetic, gravitational, elastic = jnp.moveaxis(moved.energy, -1, 0)
    motion = Motion.of(theta, L1, L2, dtheta, dL1, dL2)
    rear = rear_direction(s, motion.sin, motion.cos)
    hub_x, hub_z, zero = L1 * motion.sin, L1 * motion.cos, jnp.zeros_like(L1)
    return moved, {
        "time": moved.time,
        "x": zero,
        "z": zero,
        "theta": theta,
        "L1": L1,
        "L2": L2,
        "dx": zero,
        "dz": zero,
        "dtheta": dtheta,
        "dL1": dL1,
        "dL2": dL2,
        **{f"lambda_{i + 1}": moved.forces[..., i] for i in range(4)},
        "kinetic_energy": kinetic,
        "gravitational_energy": gravitational,
        "elastic_energy": elastic,
        "total_energy": kinetic + gravitational + elastic,
        "damping_power": damping_power(s, motion),
        "foot_1_x": zero,
        "foot_1_z": zero,
        "foot_2_x": hub_x - L2 * rear.sin,
        "foot_2_z": hub_z - L2 * rear.cos,
        "hub_x": hub_x,
        "hub_z": hub_z,
        "ahead": hub_x - s.L0 * landing_direction(s, motion.sin, motion.cos).sin,
    }


def simulate(
    params: WheelParams,
    x: SectionLike | None = None,
    n_steps: int = 10,
    *,
    model: ModelLike | None = None,
    options: Options | None = None,
    engine: Engine = "auto",
    n_samples: int = 100,
) -> xr.Dataset:
    """Walk `n_steps` steps from the section state `x`, as a labelled trajectory over time.

    Without `x` the walk begins at the rung's own start, near the gait of Table 1.

    Each phase has `n_samples` equal times, both ends included: an instant at which something jumps
    stands there twice, just before and just after it. A step that fails ends the trajectory at the
    event; the attributes `outcome` and `outcome_meaning` say why. Errors as in `vrw.step`.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, rad, rad/s, m/s.
        n_steps: at most so many.
        model: the rung; the paper's, `ViscoelasticWheel()`, by default, "auto" for the lowest that
            serves.
        options: numerical choices of the steps.
        engine: who takes the steps, see `Options`.
        n_samples: times of each phase, both ends included, at least 2.

    Returns:
        A dataset over `time`: coordinates, rates, feet, forces and energies, with units;
        on real ground of each `leg`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> walk = vrw.simulate(vrw.WheelParams(damping=150.0), n_steps=1)
        >>> walk.lambda_2.attrs["units"], walk.attrs["outcome"]
        ('N', 'STEPPED')
    """
    untraced("vrw.simulate", "use vrw.walk", params, x)
    n_steps, n_samples = whole("n_steps", n_steps), whole("n_samples", n_samples, 2)
    one_wheel(params, "simulate one at a time")
    start = rung_of(model).start(params) if x is None else x
    params, x, model, options = checked(params, start, model, options, engine)
    sampled = over_contacts if model.tells_contacts else over_phases
    telling = sampled(params, model, options, n_samples)
    s = jax.tree.map(float, params).symbols()
    told = joined(telling, x, n_steps, float(s.Mt * s.g * s.sin_phi))
    columns = told.columns
    data = variables({name: columns[name] for name in telling.names}, "time")
    for name in filter(columns.__contains__, SERVED):
        data[name] = xr.Variable("time", columns[name], SERVED[name])
    attrs = {
        "title": f"Walk of the {type(model).__name__}",
        "n_steps": told.n_stepped,
        "outcome": told.outcome.name,
        "outcome_meaning": told.outcome.meaning,
        "start": [float(v) for v in x],
    }
    origin = telling.attrs | provenance(params, model, options)
    walked = xr.Dataset(data, telling.labels, attrs | origin)
    return walked.set_coords([name for name in ("step", "phase") if name in data])


def over_phases(
    params: WheelParams, model: AbstractWheel, options: Options, n_samples: int
) -> Telling:
    """Of rungs that step through the paper's phases."""

    def stretches(x: Array) -> Stretches:
        moved, told = _columns(model, params, x, options, n_samples)
        columns, durations = jax.tree.map(np.array, told), np.asarray(moved.durations)
        ahead = columns.pop("ahead")
        columns["phase"] = np.tile(np.arange(len(durations))[:, None], (1, n_samples))
        happened = np.flatnonzero(durations > 0.0)
        length = float(ahead[happened[-1], -1]) if happened.size else 0.0
        return Stretches(
            columns,
            durations,
            Outcome(int(moved.outcome)),
            moved.section_state,
            float(durations.sum()),
            length,
        )

    attrs: dict[str, object] = {
        "frame": "x downhill along the slope, z normal to it, first foot at the origin",
        "start_meaning": "theta-, dtheta-, dL1- just before the first landing, rad, rad/s, m/s",
    }
    return Telling(stretches, tuple(TRAJECTORY), ALONG, {}, attrs)


ALONG = ("x", "foot_1_x", "foot_2_x", "hub_x")
"""Columns that are places along the slope."""
