"""Prediction of gaits by a cubic polynomial fitted to the gaits of many wheels, the start of every
search.

Lengths are in L0, times in sqrt(L0 / g) and masses in the total mass, so that wheels of any size
are covered. The polynomial surface was fitted by experiments/gaits/fit_surface.py to the gaits that
a continuation from Table 1 reaches. The fit uses Table 1's mass ratio, center of mass and eight
legs, for which it is accurate to about 1 %. For other wheels it is clipped to its range and is the
start of a homotopy.
"""

import functools
import importlib.resources
import itertools
import operator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.collocation import N_GAUSS_NODES, CollocationSolution, PhaseMesh, mesh_transfer_matrix
from vrw_jax.numerics import Elementwise
from vrw_jax.wheel import PAPER_PHASES, WheelParams

SURFACE_MESHES = (PhaseMesh(2, 1.0), PhaseMesh(4, 2.0), PhaseMesh(1, 1.0))
"""Meshes of the surface's accelerations for DLS, SLS-I and SLS-II."""
SURFACE_DEGREE = 3
"""Degree of the surface's polynomials, that of the stored coefficients."""


class GaitSurface(NamedTuple):
    """Polynomial coefficients (monomial, unknown) in centered coordinates, and the range of the
    coordinates.
    """

    centre: np.ndarray
    spread: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    coefficients: np.ndarray


@functools.cache
def load_surface() -> GaitSurface:
    """Return the surface that is stored beside this file."""
    file = importlib.resources.files(__package__) / "surface.npz"
    with file.open("rb") as stream, np.load(stream) as arrays:
        return GaitSurface(**{name: arrays[name] for name in GaitSurface._fields})


def time_unit(params: WheelParams) -> Elementwise:
    """Return the wheel's own unit of time, sqrt(L0 / g), s."""
    return jnp.sqrt(params.locked_length / params.gravity)


def surface_coordinates(params: WheelParams) -> tuple[Elementwise, ...]:
    """Return the coordinates of the surface: root of damping, stiffness, natural length and
    slope, dimensionless.
    """
    mass = params.hub_mass + params.n_legs * params.leg_mass
    length, gravity = params.locked_length, params.gravity
    return (
        jnp.sqrt(params.damping * time_unit(params) / mass),
        params.stiffness * length / (mass * gravity),
        params.natural_length / length,
        params.slope,
    )


def evaluate_monomials(centered_coordinates: tuple[Elementwise, ...]) -> list[Elementwise]:
    """Return all monomials of the coordinates up to the surface's degree, the constant first."""
    ones = jnp.ones_like(centered_coordinates[0])
    return [
        functools.reduce(operator.mul, factors, ones)
        for degree in range(SURFACE_DEGREE + 1)
        for factors in itertools.combinations_with_replacement(centered_coordinates, degree)
    ]


def predict_gait(params: WheelParams, meshes: tuple[PhaseMesh, ...]) -> CollocationSolution:
    """Return the predicted section state, durations and accelerations at the nodes of `meshes`,
    lanes last.
    """
    surface = load_surface()
    # Python floats preserve the dtype of the parameters.
    ranges = (x.tolist() for x in surface[:4])
    centered_coordinates = tuple(
        (jnp.clip(x, lower, upper) - center) / spread
        for x, center, spread, lower, upper in zip(
            surface_coordinates(params), *ranges, strict=True
        )
    )
    monomials = jnp.stack(evaluate_monomials(centered_coordinates))
    values = jnp.tensordot(jnp.asarray(surface.coefficients.T, monomials.dtype), monomials, 1)
    time_scale = time_unit(params)
    section = jnp.stack([values[0], values[1] / time_scale])
    durations = values[None, 2:5] * time_scale
    accelerations, start_index = [], 5
    for phase, surface_mesh, mesh in zip(PAPER_PHASES, SURFACE_MESHES, meshes, strict=True):
        n_coordinates = phase.n_dof
        n_values = surface_mesh.n_intervals * N_GAUSS_NODES * n_coordinates
        surface_accelerations = values[start_index : start_index + n_values].reshape(
            -1, n_coordinates, *monomials.shape[1:]
        )
        start_index += n_values
        matrix = jnp.asarray(mesh_transfer_matrix(surface_mesh, mesh), monomials.dtype)
        # These are the units of the accelerations of (theta, L1, L2).
        angle_scale = 1.0 / time_scale**2
        length_scale = params.locked_length / time_scale**2
        acceleration_units = jnp.stack([angle_scale, length_scale, length_scale][:n_coordinates])
        phase_accelerations = jnp.tensordot(matrix, surface_accelerations, 1) * acceleration_units
        accelerations.append(
            phase_accelerations.reshape(
                1, mesh.n_intervals, N_GAUSS_NODES, *phase_accelerations.shape[1:]
            )
        )
    return CollocationSolution(section, durations, tuple(accelerations))
