"""A walk with contacts as a labelled trajectory: every leg, every foot, every contact.

Of the unilateral wheel, and of the ladder, whose motion is told alike on both its rungs.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.models import (
    State,
    UnilateralTrajectory,
    directions,
    foot_heights,
    foot_places,
    kinetic_energy,
    potential_energy,
    unpack,
)
from vrw_jax.numerics import Options
from vrw_jax.results import CONTACTS
from vrw_jax.walks.samples import Stretches, Telling
from vrw_jax.wheel import Outcome, WheelParams

OF_WALK = ("time", "step", "hub_x", "hub_z", "theta", "dtheta")
ENERGIES = ("kinetic_energy", "gravitational_energy", "elastic_energy")


@eqx.filter_jit
def _columns(
    model: Any,
    params: WheelParams,
    x: Array,
    options: Options,
    n_samples: int,
) -> tuple[UnilateralTrajectory, dict[str, Array]]:
    """One step's trace and its quantities, shape (phase, sample) or (phase, sample, leg)."""
    s, trace = params.symbols(), model.trace(params, x, options, n_samples)

    def describe(y: State) -> dict[str, Array]:
        motion, _ = unpack(y)
        legs = directions(s, motion.theta)
        gravitational, elastic = potential_energy(s, motion)
        return {
            "hub_x": motion.x,
            "hub_z": motion.z,
            "theta": motion.theta,
            "dtheta": motion.dtheta,
            "kinetic_energy": kinetic_energy(s, motion),
            "gravitational_energy": gravitational,
            "elastic_energy": elastic,
            "length": motion.L,
            "length_rate": motion.dL,
            "foot_x": foot_places(motion, legs),
            "foot_z": foot_heights(motion, legs),
        }

    told = jax.vmap(jax.vmap(describe))(trace.state)
    return trace, told | {"tangential": trace.tangential, "normal": trace.normal}


def over_contacts(params: WheelParams, model: Any, options: Options, n_samples: int) -> Telling:
    """Steps over time and leg; legs bear the labels of their step.

    Each stretch between two events has `n_samples` times, both ends included. Of the ladder,
    `rung` and `reason` say for each time which rung served and why (see `ModelChoice`).
    """

    def stretches(x: Array) -> Stretches:
        trace, columns = jax.tree.map(np.array, _columns(model, params, x, options, n_samples))
        shape = (len(trace.duration), n_samples)
        over_samples = lambda legs: np.repeat(legs[:, None], n_samples, axis=1)
        columns |= {"time": trace.time, "contact": over_samples(trace.contact)}
        columns |= {name: np.full(shape, int(value)) for name, value in trace.served.items()}
        columns["on_stopper"] = over_samples(trace.locked)
        return Stretches(
            columns,
            trace.duration,
            Outcome(int(trace.outcome)),
            jnp.asarray(trace.section_state),
            float(trace.duration.sum()),
            float(trace.step_length),
        )

    attrs: dict[str, object] = {
        "frame": "x downhill along the slope, z normal to it, first landing at the origin",
        "friction": float(model.friction),
    }
    names = (*OF_WALK, *ENERGIES, *CONTACTS)
    legs = {"leg": np.arange(1, params.n_legs + 1)}
    return Telling(stretches, names, ("hub_x", "foot_x"), legs, attrs)
