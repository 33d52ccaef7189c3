"""Basins of the gaits along a branch."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from vrw_jax.batches import step_batch
from vrw_jax.branches import Branch
from vrw_jax.measures import measure_attrs
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import StepOptions
from vrw_jax.robustness.basin_share import StartBox, compute_basin_share, parse_box
from vrw_jax.robustness.gait_arrival import StableGait
from vrw_jax.robustness.smallest_disturbance import compute_smallest_disturbance
from vrw_jax.runtime import with_default_settings
from vrw_jax.runtime import xarray as xr
from vrw_jax.simulation import ModelLike, check_model, check_options
from vrw_jax.validation import check_int, check_type
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams

VARIABLE_ATTRS = {
    "basin_share": ("1", "share of the box of starts that ends up on the gait"),
    "basin_share_error": ("1", "standard error of that share"),
    "smallest_disturbance": ("rad/s", "smallest change of dtheta that leaves the basin"),
    "smallest_disturbance_error": ("rad/s", "error of that change"),
}
"""Unit and meaning of each variable of the result."""


@with_default_settings
def measure_basins(
    branch: Branch,
    box: StartBox | None = None,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    n_points: int = 16,
    n_starts: int = 1024,
    max_steps: int = 200,
) -> xr.Dataset:
    """Return the sizes of the basins of the stable gaits along a branch.

    The result has `n_points` points of the branch, evenly spaced over its points, both ends
    included. Its coordinate is the parameter of the branch. Numbers of unstable gaits are NaN. With
    a `box`, the variables include `basin_share` and `basin_share_error` (see `basin_share`). For
    models that can begin within a step, they include `smallest_disturbance` and
    `smallest_disturbance_error`, rad/s (see the function of that name).

    Args:
        branch: a branch of gaits of one step, from `continue_branch`.
        box: bounds of the starts, as in `basin_share`; None leaves the shares out.
        model: the model of the branch, if it is not the paper's.
        options: numerical options of the steps.
        n_points: largest number of points.
        n_starts: number of starts at each point.
        max_steps: largest number of steps of a walk.

    Returns:
        A dataset over `point`.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the branch has another model.

    Examples:
        >>> branch = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 200.0))
        >>> vrw.measure_basins(branch, n_points=2).smallest_disturbance.values.round(3).tolist()
        [0.126, 0.109]
    """
    check_type("branch", branch, Branch, "give the result of vrw.continue_branch")
    checked_model, checked_options = check_model(model), check_options(options)
    n_points, n_starts = check_int("n_points", n_points), check_int("n_starts", n_starts)
    max_steps = check_int("max_steps", max_steps)
    bounds = None if box is None else parse_box(box)
    attrs = branch.dataset.attrs
    if attrs.get("model") != repr(checked_model):
        raise ValueError(
            f"the branch is one of {attrs.get('model', 'a map')}, but model is {checked_model!r}: "
            "give the model of the branch."
        )
    n_all = len(branch.values)
    if n_all == 0:
        raise ValueError(
            f"the branch has no gait: {branch.ending} Take a wheel for which vrw.limit_cycle finds "
            "a gait."
        )
    points = np.unique(np.linspace(0, n_all - 1, min(n_points, n_all)).round().astype(int))
    columns: dict[str, np.ndarray] = {}

    def record(name: str, point: int, value: float) -> None:
        columns.setdefault(name, np.full(len(points), np.nan))[point] = value

    for i, point in enumerate(points):
        if not branch.stable[point]:
            continue
        gait = _gait_at_point(branch, int(point), checked_model, checked_options)
        if bounds is not None:
            share = compute_basin_share(gait, bounds, n_starts, max_steps)
            record("basin_share", i, share.share)
            record("basin_share_error", i, share.share_error)
        if checked_model.can_begin_within_step:
            smallest = compute_smallest_disturbance(gait, None, max_steps)
            record("smallest_disturbance", i, smallest.size)
            record("smallest_disturbance_error", i, smallest.size_error)
    describe = lambda name: dict(zip(("units", "long_name"), VARIABLE_ATTRS[name], strict=True))
    data = {name: xr.Variable("point", x, describe(name)) for name, x in columns.items()}
    name = branch.parameter
    labels = {name: xr.Variable("point", branch.values[points], measure_attrs(name))}
    title = {"title": f"Basins of the gaits along {name}"}
    return xr.Dataset(data, labels, attrs | title)


def _gait_at_point(
    branch: Branch, point: int, model: AbstractWheel, options: StepOptions
) -> StableGait:
    """Return the gait at a point of a branch; raise a ValueError unless it is one of one step."""
    attrs, dtype = branch.dataset.attrs, branch.dataset.attrs["dtype"]
    values = {
        name: jnp.asarray(attrs[f"parameter_{name}"], dtype)
        for name in PARAMETER_NAMES
        if f"parameter_{name}" in attrs
    }
    params = WheelParams(**values, n_legs=attrs["parameter_n_legs"])
    value = jnp.asarray(branch.values[point], dtype)
    point_model, params = model.with_parameter(params, branch.parameter, value)
    state = np.asarray(branch.dataset.section_state.values[point])[None]
    gait = StableGait(params, point_model, options, state)
    end = step_batch(params, state, model=point_model, options=options).section_state
    if not gait.contains(end)[0]:
        raise ValueError(
            "a gait of the branch does not repeat after one step, but basins along branches are "
            "those of gaits of one step: continue a branch with period_n=1."
        )
    return gait
