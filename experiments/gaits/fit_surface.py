"""A cubic in four unitless numbers predicts gaits to about one percent: fits the stored surface.

    python -m experiments.gaits.fit_surface

Writes `vrw_jax/cycles/surface.npz`, where `limit_cycle` finds its start.
"""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from vrw_jax.cycles import collocation_search as search
from vrw_jax.cycles import gait_surface as surface
from vrw_jax.numerics import make_blockwise
from vrw_jax.wheel import PARAMETER_NAMES, stack_parameters, wheel_from_parameters

BOX = {
    "damping": (15.0, 219.0),
    "stiffness": (390.0, 620.0),
    "natural_length": (1.008, 1.042),
    "slope": (0.255, 0.345),
}
N_WHEELS, N_STAGES, SEED = 8192, 80, 5
GAIT_OF_TABLE_1 = ((-0.6827, 1.0492), (0.4343, 0.3330, 0.0497))
TARGET = Path(surface.__file__).with_name("surface.npz")


def reached_by_continuation(problem: search.CollocationSystem, parameters: jax.Array) -> object:
    """Gaits found by moving the parameters from Table 1 in small stages."""

    def continued(parameters: jax.Array) -> search.SearchResult:
        lanes = parameters.shape[-1:]
        home = stack_parameters(vrw.WheelParams())[:, None]
        section, durations = (
            jnp.broadcast_to(jnp.asarray(x)[:, None], (len(x), *lanes)) for x in GAIT_OF_TABLE_1
        )
        start = search.make_start(problem, section, durations, jnp.ones(lanes, bool))
        home = jnp.broadcast_to(home, parameters.shape)
        stages = jnp.int32(N_STAGES)
        pending = jnp.ones(lanes, bool)
        limit = problem.options.max_newton_iterations
        return search.run_newton(problem, parameters, start, home, stages, limit, pending)

    return jax.jit(make_blockwise(continued, 64))(parameters)


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    steps = tuple(mesh.n_intervals for mesh in surface.SURFACE_MESHES)
    options = dataclasses.replace(
        vrw.CycleOptions(), max_newton_iterations=20, mesh_intervals=steps
    )
    problem = search.CollocationSystem(8, 1, options)
    table_1 = vrw.WheelParams()
    parameters = np.tile(np.asarray(stack_parameters(table_1))[:, None], (1, N_WHEELS))
    generator = np.random.default_rng(SEED)
    for name, (low, high) in BOX.items():
        parameters[PARAMETER_NAMES.index(name)] = generator.uniform(low, high, N_WHEELS)
    finding = reached_by_continuation(problem, jnp.asarray(parameters))
    solution_values = np.asarray(finding.located.found) > 0.5
    solution = finding.located.solution
    unit = float(surface.time_unit(table_1))  # L0 is 1 m
    rows = [solution.section[0], solution.section[1] * unit, *(solution.durations[0] / unit)]
    for block in solution.accelerations:
        rows.extend(np.asarray(block).reshape(-1, N_WHEELS) * unit**2)
    unknowns = np.stack([np.asarray(row) for row in rows])[:, solution_values]

    wheels = wheel_from_parameters(jnp.asarray(parameters[:, solution_values]), 8)
    places = np.stack([np.asarray(x) for x in surface.surface_coordinates(wheels)])
    centre, spread = places.mean(1), places.std(1)
    features = np.stack(
        [
            np.asarray(x)
            for x in surface.evaluate_monomials(tuple((places - centre[:, None]) / spread[:, None]))
        ]
    )
    fitted, checked = (np.arange(features.shape[1]) % 2 == k for k in (0, 1))
    fit = functools.partial(np.linalg.lstsq, rcond=None)
    half = fit(features[:, fitted].T, unknowns[:, fitted].T)[0]
    error = np.abs(half.T @ features[:, checked] - unknowns[:, checked])
    print(
        f"{solution_values.sum()} gaits of {N_WHEELS} wheels; errors on those left out, 99th "
        f"percentile:"
    )
    print("  theta+, dtheta+, durations:", np.quantile(error[:5], 0.99, axis=1).round(4))
    np.savez(
        TARGET,
        centre=centre,
        spread=spread,
        lower=places.min(1),
        upper=places.max(1),
        coefficients=fit(features.T, unknowns.T)[0].astype(np.float32),
    )
    print("wrote", TARGET)


if __name__ == "__main__":
    main()
