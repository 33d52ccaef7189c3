"""Types of quantities in signatures: a scalar, an array of any axes, a tuple of components."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float, Inexact

Scalar = Float[Array, ""]
if TYPE_CHECKING:
    Elementwise = Array
else:
    Elementwise = Inexact[Array, "..."] | Inexact[np.ndarray, "..."] | float
"""Quantity with any leading axes, because formulas below `scans` act element by element.

Complex numbers are allowed too, because a complex-step derivative needs them.
"""

Vector = tuple[Elementwise, ...]
"""Tuple with one array for each component."""


RealInput = float | Array | np.ndarray
"""Real number as a caller gives it, or an array of numbers."""
