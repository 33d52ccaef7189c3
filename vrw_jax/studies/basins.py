"""Basins of attraction: the gait or the failure in which a walk from each start of a grid ends."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import check_int, check_reals, check_type, require_untraced_arguments
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.options import EngineName, StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.walker import (
    AbstractWalker,
    check_arguments,
    check_parameters,
    is_own_walker,
    name_coordinates,
)
from vrw_jax.gaits.attractors import find_distinct_orbits, measure_orbit_steps, walk_until_periodic
from vrw_jax.models.measures import (
    MARGIN_MEASURES,
    POST_LANDING_COMPONENT_NAMES,
    PRE_TOUCHDOWN_COMPONENT_NAMES,
    make_measure_attributes,
)
from vrw_jax.models.provenance import collect_provenance_attributes
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_step_options,
    require_equal_legs,
    require_single_wheel,
)
from vrw_jax.wheel import transitions
from vrw_jax.wheel.params import WheelParams

StartGrid = Mapping[str, float | Sequence[float] | np.ndarray]
"""One or more values of each component of a start, by name. A component with a single number is not
an axis.
"""


@announce_wait("batches of gait steps", "10 s")
def basin(
    params: Any,
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
    starts. For a walker of yours, `params` are its parameters, and `grid` names its section
    coordinates: "x0", "x1", ..., unless the walker has names for them.

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
    own_walker: Any = model if is_own_walker(model) else None
    if own_walker is None:
        require_single_wheel(params, "compute one basin after the other")
        # The model is valid for any start.
        model = wheel_model = convert_model_argument(model).fallback_model
        require_equal_legs(wheel_model, "vrw.basin")
    else:
        params = check_parameters(params)
    options = convert_step_options(options)
    options.check_tolerances(np.dtype(jnp.result_type(*jax.tree.leaves(params), float)))
    options = options.with_engine(engine)
    max_steps = check_int("max_steps", max_steps)
    max_period = check_int("max_period", max_period)
    check_type("grid", grid, Mapping, "write {'theta_touchdown': 0.09, 'dtheta_touchdown': ...}")
    start_component_names = (
        select_start_components("grid", grid, "a number or an axis")
        if own_walker is None
        else _select_own_components(own_walker, grid)
    )
    start_component_values = {
        component_name: np.asarray(check_reals(component_name, grid[component_name]), float)
        for component_name in start_component_names
    }
    for component_name, values in start_component_values.items():
        if values.ndim > 1 or not values.size:
            raise ValueError(
                f"{component_name} has shape {values.shape}, but it must be "
                "a number, or a list of at least one: give one axis of values."
            )
    axis_names = [name for name, values in start_component_values.items() if values.ndim]
    grid_shape = [start_component_values[axis_name].size for axis_name in axis_names]
    coordinate_grids = np.meshgrid(*start_component_values.values(), indexing="ij")
    start_states = np.stack([x.ravel() for x in coordinate_grids], -1)
    if own_walker is None:
        start_states = compute_section_states_of_starts(params, start_component_names, start_states)
        start_embedder = functools.partial(wheel_model.complete_section_state, params)
        start_states = np.asarray(jax.vmap(start_embedder)(jnp.asarray(start_states)))
    else:
        check_arguments(own_walker, params, start_states[0], options, 1)
    walk_ends = walk_until_periodic(params, start_states, model, options, max_steps, max_period)
    orbit_indices, orbit_states = find_distinct_orbits(walk_ends)

    make_walk_variable = lambda values, attributes: xr.Variable(
        axis_names, values.reshape(grid_shape), attributes
    )
    walk_variables = {
        "attractor": make_walk_variable(
            orbit_indices,
            {"long_name": "orbit that the walk settles on", "flag_none": -1},
        ),
        "outcome": make_walk_variable(walk_ends.outcome, make_measure_attributes("outcome")),
        "steps": make_walk_variable(
            walk_ends.n_steps_to_orbit,
            {"units": "1", "long_name": "steps until the orbit is reached, or the fall"},
        ),
    }
    start_dataset_coordinates = {
        component_name: xr.Variable(
            (component_name,) * values.ndim,
            values,
            make_measure_attributes(component_name)
            if own_walker is None
            else {"units": name_coordinates(own_walker, len(grid))[component_name]},
        )
        for component_name, values in start_component_values.items()
    }
    orbit_variables = _make_orbit_variables(
        params, orbit_states, start_states.shape[1], max_period, model, options
    )
    basin_attributes = {
        "title": "Basins of attraction",
        "most_steps": max_steps,
        "starts": "after landing"
        if start_component_names == POST_LANDING_COMPONENT_NAMES
        else "before touchdown",
    }
    return xr.Dataset(
        walk_variables | orbit_variables,
        start_dataset_coordinates,
        basin_attributes | collect_provenance_attributes(params, model, options),
    )


def _select_own_components(walker: AbstractWalker, grid: StartGrid) -> tuple[str, ...]:
    """Return the names of the section coordinates of a walker, all of which a grid contains."""
    names = tuple(name_coordinates(walker, len(grid)))
    if set(grid) != set(names):
        raise ValueError(
            f"the grid contains {', '.join(map(str, grid))}, but it must contain the section "
            f"coordinates {', '.join(names)}: give each a number or an axis."
        )
    return names


def select_start_components(
    argument_name: str, values_by_component: Mapping[str, Any], value_text: str
) -> tuple[str, ...]:
    """Return the names of the components of starts before touchdown or of starts after landing.

    Raise a ValueError unless the names in `values_by_component` are either all of the former or all
    of the latter. The message contains `argument_name`, and the form `value_text` of a value.
    """
    for start_component_names in (PRE_TOUCHDOWN_COMPONENT_NAMES, POST_LANDING_COMPONENT_NAMES):
        if set(values_by_component) == set(start_component_names):
            return start_component_names
    raise ValueError(
        f"the {argument_name} contains {', '.join(map(str, values_by_component)) or 'nothing'}, "
        f"but it must contain all of {', '.join(PRE_TOUCHDOWN_COMPONENT_NAMES)}, or all of "
        f"{', '.join(POST_LANDING_COMPONENT_NAMES)}: give each {value_text}."
    )


def compute_section_states_of_starts(
    params: WheelParams, start_component_names: tuple[str, ...], starts: np.ndarray
) -> np.ndarray:
    """Return section states for starts before touchdown or after landing, shape (starts, 3).

    A start after landing is (theta+, dtheta+). Its section state is that with dL1- = 0 whose
    landing results in this start. The angular rates before and after this landing are proportional.
    A section state is NaN if no landing leads to the start.
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

    section_states = starts
    if start_component_names == POST_LANDING_COMPONENT_NAMES:
        section_states = np.asarray(jax.vmap(find_section_state_before)(jnp.asarray(starts)))
    return np.where(np.isfinite(section_states).all(-1, keepdims=True), section_states, np.nan)


def _make_orbit_variables(
    params: Any,
    orbit_states: list[np.ndarray],
    n_coordinates: int,
    max_period: int,
    model: Any,
    options: StepOptions,
) -> dict[str, xr.Variable]:
    """Return the dataset variables for the orbits: states, periods, DLS fractions and minimum
    margins.
    """
    n_orbits = len(orbit_states)
    has_wheel_measures = not is_own_walker(model)
    n_entries = model.count_section_entries(params) if has_wheel_measures else n_coordinates
    padded_orbit_states = np.full((n_orbits, max_period, n_entries), np.nan)
    margin_names = MARGIN_MEASURES if has_wheel_measures and n_entries == 3 else ()
    names = ("dls_fraction", *margin_names) if has_wheel_measures else ()
    orbit_measures = {name: np.zeros(n_orbits) for name in names}
    for i, states_of_one_orbit in enumerate(orbit_states):
        padded_orbit_states[i, : len(states_of_one_orbit)] = states_of_one_orbit
        if not has_wheel_measures:
            continue
        step_measures = measure_orbit_steps(params, states_of_one_orbit, model, options)
        orbit_measures["dls_fraction"][i] = (
            step_measures["duration_dls"].sum() / step_measures["period"].sum()
        )
        for margin_name in margin_names:
            orbit_measures[margin_name][i] = step_measures[margin_name].min()
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
        **{
            f"orbit_{measure_name}": xr.Variable(
                "attractor_index", measure_values, make_measure_attributes(measure_name)
            )
            for measure_name, measure_values in orbit_measures.items()
        },
    }
