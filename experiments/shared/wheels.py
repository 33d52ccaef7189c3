"""Random wheels near their own gaits, and what a step of each is."""

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw

BOX = {
    "damping": (100.0, 215.0),
    "stiffness": (400.0, 600.0),
    "natural_length": (1.01, 1.04),
    "slope": (0.28, 0.34),
}
"""Six wheels in ten have a gait with double support."""

WIDE_BOX = BOX | {"damping": (20.0, 215.0), "slope": (0.26, 0.34)}
"""Seven in ten have a gait."""


def draw_parameter_rows(
    box: dict[str, tuple[float, float]], n: int, random: np.random.Generator
) -> np.ndarray:
    """Parameters of some wheels, a row each."""
    return np.stack([random.uniform(*limits, n) for limits in box.values()], 1)


def make_wheels(rows: jax.Array | np.ndarray) -> vrw.WheelParams:
    """Wheels of rows over a box; the rest of Table 1."""
    return vrw.WheelParams(**dict(zip(BOX, jnp.asarray(rows).T, strict=True)))


def draw_wheels_near_gaits(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of parameters, section states 1 % off each one's gait, and the truth of their step."""
    random = np.random.default_rng(1)
    cycle = jax.jit(jax.vmap(lambda row: vrw.limit_cycle(make_wheels(row))))
    rows, states, truth = np.empty((0, 4)), np.empty((0, 3)), np.empty((0, 6))
    while len(rows) < n:
        selection = draw_parameter_rows(BOX, 1024, random)
        solution = cycle(selection)
        start = np.asarray(solution.section_state) * (1.0 + random.uniform(-0.01, 0.01, (1024, 3)))
        step = vrw.step_batch(
            make_wheels(selection), start, options=vrw.StepOptions.tight(), engine="diffrax"
        )
        full_values = (solution.outcome == 0) & (step.outcome == 0) & (step.durations[:, 0] > 0.0)
        exact = np.concatenate([step.section_state, step.durations], 1)
        rows, states, truth = (
            np.concatenate([a, b[full_values]])
            for a, b in ((rows, selection), (states, start), (truth, exact))
        )
    return rows[:n], states[:n], truth[:n]
