"""Predict gaits by cubic polynomials that were fitted to the gaits of many wheels.

The prediction is the start of every search. Lengths are in units of L0, times in sqrt(L0 / g), and
masses in the total mass. The surface therefore covers wheels of any size.
`experiments/gaits/fit_surface.py` fitted the surface to gaits that a continuation from the wheel in
Table 1 of the paper reaches. The fit uses the mass ratio and the center of mass of that wheel, and
eight legs. For such wheels the prediction is accurate to about 1 %. For other wheels the parameters
are clipped to the range of the fit, and the prediction is the start of a homotopy.
"""

import functools
import importlib.resources
import itertools
import operator

import jax.numpy as jnp
import numpy as np

from vrw_jax.base.types import Elementwise
from vrw_jax.gaits.gauss import N_GAUSS_NODES, PhaseMesh, transfer_accelerations
from vrw_jax.gaits.phase_collocation import CollocationSolution
from vrw_jax.wheel.params import WheelParams
from vrw_jax.wheel.phases import PAPER_PHASES

GAIT_SURFACE_MESHES = (PhaseMesh(2, 1.0), PhaseMesh(4, 2.0), PhaseMesh(1, 1.0))
"""Meshes for the predicted accelerations in DLS, SLS-I and SLS-II."""
GAIT_SURFACE_DEGREE = 3
"""Degree of the polynomials whose coefficients are stored."""


@functools.cache
def load_gait_surface() -> dict[str, np.ndarray]:
    """Load the gait surface from the file `surface.npz` in this package.

    The arrays are the center, half range and limits of each coordinate, and the coefficients of
    the polynomials of the centered coordinates, of shape (monomials, unknowns).
    """
    surface_file = importlib.resources.files(__package__) / "surface.npz"
    with surface_file.open("rb") as surface_stream, np.load(surface_stream) as stored_arrays:
        return dict(stored_arrays)


def compute_time_unit(params: WheelParams) -> Elementwise:
    """Return the unit of time for a wheel, sqrt(L0 / g), s."""
    return jnp.sqrt(params.locked_length / params.gravity)


def compute_surface_coordinates(params: WheelParams) -> tuple[Elementwise, ...]:
    """Return the four dimensionless coordinates of a wheel on the gait surface.

    They are the square root of the damping, the stiffness, the natural length and the slope.
    """
    total_mass = params.hub_mass + params.n_legs * params.leg_mass
    return (
        jnp.sqrt(params.damping * compute_time_unit(params) / total_mass),
        params.stiffness * params.locked_length / (total_mass * params.gravity),
        params.natural_length / params.locked_length,
        params.slope,
    )


def evaluate_monomials(centered_surface_coordinates: tuple[Elementwise, ...]) -> list[Elementwise]:
    """Return all monomials of the coordinates up to the degree of the surface.

    The constant monomial is the first.
    """
    constant_monomial = jnp.ones_like(centered_surface_coordinates[0])
    return [
        functools.reduce(operator.mul, monomial_factors, constant_monomial)
        for monomial_degree in range(GAIT_SURFACE_DEGREE + 1)
        for monomial_factors in itertools.combinations_with_replacement(
            centered_surface_coordinates, monomial_degree
        )
    ]


def predict_gait(params: WheelParams, phase_meshes: tuple[PhaseMesh, ...]) -> CollocationSolution:
    """Predict the section state, the durations and the accelerations for the gait of each wheel.

    The accelerations belong to the nodes of `phase_meshes`. The wheels are on the last axis.
    """
    gait_surface = load_gait_surface()
    # Python floats do not change the dtype of the parameters.
    coordinate_ranges = (
        gait_surface[name].tolist() for name in ("centre", "spread", "lower", "upper")
    )
    centered_surface_coordinates = tuple(
        (jnp.clip(surface_coordinate, lower_bound, upper_bound) - coordinate_center) / half_range
        for surface_coordinate, coordinate_center, half_range, lower_bound, upper_bound in zip(
            compute_surface_coordinates(params), *coordinate_ranges, strict=True
        )
    )
    monomials = jnp.stack(evaluate_monomials(centered_surface_coordinates))
    predicted_surface_values = jnp.tensordot(
        jnp.asarray(gait_surface["coefficients"].T, monomials.dtype), monomials, 1
    )
    time_unit = compute_time_unit(params)
    section_state = jnp.stack(
        [predicted_surface_values[0], predicted_surface_values[1] / time_unit]
    )
    phase_durations = predicted_surface_values[None, 2:5] * time_unit
    # The coordinates are (theta, L1, L2).
    coordinate_units = jnp.stack(
        [jnp.ones_like(time_unit), params.locked_length, params.locked_length]
    )
    acceleration_units = coordinate_units / time_unit**2
    accelerations_by_phase = []
    first_value_index = 5
    for phase_class, surface_mesh, phase_mesh in zip(
        PAPER_PHASES, GAIT_SURFACE_MESHES, phase_meshes, strict=True
    ):
        n_coordinates = phase_class.n_dof
        n_values = surface_mesh.n_intervals * N_GAUSS_NODES * n_coordinates
        surface_accelerations = predicted_surface_values[
            first_value_index : first_value_index + n_values
        ].reshape(surface_mesh.n_intervals, N_GAUSS_NODES, n_coordinates, *monomials.shape[1:])
        first_value_index += n_values
        phase_accelerations = transfer_accelerations(
            surface_mesh, phase_mesh, surface_accelerations
        )
        accelerations_by_phase.append(
            (phase_accelerations * acceleration_units[:n_coordinates])[None]
        )
    return CollocationSolution(section_state, phase_durations, tuple(accelerations_by_phase))
