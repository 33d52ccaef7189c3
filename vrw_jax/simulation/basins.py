"""Basins of attraction: the gait or the failure in which a walk from each start of a grid ends."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.measures import (
    MARGIN_MEASURES,
    MEASURES,
    POST_LANDING_COMPONENT_NAMES,
    PRE_TOUCHDOWN_COMPONENT_NAMES,
    make_measure_attributes,
)
from vrw_jax.measures import xarray as xr
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import EngineName, StepOptions, with_default_jax_settings
from vrw_jax.simulation.attractors import (
    find_distinct_orbits,
    measure_orbit_steps,
    walk_until_periodic,
)
from vrw_jax.simulation.provenance import collect_provenance_attributes
from vrw_jax.simulation.stepping import (
    ModelLike,
    convert_model_argument,
    convert_step_options,
    require_single_wheel,
)
from vrw_jax.validation import (
    check_int,
    check_reals,
    check_type,
    require_untraced_arguments,
    with_renamed_arguments,
)
from vrw_jax.wheel import Outcome, WheelParams, transitions

StartGrid = Mapping[str, float | Sequence[float] | np.ndarray]
"""One or more values of each component of a start, by name. A component with a single number is not
an axis.
"""


@with_default_jax_settings
@with_renamed_arguments(most_steps="max_steps", longest_period="max_period")
def basin(
    params: WheelParams,
    grid: StartGrid,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
    max_steps: int = 200,
    max_period: int = 16,
) -> xr.Dataset:
    """Return the orbit or the failure in which a walk from each start of `grid` ends, as a dataset.

    `grid` names all components of a start before touchdown, such as {"theta_touchdown": 0.09,
    "dtheta_touchdown": np.linspace(1.0, 2.5, 60), "dL1_touchdown": np.linspace(-0.5, 0.2, 60)}, or
    all of "theta_post_impact" and "dtheta_post_impact". Components with several values are the axes
    of the result, in this order. The variables over these axes are

    - `attractor`: index of the orbit that the walk reaches within `max_steps`, or -1;
    - `outcome`: STEPPED, or the code of the failure; BAD_INPUT if no landing leads to the start;
    - `steps`: number of steps until the walk stays within 1e-3 of the orbit, or until it fails.

    The orbits are in `orbit_state` over (attractor_index, orbit_step), ordered by decreasing number
    of starts. The dataset has an `orbit_period` in steps, a DLS fraction and, for the paper's
    model, the minimum margins of each orbit. With unilateral contact, section states are full
    states of `UnilateralWheel`. The model "auto" means unilateral contact, which is valid for all
    starts.

    Args:
        params: the wheel.
        grid: one or more values of each component of a start, by name.
        model: the model; by default that of the paper, `ViscoelasticWheel()`.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.
        max_steps: largest number of steps of a walk.
        max_period: longest period, in steps, that is recognized.

    Returns:
        A dataset over the axes of `grid`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> starts = {"theta_touchdown": 0.09, "dtheta_touchdown": [1.4, 1.6]}
        >>> starts |= {"dL1_touchdown": -0.1}
        >>> basins = vrw.basin(vrw.WheelParams(damping=150.0), starts)
        >>> basins.attractor.values.tolist()
        [0, 0]
    """
    require_untraced_arguments("vrw.basin", "map vrw.walk over the starts", params, options)
    require_single_wheel(params, "compute one basin after the other")
    model = convert_model_argument(
        model
    ).fallback_model  # The fallback model is valid for any start.
    options = convert_step_options(options)
    options.check_tolerances(np.dtype(params.damping.dtype))
    options = options.with_engine(engine)
    max_steps = check_int("max_steps", max_steps)
    max_period = check_int("max_period", max_period)
    start_component_values = _parse_start_grid(grid)
    start_component_names = tuple(start_component_values)
    start_grid_axis_names = [
        start_component_name
        for start_component_name in start_component_names
        if np.ndim(grid[start_component_name]) > 0
    ]
    start_grid_shape = tuple(
        len(start_component_values[start_component_name])
        for start_component_name in start_grid_axis_names
    )
    start_coordinate_grids = np.meshgrid(*start_component_values.values(), indexing="ij")
    start_grid_points = np.stack(
        [start_coordinate_grid.ravel() for start_coordinate_grid in start_coordinate_grids], -1
    )
    start_states = (
        start_grid_points
        if start_component_names == PRE_TOUCHDOWN_COMPONENT_NAMES
        else invert_landing_map(params, start_grid_points)
    )
    is_start_reachable = np.isfinite(start_states).all(-1)
    start_states = np.where(is_start_reachable[:, None], start_states, np.nan)
    start_embedder = functools.partial(model.complete_section_state, params)
    start_states = np.asarray(jax.vmap(start_embedder)(jnp.asarray(start_states)))
    walk_ends = walk_until_periodic(params, start_states, model, options, max_steps, max_period)
    distinct_orbits = find_distinct_orbits(walk_ends)

    walk_variables = {
        "attractor": xr.Variable(
            start_grid_axis_names,
            distinct_orbits.orbit_indices.reshape(start_grid_shape),
            {"long_name": "orbit that the walk settles on", "flag_none": -1},
        ),
        "outcome": xr.Variable(
            start_grid_axis_names,
            walk_ends.outcome.reshape(start_grid_shape),
            make_measure_attributes("outcome"),
        ),
        "steps": xr.Variable(
            start_grid_axis_names,
            walk_ends.n_steps_to_orbit.reshape(start_grid_shape),
            {"units": "1", "long_name": "steps until the orbit is reached, or the fall"},
        ),
    }
    start_dataset_coordinates = {
        start_component_name: xr.Variable(
            (start_component_name,) if start_component_name in start_grid_axis_names else (),
            start_component_values[start_component_name]
            if start_component_name in start_grid_axis_names
            else start_component_values[start_component_name][0],
            dict(MEASURES[start_component_name].variable_attributes),
        )
        for start_component_name in start_component_names
    }
    orbit_variables = _make_orbit_variables(
        params, distinct_orbits.orbit_states, max_period, model, options
    )
    basin_attributes = {
        "title": "Basins of attraction",
        "most_steps": max_steps,
        "starts": "before touchdown"
        if start_component_names == PRE_TOUCHDOWN_COMPONENT_NAMES
        else "after landing",
    }
    return xr.Dataset(
        walk_variables | orbit_variables,
        start_dataset_coordinates,
        basin_attributes | collect_provenance_attributes(params, model, options),
    )


def _parse_start_grid(grid: StartGrid) -> dict[str, np.ndarray]:
    """Return the values of each component of a start as an array with one axis.

    Raise a `ValueError` unless the grid contains all components before touchdown or all components
    after landing. Each component is a number or an array with one axis.
    """
    check_type("grid", grid, Mapping, "write {'theta_touchdown': 0.09, 'dtheta_touchdown': ...}")
    for start_component_names in (PRE_TOUCHDOWN_COMPONENT_NAMES, POST_LANDING_COMPONENT_NAMES):
        if set(grid) == set(start_component_names):
            break
    else:
        raise ValueError(
            f"the grid contains {', '.join(grid) or 'nothing'}, but it must contain all of "
            f"{', '.join(PRE_TOUCHDOWN_COMPONENT_NAMES)}, or all of "
            f"{', '.join(POST_LANDING_COMPONENT_NAMES)}: give "
            "each a number or an axis."
        )
    start_component_values = {
        start_component_name: np.asarray(
            check_reals(start_component_name, grid[start_component_name]), float
        )
        for start_component_name in start_component_names
    }
    for start_component_name, start_component_array in start_component_values.items():
        if start_component_array.ndim > 1 or not start_component_array.size:
            raise ValueError(
                f"{start_component_name} has shape {start_component_array.shape}, but it must be "
                "a number, or a list of at least one: give one axis of values."
            )
    return {
        start_component_name: np.atleast_1d(start_component_array)
        for start_component_name, start_component_array in start_component_values.items()
    }


def invert_landing_map(params: WheelParams, post_landing_states: np.ndarray) -> np.ndarray:
    """Return section states with dL1- = 0 whose landings result in given (theta+, dtheta+).

    The states are NaN where no such section state exists. For dL1- = 0, the angular rates before
    and after the landing are proportional.
    """
    s = params.symbols()

    def find_section_state_before(post_landing_state: jax.Array) -> jax.Array:
        touchdown_angle, post_landing_rate = post_landing_state[0] + s.alpha, post_landing_state[1]
        landing_with_unit_rate = transitions.resolve_landing(
            s, touchdown_angle, jnp.ones_like(post_landing_rate), jnp.zeros_like(post_landing_rate)
        )
        touchdown_rate = post_landing_rate / landing_with_unit_rate.motion_after.dtheta
        is_landing_admissible = landing_with_unit_rate.is_rear_foot_planted & (touchdown_rate > 0.0)
        return jnp.where(
            is_landing_admissible,
            jnp.stack([touchdown_angle, touchdown_rate, 0.0 * touchdown_rate]),
            jnp.nan,
        )

    return np.asarray(jax.vmap(find_section_state_before)(jnp.asarray(post_landing_states)))


def _make_orbit_variables(
    params: WheelParams,
    orbit_states: list[np.ndarray],
    max_period: int,
    model: AbstractWheel,
    options: StepOptions,
) -> dict[str, xr.Variable]:
    """Return the dataset variables for the orbits: states, periods, DLS fractions and minimum
    margins.
    """
    n_orbits = len(orbit_states)
    padded_orbit_states = np.full(
        (n_orbits, max_period, model.count_section_entries(params)), np.nan
    )
    margin_names = MARGIN_MEASURES if model.count_section_entries(params) == 3 else ()
    dls_fractions, min_margins = (
        np.zeros(n_orbits),
        {margin_name: np.zeros(n_orbits) for margin_name in margin_names},
    )
    for i, states_of_one_orbit in enumerate(orbit_states):
        padded_orbit_states[i, : len(states_of_one_orbit)] = states_of_one_orbit
        step_measures = measure_orbit_steps(params, states_of_one_orbit, model, options)
        dls_fractions[i] = step_measures["duration_dls"].sum() / step_measures["period"].sum()
        for margin_name in margin_names:
            min_margins[margin_name][i] = step_measures[margin_name].min()
    return {
        "orbit_state": xr.Variable(
            ("attractor_index", "orbit_step", "component"),
            padded_orbit_states,
            {"long_name": "section states of the orbit, lowest dtheta- first"},
        ),
        "orbit_period": xr.Variable(
            "attractor_index",
            np.array([len(states_of_one_orbit) for states_of_one_orbit in orbit_states], int),
            {"units": "1", "long_name": "steps until the orbit repeats"},
        ),
        "orbit_dls_fraction": xr.Variable(
            "attractor_index", dls_fractions, dict(MEASURES["dls_fraction"].variable_attributes)
        ),
        **{
            f"orbit_{margin_name}": xr.Variable(
                "attractor_index",
                min_margin_by_orbit,
                dict(MARGIN_MEASURES[margin_name].variable_attributes),
            )
            for margin_name, min_margin_by_orbit in min_margins.items()
        },
    }


def compute_walk_end_fractions(basin_dataset: xr.Dataset) -> dict[str, float]:
    """Return the fraction of starts for each end of a walk, by the name of the end.

    The names are "attractor 0", "attractor 1" and so on, "unsettled", and the names of outcomes.
    """
    attractor_indices = basin_dataset.attractor.values.ravel()
    outcome_codes = basin_dataset.outcome.values.ravel()
    walk_end_names = [
        f"attractor {attractor_code}"
        if attractor_code >= 0
        else ("unsettled" if outcome_code == Outcome.STEPPED else Outcome(int(outcome_code)).name)
        for attractor_code, outcome_code in zip(attractor_indices, outcome_codes, strict=True)
    ]
    return {
        walk_end_name: walk_end_names.count(walk_end_name) / len(walk_end_names)
        for walk_end_name in sorted(set(walk_end_names))
    }
