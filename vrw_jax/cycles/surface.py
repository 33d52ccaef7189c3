"""Prediction of gaits by a cubic surface fitted to the gaits of many wheels; the start of every
search.

Lengths are in L0, times in sqrt(L0 / g) and masses in the total mass, so that wheels of any size
are covered. The surface was fitted by experiments/gaits/fit_surface.py to the gaits that a
continuation from Table 1 reaches. The fit uses Table 1's mass ratio, center of mass and eight legs.
There it is accurate to about 1 %. Elsewhere it is clipped to its range and is a start for a
homotopy.
"""

import functools
import importlib.resources
import itertools
import operator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.numerics import N_NODES, Elementwise, Mesh, Solution, transfer_matrix
from vrw_jax.wheel import WheelParams

MESHES = (Mesh(2, 1.0), Mesh(4, 2.0), Mesh(1, 1.0))
"""Meshes of the surface's accelerations, for DLS, SLS-I and SLS-II."""
DIMENSIONS = (1, 3, 2)
DEGREE = 3


class Surface(NamedTuple):
    """Coefficients (monomial, unknown) over centered coordinates, and the range of the
    coordinates."""

    centre: np.ndarray
    spread: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    coefficients: np.ndarray


@functools.cache
def stored_surface() -> Surface:
    file = importlib.resources.files(__package__) / "surface.npz"
    with file.open("rb") as stream, np.load(stream) as arrays:
        return Surface(**{name: arrays[name] for name in Surface._fields})


def pace(params: WheelParams) -> Elementwise:
    """Return the wheel's unit of time, sqrt(L0 / g), s."""
    return jnp.sqrt(params.locked_length / params.gravity)


def coordinates(params: WheelParams) -> tuple[Elementwise, ...]:
    """Return the root of damping, stiffness, natural length and slope, unitless."""
    mass = params.hub_mass + params.n_legs * params.leg_mass
    length, gravity = params.locked_length, params.gravity
    return (
        jnp.sqrt(params.damping * pace(params) / mass),
        params.stiffness * length / (mass * gravity),
        params.natural_length / length,
        params.slope,
    )


def monomials(centred: tuple[Elementwise, ...]) -> list[Elementwise]:
    one = jnp.ones_like(centred[0])
    return [
        functools.reduce(operator.mul, factors, one)
        for degree in range(DEGREE + 1)
        for factors in itertools.combinations_with_replacement(centred, degree)
    ]


def gait_on_surface(params: WheelParams, meshes: tuple[Mesh, ...]) -> Solution:
    """Return section, durations and accelerations on `meshes` of the surface's gait, with lanes
    last."""
    fit = stored_surface()
    numbers = (x.tolist() for x in fit[:4])  # Python floats preserve the dtype of the parameters
    centred = tuple(
        (jnp.clip(x, low, high) - centre) / spread
        for x, centre, spread, low, high in zip(coordinates(params), *numbers, strict=True)
    )
    features = jnp.stack(monomials(centred))
    values = jnp.tensordot(jnp.asarray(fit.coefficients.T, features.dtype), features, 1)
    unit = pace(params)
    section = jnp.stack([values[0], values[1] / unit])
    durations = values[None, 2:5] * unit
    accelerations, first = [], 5
    for dim, own, mesh in zip(DIMENSIONS, MESHES, meshes, strict=True):
        size = own.n_steps * N_NODES * dim
        flat = values[first : first + size].reshape(-1, dim, *features.shape[1:])
        first += size
        matrix = jnp.asarray(transfer_matrix(own, mesh), features.dtype)
        scale = _acceleration_scale(dim, params, unit)
        moved = jnp.tensordot(matrix, flat, 1) * scale
        accelerations.append(moved.reshape(1, mesh.n_steps, N_NODES, *moved.shape[1:]))
    return Solution(section, durations, tuple(accelerations))


def _acceleration_scale(dim: int, params: WheelParams, unit: Elementwise) -> Array:
    """Return the units of the accelerations of (theta, L1, L2)."""
    angle = 1.0 / unit**2
    length = params.locked_length / unit**2
    return jnp.stack([angle, length, length][:dim])
