"""Fit the stored surface of guesses: a cubic in four unitless numbers.

    python -m experiments.gaits.fit_surface

The cubic predicts gaits to about one percent. The reference is the half of the gaits that the fit
omits. The command writes `vrw_jax/gaits/surface.npz`, from which `limit_cycle` takes its start.
"""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from vrw_jax.gaits import N_GAUSS_NODES, CollocationSolution, phase_sequence
from vrw_jax.gaits import collocation_search as search
from vrw_jax.lanes import apply_function_in_blocks
from vrw_jax.wheel import PARAMETER_NAMES, make_wheel_from_parameters, stack_parameters

PARAMETER_BOX = {
    "damping": (15.0, 219.0),
    "stiffness": (390.0, 620.0),
    "natural_length": (1.008, 1.042),
    "slope": (0.255, 0.345),
}
N_WHEELS, N_STAGES, SEED = 8192, 80, 5
GAIT_OF_TABLE_1 = ((-0.6827, 1.0492), (0.4343, 0.3330, 0.0497))
SURFACE_PATH = Path(phase_sequence.__file__).with_name("surface.npz")


def find_gaits_by_continuation(
    problem: search.CollocationSystem, parameters: jax.Array
) -> search.CycleSearchResult:
    """Return gaits found by a homotopy of the parameters from Table 1."""

    def search_from_table_1(parameters: jax.Array) -> search.CycleSearchResult:
        lanes = parameters.shape[-1:]
        table_1_parameters = stack_parameters(vrw.WheelParams())[:, None]
        section, durations = (
            jnp.broadcast_to(jnp.asarray(x)[:, None], (len(x), *lanes)) for x in GAIT_OF_TABLE_1
        )
        accelerations = tuple(
            jnp.zeros((1, mesh.n_intervals, N_GAUSS_NODES, phase.n_coordinates, *lanes))
            for phase, mesh in zip(problem.phase_sequence.phases, problem.phase_meshes, strict=True)
        )
        start = search.CollocationState.make_start(
            CollocationSolution(section, durations[None], accelerations),
            jnp.ones((1, *durations.shape)),
        )
        table_1_parameters = jnp.broadcast_to(table_1_parameters, parameters.shape)
        stages = jnp.int32(N_STAGES)
        pending = jnp.ones(lanes, bool)
        limit = problem.cycle_options.max_newton_iterations
        return search.run_newton_iterations(
            problem, parameters, start, table_1_parameters, stages, limit, pending
        )

    return jax.jit(apply_function_in_blocks(search_from_table_1, 64))(parameters)


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    steps = tuple(mesh.n_intervals for mesh in phase_sequence.GAIT_SURFACE_MESHES)
    options = dataclasses.replace(
        vrw.CycleOptions(), max_newton_iterations=20, mesh_intervals=steps
    )
    problem = search.CollocationSystem(8, 1, options)
    table_1 = vrw.WheelParams()
    parameters = np.tile(np.asarray(stack_parameters(table_1))[:, None], (1, N_WHEELS))
    generator = np.random.default_rng(SEED)
    for name, (low, high) in PARAMETER_BOX.items():
        parameters[PARAMETER_NAMES.index(name)] = generator.uniform(low, high, N_WHEELS)
    search_result = find_gaits_by_continuation(problem, jnp.asarray(parameters))
    is_found = np.asarray(search_result.collocation_state.has_cycle) > 0.5
    solution = search_result.collocation_state.solution
    time_unit = float(phase_sequence.compute_time_unit(table_1))  # L0 = 1 m in Table 1.
    rows = [
        solution.section_state[0],
        solution.section_state[1] * time_unit,
        *(solution.durations[0] / time_unit),
    ]
    for block in solution.accelerations:
        rows.extend(np.asarray(block).reshape(-1, N_WHEELS) * time_unit**2)
    unknowns = np.stack([np.asarray(row) for row in rows])[:, is_found]

    wheels = make_wheel_from_parameters(jnp.asarray(parameters[:, is_found]), 8)
    coordinates = np.stack(
        [np.asarray(x) for x in phase_sequence.compute_surface_coordinates(wheels)]
    )
    centre, spread = coordinates.mean(1), coordinates.std(1)
    features = np.stack(
        [
            np.asarray(x)
            for x in phase_sequence.evaluate_monomials(
                tuple((coordinates - centre[:, None]) / spread[:, None])
            )
        ]
    )
    is_fitted, is_checked = (np.arange(features.shape[1]) % 2 == k for k in (0, 1))
    fit = functools.partial(np.linalg.lstsq, rcond=None)
    half_fit = fit(features[:, is_fitted].T, unknowns[:, is_fitted].T)[0]
    error = np.abs(half_fit.T @ features[:, is_checked] - unknowns[:, is_checked])
    print(
        f"{is_found.sum()} gaits of {N_WHEELS} wheels; errors on those left out, 99th percentile:"
    )
    print("  theta+, dtheta+, durations:", np.quantile(error[:5], 0.99, axis=1).round(4))
    np.savez(
        SURFACE_PATH,
        centre=centre,
        spread=spread,
        lower=coordinates.min(1),
        upper=coordinates.max(1),
        coefficients=fit(features.T, unknowns.T)[0].astype(np.float32),
    )
    print("wrote", SURFACE_PATH)


if __name__ == "__main__":
    main()
