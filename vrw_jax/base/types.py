"""Types of quantities in signatures: scalars, arrays with any axes, and tuples of components."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float, Inexact

Scalar = Float[Array, ""]
if TYPE_CHECKING:
    Elementwise = Array
else:
    Elementwise = Inexact[Array, "..."] | Inexact[np.ndarray, "..."] | float
"""Quantity with any leading axes, because formulas in lower layers than `studies` act element by
element.

Complex numbers are also allowed, because complex-step derivatives need them.
"""

Vector = tuple[Elementwise, ...]
"""Tuple with one array per component."""


RealInput = float | Array | np.ndarray
"""Real number in any form that users may pass, or an array of numbers."""
