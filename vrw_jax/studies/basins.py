"""Basins of attraction: where walks from many starts end, and the share that reaches a gait."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vrw_jax.base.checks import (
    check_choice,
    check_int,
    check_range,
    check_real,
    check_reals,
    check_type,
    require_untraced_arguments,
)
from vrw_jax.base.options import EngineName, StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import AbstractPrintable, LabelAndText, Outcome
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.walker import check_arguments, check_one_walker, is_own_walker, name_coordinates
from vrw_jax.gaits.cycle import AbstractCycle
from vrw_jax.gaits.gait_search import limit_cycle
from vrw_jax.gaits.gait_walks import find_distinct_orbits, measure_orbit_steps, walk_until_periodic
from vrw_jax.gaits.walker_finder import HybridGait
from vrw_jax.models.ladder import collect_provenance_attributes
from vrw_jax.models.measures import (
    MARGIN_MEASURES,
    POST_LANDING_COMPONENT_NAMES,
    PRE_TOUCHDOWN_COMPONENT_NAMES,
    make_measure_attributes,
)
from vrw_jax.models.step_batch import step_batch
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_step_options,
    require_single_wheel,
)
from vrw_jax.studies.scan_design import draw_unit_points
from vrw_jax.wheel import transitions
from vrw_jax.wheel.params import compute_wheel_units

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
        model = convert_model_argument(model).fallback_model
    else:
        params = check_one_walker(params)
    options = convert_step_options(options)
    options.check_tolerances(np.dtype(jnp.result_type(*jax.tree.leaves(params), float)))
    options = options.with_engine(engine)
    max_steps = check_int("max_steps", max_steps)
    max_period = check_int("max_period", max_period)
    check_type("grid", grid, Mapping, "write {'theta_touchdown': 0.09, 'dtheta_touchdown': ...}")
    start_component_names = select_start_components(model, "grid", grid, "a number or an axis")
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
    if own_walker is not None:
        check_arguments(own_walker, params, start_states[0], options, 1)
    start_states = embed_starts(params, model, start_component_names, start_states)
    walk_ends = walk_until_periodic(params, start_states, model, options, max_steps, max_period)
    orbit_indices, orbit_states = find_distinct_orbits(walk_ends)

    make_walk_variable = lambda values, attributes: xr.Variable(
        axis_names, values.reshape(grid_shape), attributes
    )
    walk_variables = {
        "attractor": make_walk_variable(
            orbit_indices, {"long_name": "orbit that the walk settles on", "flag_none": -1}
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
        "starts": "on the section"
        if own_walker is not None
        else "after landing"
        if start_component_names == POST_LANDING_COMPONENT_NAMES
        else "before touchdown",
    }
    return xr.Dataset(
        walk_variables | orbit_variables,
        start_dataset_coordinates,
        basin_attributes | collect_provenance_attributes(params, model, options),
    )


def select_start_components(
    model: Any, argument_name: str, values_by_component: Mapping[str, Any], value_text: str
) -> tuple[str, ...]:
    """Return the names of the components of starts before touchdown or of starts after landing, or
    of the section coordinates of a walker of the user.

    Raise a ValueError unless the names in `values_by_component` are all of one kind. The message
    contains `argument_name`, and the form `value_text` of a value.
    """
    kinds: tuple[tuple[str, ...], ...] = (
        (tuple(name_coordinates(model, len(values_by_component))),)
        if is_own_walker(model)
        else (PRE_TOUCHDOWN_COMPONENT_NAMES, POST_LANDING_COMPONENT_NAMES)
    )
    for names in kinds:
        if set(values_by_component) == set(names):
            return names
    raise ValueError(
        f"the {argument_name} contains {', '.join(map(str, values_by_component)) or 'nothing'}, "
        f"but it must contain all of {', or all of '.join(map(', '.join, kinds))}: give each "
        f"{value_text}."
    )


def embed_starts(
    params: Any, model: Any, component_names: tuple[str, ...], starts: np.ndarray
) -> np.ndarray:
    """Return the section states of starts before touchdown or after landing, or of starts of a
    walker of the user, which are section states themselves.

    A start after landing is (theta+, dtheta+). Its section state is that with dL1- = 0 whose
    landing results in this start. The angular rates before and after this landing are proportional.
    A section state is NaN if no landing leads to the start.
    """
    if is_own_walker(model):
        return starts
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

    if component_names == POST_LANDING_COMPONENT_NAMES:
        starts = np.asarray(jax.vmap(find_section_state_before)(jnp.asarray(starts)))
    starts = np.where(np.isfinite(starts).all(-1, keepdims=True), starts, np.nan)
    embed = functools.partial(model.complete_section_state, params)
    return np.asarray(jax.vmap(embed)(jnp.asarray(starts)))


def _make_orbit_variables(
    params: Any,
    orbit_states: list[np.ndarray],
    n_coordinates: int,
    max_period: int,
    model: Any,
    options: StepOptions,
) -> dict[str, xr.Variable]:
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
    component_names = (
        PRE_TOUCHDOWN_COMPONENT_NAMES
        if has_wheel_measures
        else tuple(name_coordinates(model, n_coordinates))
    )
    has_names = len(component_names) == n_entries
    return {
        **({"component": xr.Variable("component", list(component_names))} if has_names else {}),
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


# Largest distance between the section states of a walk and of the gait at which the walk has
# arrived. Distances are in units of the wheel. The value is chosen far above the errors of a gait
# step and of a gait. It is far below the distances of most gaits from the boundaries of their
# basins.
MAX_ARRIVAL_DISTANCE = 1e-6


class StableGait(NamedTuple):
    """Stable gait of one walker, with its parameters, the model and the step options."""

    params: Any
    model: Any
    step_options: StepOptions
    section_states: np.ndarray  # before the landing of each step, (period_n, m)
    spectral_radius: Any = np.nan  # NaN if it is unknown

    @classmethod
    def from_cycle(
        cls,
        caller_name: str,
        params: Any,
        model: Any,
        cycle: Any,
        options: StepOptions | None,
        changes_within_step: str = "",
    ) -> "StableGait":
        """Return the stable gait of `cycle`, or of the result of `limit_cycle` if it is None.

        Raise TypeError or ValueError if an argument is invalid or the gait is not stable. The
        messages contain `caller_name`, the name of the public function.

        - `changes_within_step`: plural noun for disturbances within a step, such as "pushes". They
          need a model that can start within it. "" if there are none.
        """
        require_untraced_arguments(
            caller_name, "map vrw.walk over the starts", params, options, cycle
        )
        is_own = is_own_walker(model)
        if is_own:
            params = check_one_walker(params)
        else:
            model = convert_model_argument(model).fallback_model  # valid for any start
            require_single_wheel(params, f"call {caller_name} for one wheel after the other")
        if changes_within_step:
            require_can_start_within_step(model, changes_within_step)
        options = convert_step_options(options)
        options.check_tolerances(np.dtype(jnp.result_type(*jax.tree.leaves(params), float)))
        if cycle is None:
            leg_period = model.leg_period
            cycle = limit_cycle(params, model=model, period_n=leg_period)
        cycle_type: Any = HybridGait if is_own else AbstractCycle
        check_type("cycle", cycle, cycle_type, "give vrw.limit_cycle(params, model=...)")
        if int(cycle.outcome) != Outcome.STEPPED:
            raise ValueError(
                f"there is no gait that could have a basin: {cycle.why} Take parameters for which "
                "vrw.limit_cycle finds a gait."
            )
        spectral_radius = float(cycle.spectral_radius_value)
        if is_own and model.invariants:  # Each has a multiplier of 1, which round-off may reduce.
            spectral_radius = max(spectral_radius, 1.0)
        if not spectral_radius < 1.0:
            remedy = "take parameters whose gait has a spectral radius below 1."
            if is_own and model.invariants:
                remedy = "a walker that conserves a quantity has no stable gaits, so take another."
            raise ValueError(
                f"the gait has spectral radius {spectral_radius:.6g}, so that it is not stable: "
                f"{remedy}"
            )
        period_n = int(cycle.period_n)
        return cls.from_section_state(
            params, model, options, cycle.section_state, period_n, spectral_radius
        )

    @classmethod
    def from_section_state(
        cls,
        params: Any,
        model: Any,
        options: StepOptions,
        section_state: Any,
        period_n: int,
        spectral_radius: float = np.nan,
    ) -> "StableGait":
        """Return the gait that begins at a section state, or raise an error if it does not repeat
        after `period_n` steps.
        """
        x, states = np.asarray(section_state)[None], np.zeros((0, np.size(section_state)))
        gait = cls(params, model, options, states, np.array(spectral_radius))
        for k in range(period_n):
            gait = gait._replace(section_states=np.concatenate([gait.section_states, x]))
            leg_model = gait.start_at_step(k).model
            x = step_batch(params, x, model=leg_model, options=options).section_state
        if not gait._replace(section_states=gait.section_states[:1]).is_on_gait(x)[0]:
            raise ValueError(
                f"the gait does not repeat after {period_n} step{'s' * (period_n > 1)} with "
                f"{type(model).__name__}: give a cycle of the same parameters and model."
            )
        return gait

    def start_at_step(self, n_steps: int) -> "StableGait":
        """Return the gait that begins some steps later, with the legs in their roles there."""
        model = self.model
        if not is_own_walker(model):
            leg_models = model.list_models_of_legs()
            model = leg_models[n_steps % len(leg_models)]
        states = np.roll(self.section_states, -n_steps, 0)
        return self._replace(model=model, section_states=states)

    def is_on_gait(self, section_states: np.ndarray, n_steps: int = 0) -> np.ndarray:
        """Return whether each section state agrees with a section state of the gait, shape
        (states,).

        Legs that alternate have to be the same, `n_steps` steps after the start of a walk.
        Two states agree if their distance is at most `MAX_ARRIVAL_DISTANCE`, in units of the wheel.
        For a walker of the user, the unit is the largest section coordinate of the gait.
        """
        if is_own_walker(self.model):
            units, n_entries = np.abs(self.section_states).max() or 1.0, section_states.shape[1]
        else:
            wheel_units = compute_wheel_units(self.params.symbols())
            n_entries = self.model.count_continuous_section_entries(self.params)
            units = self.model.collect_section_units(wheel_units, self.params.n_legs)
            units = np.asarray(units)[:n_entries]
        leg_period = self.model.leg_period
        gait_states = self.section_states[n_steps % leg_period :: leg_period, :n_entries]
        differences = section_states[:, None, :n_entries] - gait_states
        return np.abs(differences / units).max(-1).min(-1) <= MAX_ARRIVAL_DISTANCE


def require_can_start_within_step(model: Any, changes: str) -> None:
    """Raise an error if a model cannot begin within a step, as `changes` there need."""
    if not model.can_start_within_gait_step:
        raise ValueError(
            f"{type(model).__name__} cannot begin within a step, so that {changes} within a step "
            "are not available: take ViscoelasticWheel(), RigidWheel() or a HybridSystem, or "
            "disturb starts by vrw.basin_share."
        )


# Number of gait steps between two tests, chosen because more frequent tests need many calls, and
# because it is even, so that legs in turn are in their first roles again.
N_STEPS_PER_ARRIVAL_TEST = 10


def walk_until_on_gait(
    stable_gait: StableGait, start_states: np.ndarray, max_steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Walk at most `max_steps` gait steps from `start_states`, until the walks are on the gait.

    Return whether each walk arrives, its `Outcome` (STEPPED if it continues), and its number of
    gait steps up to arrival, failure or `max_steps`.

    - `start_states`: section states, shape (starts, components).
    """
    n_starts = len(start_states)
    has_arrived = np.zeros(n_starts, bool)
    walk_outcomes = np.full(n_starts, int(Outcome.STEPPED))
    n_steps_walked = np.zeros(n_starts, int)
    walking_indices, section_states = np.arange(n_starts), start_states
    for first_step in range(0, max_steps, N_STEPS_PER_ARRIVAL_TEST):
        if not len(walking_indices):
            break
        n_steps = min(N_STEPS_PER_ARRIVAL_TEST, max_steps - first_step)
        walk_results = step_batch(
            stable_gait.params,
            section_states,
            n_steps,
            model=stable_gait.model,
            options=stable_gait.step_options,
        )
        has_stepped = walk_results.outcome == Outcome.STEPPED
        is_on_gait = has_stepped & stable_gait.is_on_gait(
            walk_results.section_state, first_step + n_steps
        )
        has_arrived[walking_indices] = is_on_gait
        walk_outcomes[walking_indices] = walk_results.outcome
        n_steps_walked[walking_indices] += walk_results.n_stepped
        is_walking = has_stepped & ~is_on_gait
        walking_indices = walking_indices[is_walking]
        section_states = walk_results.section_state[is_walking]
    return has_arrived, walk_outcomes, n_steps_walked


StartSamplingName = Literal["sobol", "random"]
StartBox = Mapping[str, float | tuple[float, float]]
"""Bounds (lower, upper) of each component of a start state, by the name of the component.

A single number fixes the component.
"""


class BasinShare(AbstractPrintable):
    """Share of the start states in a box from which a wheel arrives at its gait.

    - `share`: share of the starts whose walk arrives at the gait;
    - `share_error`: standard error of `share` for independent starts;
    - `walking_share`: share of the starts whose walk has not failed after 1, 2, ... gait steps,
      shape (max_steps,);
    - `walking_share_error`: standard errors of `walking_share`, shape (max_steps,);
    - `elsewhere_share`: share of the starts whose walk neither fails nor arrives at the gait within
      `max_steps` gait steps;
    - `failure_shares`: shares of the starts whose walk fails, by the name of the `Outcome`;
    - `n_starts`: number of starts.

    Examples:
        >>> box = {"theta_touchdown": 0.1, "dtheta_touchdown": (0.8, 2.8)}
        >>> box |= {"dL1_touchdown": (-0.6, 0.2)}
        >>> print(vrw.basin_share(vrw.WheelParams(damping=150.0), box, n_starts=256))
        BasinShare
          ends up on the gait: 0.7461 (standard error 0.0273)
          walks after 200 steps: 0.7461 (standard error 0.0273)
          TOUCHDOWN_BEFORE_STOPPER: 0.2539
          starts: 256
    """

    share: float
    share_error: float
    walking_share: Float[np.ndarray, " n_steps"]
    walking_share_error: Float[np.ndarray, " n_steps"]
    elsewhere_share: float
    failure_shares: dict[str, float] = eqx.field(static=True)
    n_starts: int = eqx.field(static=True)

    def summary_rows(self) -> list[LabelAndText]:
        """Return pairs of label and text for the shares, with their standard errors."""
        format_share = lambda share, error: f"{share:.4f} (standard error {error:.4f})"
        return [
            ("ends up on the gait", format_share(self.share, self.share_error)),
            (
                f"walks after {len(self.walking_share)} steps",
                format_share(self.walking_share[-1], self.walking_share_error[-1]),
            ),
            *(
                (outcome_name, f"{share:.4f}")
                for outcome_name, share in self.failure_shares.items()
            ),
            ("starts", f"{self.n_starts:,}"),
        ]


@announce_wait("gaits and walks", "10 s")
def basin_share(
    params: Any,
    box: StartBox,
    *,
    model: ModelLike | None = None,
    cycle: Any = None,
    options: StepOptions | None = None,
    n_starts: int = 4096,
    max_steps: int = 200,
    sampling: StartSamplingName = "sobol",
    seed: int = 0,
) -> BasinShare:
    """Return the share of the start states in a box from which a wheel arrives at its gait.

    The starts are spread evenly over `box`. A walk arrives at the gait when its section state
    differs from that of the gait by less than 1e-6. The unit is that of the wheel
    (`compute_wheel_units`). For a walker of yours, it is the largest section coordinate of the
    gait. The gait must be stable, so that the walk stays on it.

    The errors are standard errors of a binomial share. For the error, one start that arrives and
    one that does not are added. The error is therefore positive for a share of 0 or 1. The errors
    hold for `sampling="random"`. In most boxes, points of a scrambled Sobol' sequence have smaller
    errors.

    Args:
        params: parameters of the wheel, or of a walker of yours.
        box: bounds (lower, upper) or a number for each of "theta_touchdown", "dtheta_touchdown" and
            "dL1_touchdown", in rad, rad/s, m/s; or for each of "theta_post_impact" and
            "dtheta_post_impact", in rad, rad/s. Starts to which no landing leads count as
            BAD_INPUT. For a walker of yours, the names are those of its section coordinates.
        model: model of the wheel; by default that of the paper, `ViscoelasticWheel()`. "auto" means
            unilateral contact, which is valid for all starts. A walker of yours may be given too.
        cycle: the gait; by default the result of `limit_cycle`.
        options: numerical options of the gait steps.
        n_starts: number of starts, best a power of 2.
        max_steps: largest number of gait steps of a walk.
        sampling: "sobol", or "random" for independent starts.
        seed: seed of the starts.

    Returns:
        A `BasinShare`: the share of starts whose walks reach the gait, and its error.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the wheel has no stable gait.

    Examples:
        >>> box = {"theta_touchdown": 0.1, "dtheta_touchdown": (0.8, 2.8)}
        >>> box |= {"dL1_touchdown": (-0.6, 0.2)}
        >>> result = vrw.basin_share(vrw.WheelParams(damping=150.0), box, n_starts=256)
        >>> print(f"{result.share:.2f}")
        0.75
    """
    n_starts, max_steps = check_int("n_starts", n_starts), check_int("max_steps", max_steps)
    check_choice("sampling", sampling, get_args(StartSamplingName))
    box_bounds = parse_start_box(box, model)
    stable_gait = StableGait.from_cycle("vrw.basin_share", params, model, cycle, options)
    return compute_basin_share(stable_gait, box_bounds, n_starts, max_steps, sampling, seed)


StartBoxBounds = tuple[tuple[str, ...], np.ndarray, np.ndarray]
"""Names, lower bounds and upper bounds of the components of start states, rad, rad/s and m/s."""


def compute_basin_share(
    stable_gait: StableGait,
    box_bounds: StartBoxBounds,
    n_starts: int,
    max_steps: int,
    sampling_name: str = "sobol",
    seed: int = 0,
) -> BasinShare:
    """Return the `BasinShare` for a stable gait and for valid arguments of `basin_share`."""
    start_component_names, lower_bounds, upper_bounds = box_bounds
    points = draw_unit_points(sampling_name, n_starts, len(start_component_names), seed)
    starts = lower_bounds + (upper_bounds - lower_bounds) * points
    start_states = embed_starts(
        stable_gait.params, stable_gait.model, start_component_names, starts
    )
    is_on_gait, walk_outcomes, n_steps_walked = walk_until_on_gait(
        stable_gait, start_states, max_steps
    )
    n_steps_walked[is_on_gait] = max_steps
    walking_share = np.mean(n_steps_walked[:, None] >= np.arange(1, max_steps + 1), 0)
    failure_codes, n_failures = np.unique(
        walk_outcomes[walk_outcomes != Outcome.STEPPED], return_counts=True
    )
    arrival_share = float(is_on_gait.mean())
    return BasinShare(
        share=arrival_share,
        share_error=compute_share_error(arrival_share, n_starts),
        walking_share=walking_share,
        walking_share_error=compute_share_error(walking_share, n_starts),
        elsewhere_share=float(np.mean((walk_outcomes == Outcome.STEPPED) & ~is_on_gait)),
        failure_shares={
            Outcome(failure_code).name: float(n / n_starts)
            for failure_code, n in zip(failure_codes, n_failures, strict=True)
        },
        n_starts=n_starts,
    )


def compute_share_error(sampled_share: Any, n_draws: int) -> Any:
    """Return the standard error of a share that is estimated from `n_draws` independent draws.

    `sampled_share` is a share or an array of shares. One draw with each result is added (Laplace's
    rule of succession), so that the error is positive.
    """
    smoothed_share = (sampled_share * n_draws + 1.0) / (n_draws + 2.0)
    return (smoothed_share * (1.0 - smoothed_share) / n_draws) ** 0.5


def parse_start_box(box: StartBox, model: Any) -> StartBoxBounds:
    """Return the names and bounds of the components of start states in `box`.

    Raise TypeError if the box is not a mapping. Raise ValueError unless the box bounds all
    components of one kind of start.
    """
    check_type("box", box, Mapping, "write {'theta_touchdown': 0.1, 'dtheta_touchdown': (1, 2)...}")
    start_component_names = select_start_components(model, "box", box, "a number or two bounds")
    bounds_of_start_component = [
        (check_real(component_name, box[component_name]),) * 2
        if np.ndim(box[component_name]) == 0
        else check_range(component_name, box[component_name])
        for component_name in start_component_names
    ]
    lower_bounds, upper_bounds = np.array(bounds_of_start_component).T
    return start_component_names, lower_bounds, upper_bounds
