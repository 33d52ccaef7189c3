"""The high-precision truth of tests/oracle/truth.json as arrays; its generator stands beside it."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams

REFERENCE_CASES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "oracle" / "truth.json").read_text()
)["cases"]


def to_floats(value: Any) -> np.ndarray:
    """Nested lists of decimal strings as float64."""
    return np.asarray(value, dtype=float)


def stack_quantity(part: str, key: str) -> np.ndarray:
    """One quantity of every case, cases first."""
    return np.stack([to_floats(case[part][key]) for case in REFERENCE_CASES])


REFERENCE_PARAMETERS = np.stack(
    [[float(case["params"][name]) for name in PARAMETER_NAMES] for case in REFERENCE_CASES]
)
"""Parameters of every case, in the order of `PARAMETER_NAMES`; all have eight legs."""


def make_wheel(vector: Any) -> WheelParams:
    """Parameters from a vector in the order of `PARAMETER_NAMES`."""
    return WheelParams(**dict(zip(PARAMETER_NAMES, vector, strict=True)))


def make_wheels(matrix: Any) -> WheelParams:
    """A batch of parameters from rows."""
    return make_wheel(jnp.asarray(matrix).T)


def compute_scaled_error(values: Any, reference: np.ndarray) -> float:
    """Largest error, relative where the truth exceeds 1."""
    return float(
        np.max(np.abs(np.asarray(values) - reference) / np.maximum(np.abs(reference), 1.0))
    )
