"""Arrays of the values in `tests/reference_code/reference_values.json`.

`reference_code.make_reference_values` generates that file.
"""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vrw_jax import WheelParams
from vrw_jax.wheel import PARAMETER_NAMES

REFERENCE_CASES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "reference_code" / "reference_values.json").read_text()
)["cases"]


def to_floats(value: Any) -> np.ndarray:
    """Return nested lists of decimal strings as a float64 array."""
    return np.asarray(value, dtype=float)


def stack_quantity(part: str, key: str) -> np.ndarray:
    """Return one quantity of all cases, with the cases along the first axis."""
    return np.stack([to_floats(case[part][key]) for case in REFERENCE_CASES])


REFERENCE_PARAMETERS = np.stack(
    [[float(case["params"][name]) for name in PARAMETER_NAMES] for case in REFERENCE_CASES]
)
"""Parameters of every case, in the order of `PARAMETER_NAMES`; all have eight legs."""


def make_wheel(vector: Any) -> WheelParams:
    """Return the parameters from a vector in the order of `PARAMETER_NAMES`."""
    return WheelParams(**dict(zip(PARAMETER_NAMES, vector, strict=True)))


def make_wheels(matrix: Any) -> WheelParams:
    """Return a batch of parameters from rows."""
    return make_wheel(jnp.asarray(matrix).T)


def compute_scaled_error(values: Any, reference: np.ndarray) -> float:
    """Return the largest error, relative if the reference exceeds 1."""
    return float(
        np.max(np.abs(np.asarray(values) - reference) / np.maximum(np.abs(reference), 1.0))
    )
