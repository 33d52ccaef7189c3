"""Define numerical options of the search for limit cycles, and the margins that searches keep."""

import dataclasses
import functools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import check_int, check_positive, check_type, format_value
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.measures import MEASURES
from vrw_jax.wheel.params import WheelParams


@dataclasses.dataclass(frozen=True)
class CycleOptions:
    """Numerical options of `limit_cycle`.

    JAX compiles the search again whenever an option changes. With the defaults, relative errors are
    1e-9 in values and 1e-8 in first derivatives.

    - `mesh_intervals`: number of mesh intervals in each of DLS, SLS-I and SLS-II; the method has
      order 8;
    - `mesh_grading`: ratio of the last to the first mesh interval in SLS-I;
    - `tolerance`: largest norm of Newton's last correction, in units of the wheel;
    - `max_newton_iterations`: largest number of Newton iterations in one attempt;
    - `first_newton_iterations`: number of Newton iterations after which the wheels of a batch that
      need more iterations are gathered;
    - `homotopy_steps`: number of parameter steps in a homotopy from the wheel in Table 1 of the
      paper, which is used if the first attempt fails;
    - `batch_size`: number of wheels that are solved together.

    Examples:
        >>> vrw.CycleOptions(mesh_intervals=(20, 16, 6)).mesh_intervals  # a finer mesh
        (20, 16, 6)
    """

    mesh_intervals: tuple[int, int, int] = (10, 8, 3)
    mesh_grading: float = 2.0
    tolerance: float = 1e-10
    max_newton_iterations: int = 12
    first_newton_iterations: int = 4
    homotopy_steps: int = 12
    batch_size: int = 64

    def __post_init__(self) -> None:
        set_option = functools.partial(object.__setattr__, self)
        for option_name in (
            "max_newton_iterations",
            "first_newton_iterations",
            "homotopy_steps",
            "batch_size",
        ):
            set_option(option_name, check_int(option_name, getattr(self, option_name)))
        for option_name in ("mesh_grading", "tolerance"):
            set_option(option_name, check_positive(option_name, getattr(self, option_name)))
        if not isinstance(self.mesh_intervals, tuple | list) or len(self.mesh_intervals) != 3:
            raise ValueError(
                f"mesh_intervals is {format_value(self.mesh_intervals)}, but it counts the "
                f"intervals in "
                "DLS, SLS-I and SLS-II: "
                "give three whole numbers of at least 1, as (10, 8, 3)."
            )
        mesh_intervals = tuple(
            check_int(f"mesh_intervals[{i}]", interval_count)
            for i, interval_count in enumerate(self.mesh_intervals)
        )
        set_option("mesh_intervals", mesh_intervals)

    def check_tolerances(self, parameter_dtype: np.dtype) -> None:
        """Raise ValueError if the number format cannot resolve the tolerance.

        If `jax_enable_x64` is off, 64-bit parameters of a wheel are treated as 32-bit numbers, as
        in JAX.
        """
        jax_dtype = jax.dtypes.canonicalize_dtype(parameter_dtype)
        if self.tolerance < jnp.finfo(jax_dtype).eps:
            dtype_statement = (
                "the wheel holds"
                if jax_dtype == parameter_dtype
                else "jax_enable_x64 is off: JAX takes"
            )
            raise ValueError(
                f"{dtype_statement} {jax_dtype.name} numbers, in which no limit cycle is "
                f"found to {self.tolerance:g}: call vrw.start_jax() before WheelParams are made."
            )

    def refine_mesh(self) -> "CycleOptions":
        """Return options with about twice as many mesh intervals."""
        n_dls_intervals, n_sls1_intervals, n_sls2_intervals = self.mesh_intervals
        return dataclasses.replace(
            self,
            mesh_intervals=(
                2 * n_dls_intervals,
                2 * n_sls1_intervals,
                max(2 * n_sls2_intervals, n_sls1_intervals),
            ),
        )

    @classmethod
    def tight(cls) -> "CycleOptions":
        """Return options whose errors are about 1e-12 in values and 1e-10 in first derivatives."""
        return cls(mesh_intervals=(16, 20, 4), tolerance=1e-13)


DEFAULT_MARGIN_NAMES: tuple[str, ...] = (
    "fore_foot_force",
    "takeoff_acceleration",
    "clearance_sls1",
    "clearance_sls2",
    "locked_stopper_force",
    "rear_stopper_force",
    "contraction",
    "friction_fore",
    "lambda_I4",
    "lambda_2_plus",
    "lambda_4_plus",
)
"""Names of the margins (forces, clearances and indicators) that a search can keep positive."""

DEFAULT_MARGIN_SHARE = 1e-3
"""Default lower limit of a margin, as a fraction of the wheel's weight, leg length or gravity."""


@with_default_jax_settings
def default_margins(params: WheelParams) -> Mapping[str, float]:
    """Return the default lower limit for each margin in `DEFAULT_MARGIN_NAMES`.

    Each limit is a thousandth of the margin's natural scale for this wheel. The limits are above
    zero, because a search needs a distance from the boundary. At lambda_4_plus = 0, for example,
    the branch of gaits ends.

    Args:
        params: one wheel.

    Returns:
        Lower limits by the name of the margin, each in the unit of the margin.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> round(vrw.default_margins(vrw.WheelParams())["lambda_4_plus"], 3)
        0.177
    """
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    params.require_single_wheel("take one after the other")
    total_mass = float(params.hub_mass + params.n_legs * params.leg_mass)
    leg_length = float(params.locked_length)
    gravity_acceleration = float(params.gravity)
    margin_unit_values = {
        "N": total_mass * gravity_acceleration,
        "m": leg_length,
        "m/s^2": gravity_acceleration,
        "N s": total_mass * (gravity_acceleration * leg_length) ** 0.5,
        "1": 1.0,
    }
    return {
        margin_name: DEFAULT_MARGIN_SHARE * margin_unit_values[MEASURES[margin_name].unit]
        for margin_name in DEFAULT_MARGIN_NAMES
    }
