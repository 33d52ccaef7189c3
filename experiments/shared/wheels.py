"""Draw random wheels and starts near their gaits."""

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw

PARAMETER_BOX = {
    "damping": (100.0, 215.0),
    "stiffness": (400.0, 600.0),
    "natural_length": (1.01, 1.04),
    "slope": (0.28, 0.34),
}
"""Ranges of four parameters in SI units. Six in ten of their wheels have a gait with double
support."""

WIDE_BOX = PARAMETER_BOX | {"damping": (20.0, 215.0), "slope": (0.26, 0.34)}
"""Wider ranges of damping and slope. Seven in ten of their wheels have a gait."""


def draw_parameter_rows(
    box: dict[str, tuple[float, float]], n: int, random: np.random.Generator
) -> np.ndarray:
    """Return uniform random parameters, shape (n, number of parameters of the box)."""
    return np.stack([random.uniform(*limits, n) for limits in box.values()], 1)


def make_wheels(rows: jax.Array | np.ndarray) -> vrw.WheelParams:
    """Return the wheels of parameter rows, with all other parameters of Table 1."""
    return vrw.WheelParams(**dict(zip(PARAMETER_BOX, jnp.asarray(rows).T, strict=True)))


def draw_wheels_near_gaits(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return parameters, starts 1 % off each wheel's gait, and reference results of one step.

    The reference is the end state and the durations by diffrax at the tightest tolerances. Shapes
    (n, 4), (n, 3) and (n, 6).
    """
    random = np.random.default_rng(1)
    cycle = jax.jit(jax.vmap(lambda row: vrw.limit_cycle(make_wheels(row))))
    rows, states, references = np.empty((0, 4)), np.empty((0, 3)), np.empty((0, 6))
    while len(rows) < n:
        candidates = draw_parameter_rows(PARAMETER_BOX, 1024, random)
        solution = cycle(candidates)
        start = np.asarray(solution.section_state) * (1.0 + random.uniform(-0.01, 0.01, (1024, 3)))
        step = vrw.step_batch(
            make_wheels(candidates), start, options=vrw.StepOptions.tight(), engine="diffrax"
        )
        is_selected = (solution.outcome == 0) & (step.outcome == 0) & (step.durations[:, 0] > 0.0)
        exact = np.concatenate([step.section_state, step.durations], 1)
        rows, states, references = (
            np.concatenate([a, b[is_selected]])
            for a, b in ((rows, candidates), (states, start), (references, exact))
        )
    return rows[:n], states[:n], references[:n]
