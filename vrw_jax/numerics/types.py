"""Quantities in signatures: one number, one for each of any axes, one array for each component."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

Scalar = Float[Array, ""]
if TYPE_CHECKING:
    Elementwise = Array
else:
    Elementwise = Inexact[Array, "..."] | float
"""A quantity that may carry any leading axes: formulas below `scans` act element by element.

Complex where a derivative is taken by complex step (see cycles.derivatives)."""

Vector = tuple[Elementwise, ...]
"""One quantity for each component."""


def as_float_array(value: object) -> Array:
    """A strongly typed floating-point array; Python numbers take JAX's default float type."""
    array = jnp.asarray(value)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))
    return jax.lax.convert_element_type(array, np.dtype(array.dtype))
