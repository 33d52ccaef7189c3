"""Measure how many solver steps lanes wait for the slowest lane of their group, by their order.

    python -m experiments.speed.straggler_steps [--lanes 4096] [--tolerance 6e-8]

A group of eight lanes goes through each phase together. The figure is the number of steps of its
slowest lane over the mean number of its lanes, which is 1 if none waits. The orders are: as given,
by c/m, that of `vrw.step_batch`, and by the steps of SLS-I themselves, which are not known before.
The experiment prints these figures, and fits of the steps of SLS-I, of which `work_order` has
rounded powers.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import format_markdown
from experiments.shared.wheels import draw_wheels_near_gaits, make_wheels
from experiments.speed.engines_agree import draw_wheels
from vrw_jax.models.step_batch import order_wheels_by_work
from vrw_jax.models.viscoelastic import run_batch_phases
from vrw_jax.wheel import PARAMETER_NAMES, make_wheel_from_parameters

GROUP, N_LEGS = 8, 8


@functools.partial(jax.jit, static_argnums=2)
def count_tried_steps(
    rows: jax.Array, states: jax.Array, solver: str, options: vrw.StepOptions
) -> jax.Array:
    """Return the solver steps that each lane tries in each phase, shape (3, lanes)."""
    options = dataclasses.replace(options, solver=solver)
    params = make_wheel_from_parameters(rows.T, N_LEGS)
    walk_result = run_batch_phases(params, states.T, options, True, False)
    return jnp.stack([end.solver_steps for end in walk_result.phase_end_results])


def draw_cases(n: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return parameters, shape (lanes, 9), and section states, by the name of each case."""
    selection, states, _ = draw_wheels_near_gaits(n)
    params, random = make_wheels(selection), np.random.default_rng(5)
    rows = np.stack([np.broadcast_to(getattr(params, name), n) for name in PARAMETER_NAMES], 1)
    return {
        "1 % from their gaits": (rows, states),
        "15 % from them": (rows, states * random.uniform(0.85, 1.15, states.shape)),
        "a wide box, of which a third steps": draw_wheels(n, 0),
    }


def columns_by_name(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the parameters by name, shape (lanes,) each."""
    return dict(zip(PARAMETER_NAMES, rows.T, strict=True))


def compute_group_steps(steps: np.ndarray, order: np.ndarray) -> float:
    groups = steps[:, order[: len(order) // GROUP * GROUP]].reshape(3, -1, GROUP)
    return float(groups.max(2).mean(1).sum() / steps.mean(1).sum())


def powers(rows: np.ndarray, states: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return fits of the logarithm of SLS-I's steps: powers of c/m, dtheta, k/m, factors of theta
    and Ls."""
    values_by_parameter = columns_by_name(rows)
    mass = values_by_parameter["leg_mass"]
    logs = [
        np.log(values_by_parameter["damping"] / mass),
        np.log(states[:, 1]),
        np.log(values_by_parameter["stiffness"] / mass),
    ]
    columns = np.stack(
        [*logs, states[:, 0], values_by_parameter["natural_length"], np.ones(len(rows))], 1
    )
    went = steps[1] > 0
    return np.linalg.lstsq(columns[went], np.log(steps[1][went]), rcond=None)[0][:5]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--tolerance", type=float, default=6e-8)
    chosen = parse_and_start_jax(parser)
    solver = vrw.StepOptions().solver
    options = vrw.StepOptions(rtol=chosen.tolerance, atol=chosen.tolerance)
    result, fits = [], []
    for scene, (rows, states) in draw_cases(chosen.lanes).items():
        steps = np.asarray(
            count_tried_steps(jnp.asarray(rows), jnp.asarray(states), solver, options)
        )
        values_by_parameter = columns_by_name(rows)
        orders = (
            np.arange(len(rows)),
            np.argsort(values_by_parameter["damping"] / values_by_parameter["leg_mass"]),
            order_wheels_by_work(list(rows.T), states),
            np.argsort(steps[1], kind="stable"),
        )
        result.append((scene, *(f"{compute_group_steps(steps, order):.2f}" for order in orders)))
        fit = powers(rows, states, steps)
        fits.append((scene, *(f"{x / fit[0]:.2f}" for x in fit)))
    table = format_markdown(
        ("wheels", "as given", "c/m", "`vrw.step_batch`", "SLS-I's steps"), result
    )
    print(table)
    print(format_markdown(("wheels", "c/m", "dtheta", "k/m", "theta", "Ls"), fits))


if __name__ == "__main__":
    main()
