"""Quantities in signatures: one number, one for each of any axes, one array for each component."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float, Inexact

Scalar = Float[Array, ""]
if TYPE_CHECKING:
    Elementwise = Array
else:
    Elementwise = Inexact[Array, "..."] | Inexact[np.ndarray, "..."] | float
"""A quantity that may carry any leading axes: formulas below `scans` act element by element.

Complex numbers go through too, as for a complex step."""

Vector = tuple[Elementwise, ...]
"""One quantity for each component."""


Number = float | Array | np.ndarray
"""A number as a caller gives it, or an array of them."""
