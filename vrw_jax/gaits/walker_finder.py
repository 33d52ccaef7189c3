"""Gaits of any walker: steps that repeat, found by Newton's method on the section."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from vrw_jax.base.checks import check_int, check_reals, has_traced_leaf, require_known_name
from vrw_jax.base.elementwise import Scalar, select_trees_by_condition
from vrw_jax.base.options import (
    ParameterDomain,
    StepOptions,
    find_tree_parameter,
    list_tree_parameters,
    replace_tree_parameter,
)
from vrw_jax.base.results import (
    Measure,
    Outcome,
    format_each_batch_element,
    format_heading_and_rows,
    format_numbers,
    format_outcome_counts,
    format_quantity,
)
from vrw_jax.base.walker import (
    AbstractWalker,
    check_arguments,
    check_measure_names,
    check_one_walker,
    check_parameters,
    compile_step,
    find_batch_length,
    make_return_map,
    name_coordinates,
    propose_starts,
)
from vrw_jax.gaits.derivatives import SlopeResponse
from vrw_jax.gaits.finder import GAIT_BATCH_SIZES, AbstractGaitFinder, ParameterValues
from vrw_jax.gaits.fixed_points import (
    MAX_NEWTON_ITERATIONS,
    MAX_RESIDUAL,
    FixedPointResult,
    solve_fixed_point,
)
from vrw_jax.gaits.gait_walks import walk_until_periodic
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.batching import (
    map_in_batches,
    replace_rows,
    select_rows_on_device,
    select_tree_rows,
)
from vrw_jax.lanes.environment import call_python, can_programs_call_jax
from vrw_jax.lanes.program import call_compiled_program


class HybridGait(NamedTuple):
    """Gait of a `HybridSystem` or another walker of yours, which repeats after `period_n` steps.

    - `section_state`: section coordinates at which the gait begins, shape (n,);
    - `period`: duration of all its steps, s;
    - `last_step`: the last step of the gait, for a `HybridSystem` a `HybridStep`;
    - `fixed_point`: the fixed point, with the Jacobian and the status of Newton's method;
    - `outcome`: STEPPED if a gait was found, or the `Outcome` that states why not. All numbers of
      the gait are then zero, except for the codes of `last_step`, the first step that failed;
    - `values`: the walker's measures by name, as means over the steps of the gait;
    - `period_n`: number of its steps.

    Examples:
        >>> decay = lambda y, p: jnp.stack([-p["rate"] * y[0], 1.0 + 0.0 * y[1]])
        >>> kick = lambda y, p: jnp.stack([y[0] + 1.0, 0.0 * y[1]])
        >>> guards = {"kick": vrw.hybrid.Guard(lambda y, p: 1.0 - y[1], kick)}
        >>> system = vrw.HybridSystem(
        ...     modes={"decay": vrw.hybrid.Mode(decay, guards)},
        ...     section="kick",
        ...     state=("level", "time"),
        ...     project=lambda y, p: y[:1],
        ...     embed=lambda x, p: jnp.stack([x[0], 0.0 * x[0]]),
        ... )
        >>> gait = vrw.limit_cycle({"rate": 1.0}, model=system, guess=[1.0])
        >>> print(f"{gait.section_state[0]:.6f} {gait.multipliers[0].real:.6f}")
        1.581977 0.367879
    """

    section_state: Float[Array, " n"]
    period: Scalar
    last_step: Any
    fixed_point: FixedPointResult
    outcome: Int[Array, ""]
    values: dict[str, Scalar]
    period_n: Int[Array, ""]

    @property
    def converged(self) -> Bool[Array, "..."]:
        """Return whether the gait was found."""
        return jnp.asarray(self.outcome == Outcome.STEPPED)

    @property
    def found(self) -> Bool[Array, "..."]:
        """Return whether the gait was found, as of other gaits."""
        return self.converged

    @property
    def warm_start(self) -> Array:
        """Return guesses from which the search for a similar gait begins, shape (1, n)."""
        return self.section_state[..., None, :]

    @property
    def monodromy_value(self) -> Float[Array, "... n n"]:
        """Return the Jacobian of the return map, without derivatives."""
        return self.fixed_point.jacobian

    @property
    def multipliers(self) -> Complex[Array, "... n"]:
        """Return the Floquet multipliers in the order of decreasing modulus, shape (n,).

        Their derivatives are NaN; those from `vrw.solve_fixed_point` of the return map are not.
        """
        return jnp.where(self.found[..., None], self.fixed_point.multipliers, 0.0)

    @property
    def spectral_radius(self) -> Any:
        """Return the largest modulus of a multiplier, which is below 1 for stable gaits."""
        return jnp.abs(self.multipliers[..., 0])

    @property
    def spectral_radius_value(self) -> Any:
        """Return the spectral radius without derivatives."""
        return lax.stop_gradient(self.spectral_radius)

    def measure(self, measure: str | Measure) -> Any:
        """Return the period, or one of the walker's measures, by its name or itself."""
        values = {"period": self.period, **self.values}
        name = measure.name if isinstance(measure, Measure) else measure
        require_known_name(name, tuple(values), "measure")
        return values[name]

    @property
    def why(self) -> Any:
        """Return a sentence on how the search ended; for a batch, an array of sentences."""

        def describe(
            code: int, newton: str, n_iterations: int, residual: float, step_code: int, end: str
        ) -> str:
            if code == Outcome.STEPPED:
                return newton
            if code != Outcome.NO_CYCLE_FOUND:
                outcome = Outcome(int(code))
                reason = end if end and code == step_code else outcome.meaning
                return f"A step of the search failed: {outcome.name}. {reason}"
            is_interrupted = n_iterations < MAX_NEWTON_ITERATIONS and residual == 0.0
            return newton + " One of its steps failed." * is_interrupted

        return format_each_batch_element(
            describe,
            self.outcome,
            self.fixed_point.ending,
            self.fixed_point.n_iterations,
            self.fixed_point.residual,
            self.last_step.outcome,
            getattr(self.last_step, "ending", ""),
        )

    @property
    def ending(self) -> Any:
        """Return the sentence of `why`, as of other gaits."""
        return self.why

    def __repr__(self) -> str:
        if isinstance(self.period, jax.core.Tracer):
            return f"HybridGait{tuple(self)}"
        rows = [
            ("section state", format_numbers(self.section_state)),
            ("period", format_quantity(self.period, "s")),
            ("multipliers", format_numbers(np.asarray(self.multipliers))),
            *((name, format_quantity(value, "")) for name, value in self.values.items()),
            ("search", self.why),
        ]
        if np.ndim(self.period):
            rows = [("gaits", format_outcome_counts(self.outcome, Outcome))]
        elif not self.converged:
            rows = rows[-1:]
        return format_heading_and_rows("HybridGait", rows)


def is_known_missing(outcome: Any) -> bool:
    """Return whether no gait was found, as far as the outcome is known outside of jit."""
    return not has_traced_leaf(outcome) and bool(np.all(np.asarray(outcome) != Outcome.STEPPED))


def convert_gait_guess(guess: Any) -> Any:
    """Return the section coordinates if a guess is a `HybridGait`, None if it was not found."""
    if not isinstance(guess, HybridGait):
        return guess
    return None if is_known_missing(guess.outcome) else guess.section_state


def find_walker_gaits(
    walker: Any, params: Any, guess: Any, period_n: int, options: Any, is_batch: bool = False
) -> HybridGait:
    """Return the gait near `guess`, or near a start of the walker, differentiable by parameters.

    For a batch, return the gaits, in which an element without a gait has a code.
    """
    guess = convert_gait_guess(guess)
    if is_batch and any(np.shape(leaf)[:1] == (0,) for leaf in jax.tree.leaves((params, guess))):
        fill = lambda x: np.full((1, *np.shape(x)[1:]), np.nan) if np.shape(x)[:1] == (0,) else x
        params, guess = jax.tree.map(fill, (params, guess))
        gaits = find_walker_gaits(walker, params, guess, period_n, options, is_batch)
        return select_rows_on_device(gaits, slice(0, 0))
    params, guesses, options = _check_search(walker, params, guess, period_n, options, is_batch)
    find_gaits = lambda params, guesses: call_compiled_program(
        _find_gaits if is_batch else find_gait_from_guesses,
        (walker, period_n),
        params,
        guesses,
        options,
    )
    if not is_batch:
        gait = find_gaits(params, guesses)
        if has_traced_leaf(params, guesses, gait):
            return _find_missing_inside_jit(walker, options, period_n, params, guesses, gait)
        one_params, one_guess, outcome = select_tree_rows((params, guesses, gait.outcome), None)
        rows, starts = collect_walk_ends(walker, one_params, one_guess, outcome, options, period_n)
        found = find_gaits(params, starts[0]) if len(rows) else gait
        return found if found.converged else gait
    n = find_batch_length(params, guesses, "guess", row_axes=2)
    arrays: Any = jnp if has_traced_leaf(params, guesses) else np
    params = jax.tree.map(lambda leaf: arrays.broadcast_to(leaf, (n,)), params)
    guesses = arrays.broadcast_to(guesses, (n, *guesses.shape[-2:]))
    if arrays is jnp:
        gaits = find_gaits(params, guesses)
        return jax.vmap(lambda *row: _find_missing_inside_jit(walker, options, period_n, *row))(
            params, guesses, gaits
        )
    find_each = functools.partial(map_in_batches, find_gaits, GAIT_BATCH_SIZES)
    return find_gaits_with_walks(find_each, walker, params, guesses, options, period_n)


def find_gaits_with_walks(
    find_gaits: Callable,
    walker: AbstractWalker,
    params: Any,
    guesses: Any,
    options: StepOptions,
    period_n: int,
) -> HybridGait:
    """Return the gaits of a batch near guesses, or near the ends of walks from them.

    - `find_gaits`: function of parameters and guesses that returns the gaits of a batch;
    - `params`, `guesses`: as in `collect_walk_ends`.
    """
    gaits = find_gaits(params, guesses)
    rows, starts = collect_walk_ends(
        walker, params, guesses, np.asarray(gaits.outcome), options, period_n
    )
    if not len(rows):
        return gaits
    found = find_gaits(select_tree_rows(params, rows), starts)
    is_found = np.asarray(found.converged)
    return replace_rows(gaits, rows[is_found], select_tree_rows(found, is_found))


# Number of steps after which a walk that has not become periodic is given up.
MAX_WALK_STEPS = 200


def collect_walk_ends(
    walker: AbstractWalker,
    params: Any,
    guesses: np.ndarray,
    outcomes: np.ndarray,
    options: StepOptions,
    period_n: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return ends of walks, from which Newton's method may find the gaits that it has missed.

    The first result contains the indices of elements whose walk from the first guess becomes
    periodic. The ends have the shape of the guesses.

    - `params`, `guesses`: parameters and guesses of a batch, (batch, starts, n);
    - `outcomes`: outcomes of the search that has failed.
    """
    is_searched = ~np.isin(outcomes, (Outcome.STEPPED, Outcome.BAD_INPUT))
    rows = np.flatnonzero(is_searched) if not walker.invariants else np.zeros(0, int)
    if not len(rows):
        return rows, guesses[:0]
    ends = walk_until_periodic(
        select_tree_rows(params, rows), guesses[rows, 0], walker, options, MAX_WALK_STEPS,
        period_n,
    )  # fmt: skip
    is_periodic = ends.period > 0
    starts = np.broadcast_to(ends.orbit_states[:, :1], guesses[rows].shape)
    return rows[is_periodic], starts[is_periodic]


def _find_missing_inside_jit(
    walker: AbstractWalker,
    options: StepOptions,
    period_n: int,
    params: Any,
    guesses: Array,
    gait: HybridGait,
) -> HybridGait:
    """Return the gait from the end of a walk if Newton's method has not found it from the guesses.

    A Python function walks, while JAX transforms or compiles the calls.
    """
    if not can_programs_call_jax() or walker.invariants:
        return gait

    def walk(params: Any, options: Any, guesses: Any, outcomes: Any) -> np.ndarray:
        params, options = jax.tree.map(np.ravel, (params, options))
        options = jax.tree.map(lambda x: x[0], options)
        starts = np.array(guesses).reshape(-1, *guesses.shape[-2:])
        rows, ends = collect_walk_ends(
            walker, params, starts, np.ravel(outcomes), options, period_n
        )
        starts[rows] = ends
        return starts.reshape(guesses.shape)

    # The values are operands, because a custom derivative in a branch must not close over them.
    def find_from_walk(params: Any, guesses: Array, gait: HybridGait) -> HybridGait:
        starts = call_python(
            walk,
            jax.typeof(guesses),
            *lax.stop_gradient((params, options, guesses, gait.outcome)),
            vmap_method="broadcast_all",
        )
        found = find_gait_from_guesses((walker, period_n), params, starts, options)
        return select_trees_by_condition(found.converged, found, gait)

    keep = lambda params, guesses, gait: gait
    return lax.cond(gait.converged, keep, find_from_walk, params, guesses, gait)


def _check_search(
    walker: Any, params: Any, guess: Any, period_n: int, options: Any, is_batch: bool
) -> tuple[Any, Array, StepOptions]:
    """Return parameters, guesses of shape ([batch,] starts, n) and options, or raise an error."""
    check_int("period_n", period_n)
    max_axes = 1 + is_batch
    params = check_parameters(params)
    for leaf in jax.tree.leaves(params):
        if leaf.ndim >= max_axes:
            rule = "this search is for one walker: use vrw.limit_cycles for a batch."
            if is_batch:
                rule = "a batch has one axis: give numbers or lists of numbers."
            raise ValueError(f"a parameter has shape {leaf.shape}, but {rule}")
    if guess is None:
        has_batch = any(leaf.ndim for leaf in jax.tree.leaves(params))
        axes = jax.tree.map(lambda leaf: 0 if leaf.ndim else None, params)
        propose = functools.partial(propose_starts, walker)
        guesses = jax.vmap(propose, (axes,))(params) if has_batch else propose(params)
    else:
        guesses = jnp.atleast_1d(check_reals("guess", guess))[..., None, :]
    one_guess = guesses[(0,) * (guesses.ndim - 1)]
    one_params = jax.tree.map(lambda leaf: leaf if leaf.ndim == 0 else leaf[0], params)
    _, _, options = check_arguments(walker, one_params, one_guess, options, 1)
    if not 2 <= guesses.ndim <= max_axes + 1:
        raise ValueError(
            f"guess has shape {jnp.shape(guess)}, but it holds section coordinates: give one "
            f"number for each{', or one row for each element of the batch' * is_batch}."
        )
    return params, guesses, options


def _find_gaits(
    walker_and_period: tuple[AbstractWalker, int], params: Any, guesses: Array, options: StepOptions
) -> HybridGait:
    find = functools.partial(find_gait_from_guesses, walker_and_period)
    return jax.vmap(find, in_axes=(0, 0, None))(params, guesses, options)


def find_gait_from_guesses(
    walker_and_period: tuple[AbstractWalker, int], params: Any, guesses: Array, options: StepOptions
) -> HybridGait:
    """Return the gait from the first guess that leads to one, or the failure of the first guess."""
    search = functools.partial(_search_from_guess, *walker_and_period, params, options)
    if len(guesses) == 1:
        return search(guesses[0])
    gaits = jax.vmap(search)(guesses)
    return jax.tree.map(lambda x: x[jnp.argmax(gaits.converged)], gaits)


def _search_from_guess(
    walker: AbstractWalker, period_n: int, params: Any, options: StepOptions, guess: Array
) -> HybridGait:

    def map_section_state(x: Array) -> Array:
        # The derivatives of the map are those of the steps of the gait, and so one program: by `x`
        # and by parameters, on one of which `x` nominally depends, and not by options.
        some_parameter = next(iter(jax.tree.leaves(params)), 0.0)
        return_map = make_return_map(walker, params, jax.lax.stop_gradient(options))
        return return_map(jnp.where(False, some_parameter, x))

    fixed_point = solve_fixed_point(
        map_section_state,
        guess,
        period_n=period_n,
        invariants=[lambda x: walker.evaluate_invariants(params, x)] if walker.invariants else (),
        # Steps conserve their invariants as accurately as they are computed.
        max_residual=jnp.maximum(MAX_RESIDUAL, 100.0 * options.rtol),
        differentiates_jacobian=False,
    )
    x, period, values = fixed_point.x, jnp.zeros((), fixed_point.x.dtype), []
    numbers = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves((params, guess))])
    is_valid = jnp.all(jnp.isfinite(numbers))
    outcome = jnp.where(is_valid, Outcome.STEPPED, Outcome.BAD_INPUT)
    last_step: Any = None
    for _ in range(period_n):
        step = compile_step(walker)(params, x, options)
        values.append(walker.measure_step(params, x, step, options))
        # The last step of a gait, or the first one that has failed.
        is_walking = outcome == Outcome.STEPPED
        last_step = select_trees_by_condition(is_walking, step, last_step) if last_step else step
        outcome = jnp.where(outcome == Outcome.STEPPED, step.outcome, outcome)
        x, period = step.section_state, period + step.duration
    has_failed = (outcome == Outcome.STEPPED) & ~fixed_point.converged
    outcome = jnp.where(has_failed, Outcome.NO_CYCLE_FOUND, outcome)
    means = {name: sum(value[name] for value in values) / period_n for name in values[0]}
    # Codes remain, which describe the failure.
    x, period, last_step, means = jax.tree.map(
        lambda value: (
            value
            if jnp.issubdtype(jnp.result_type(value), jnp.integer)
            else jnp.where(outcome == Outcome.STEPPED, value, jnp.zeros_like(value))
        ),
        (fixed_point.x, period, last_step, means),
    )
    make_finite = lambda value: jnp.where(jnp.isfinite(value), value, 0.0)
    fixed_point = fixed_point._replace(
        x=x,
        jacobian=make_finite(fixed_point.jacobian),
        residual=make_finite(fixed_point.residual),
    )
    n_steps = jnp.asarray(period_n, jnp.int32)
    return HybridGait(x, period, last_step, fixed_point, outcome.astype(jnp.int32), means, n_steps)


class ParameterizedWalker(eqx.Module):
    """Walker with the names of its parameters, whose values form a vector."""

    walker: AbstractWalker = eqx.field(static=True)
    structure: Any = eqx.field(static=True)
    named_domains: tuple[tuple[str, ParameterDomain], ...] = eqx.field(static=True)

    model_name: ClassVar[str] = "own_walker"
    own_parameters: ClassVar[None] = None
    is_compliant: ClassVar[bool] = True
    is_wheel: ClassVar[bool] = False

    def __repr__(self) -> str:
        return repr(self.walker)

    @property
    def fallback_model(self) -> "ParameterizedWalker":
        """Return the walker itself: there is no ladder of models."""
        return self

    @property
    def parameter_domains(self) -> dict[str, ParameterDomain]:
        """Return the domain of each parameter by name."""
        return dict(self.named_domains)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Return the names of the parameters."""
        return tuple(name for name, _ in self.named_domains)

    def collect_parameter_values(self, params: Any) -> Array:
        """Return the values of the parameters as a vector."""
        return jnp.stack([jnp.asarray(leaf, float) for leaf in jax.tree.leaves(params)])

    def get_parameter(self, params: Any, name: str) -> Any:
        """Return the value of one parameter."""
        return jax.tree.leaves(params)[self.parameter_names.index(name)]

    def with_parameter(self, params: Any, name: str, value: Any) -> tuple[Any, Any]:
        """Return the walker and its parameters with a new value of one of them."""
        return self, replace_tree_parameter(params, name, value)

    def from_parameter_values(self, values: Any, _n_legs: int) -> tuple[Any, Any]:
        """Return the walker and its parameters with the given values."""
        return self, jax.tree.unflatten(self.structure, list(values))

    def attach_laws(self, params: Any) -> Any:
        """Return the parameters, which contain all of a leg's law."""
        return params


def parameterize_walker(walker: AbstractWalker, params: Any) -> ParameterizedWalker:
    """Return a walker with the names of its parameters."""
    named_domains = tuple((x.name, x.domain) for x in list_tree_parameters(params))
    return ParameterizedWalker(walker, jax.tree.structure(params), named_domains)


class WalkerFinder(AbstractGaitFinder):
    """Finder of the gaits of a walker of the user, by Newton's method on its return map."""

    model: ParameterizedWalker
    n_legs: int = eqx.field(static=True)
    step_options: StepOptions
    coordinates: tuple[str, ...] = eqx.field(static=True)
    described_measures: tuple[Measure, ...] = eqx.field(static=True)
    period_n: int = eqx.field(static=True, default=1)

    n_coordinates: ClassVar[None] = None
    options_type: ClassVar[type] = StepOptions
    cycle_measures: ClassVar[tuple[str, ...]] = ()
    supports_cold_start: ClassVar[bool] = False

    @property
    def differentiable_measures(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(measure.name for measure in self.described_measures)

    default_measures = readable_measures = differentiable_measures  # type: ignore[assignment]

    def get_measure(self, name: str) -> Measure:
        name = name.removeprefix("-")  # of an upper bound
        return next(measure for measure in self.described_measures if measure.name == name)

    def measure_step(self, params: Any, start: Any, step: Any) -> dict[str, Array]:
        x = getattr(start, "section_state", start)
        return self.model.walker.measure_step(params, jnp.asarray(x), step, self.step_options)

    @property
    def step_measures(self) -> tuple[str, ...]:
        return ("period", *(measure.name for measure in self.model.walker.measures))

    @property
    def disturbance_unit(self) -> str:
        return "rad" if "slope" in self.model.walker.ground else "m"

    def compute_slope_response(
        self, params: Any, cycle: HybridGait, measure_names: Sequence[str]
    ) -> SlopeResponse:
        walker, x = self.model.walker, cycle.section_state
        ground_parameter = walker.ground.get("slope", walker.ground.get("height"))
        if ground_parameter is None:
            raise ValueError(
                "the walker does not declare where the ground enters: give it "
                'ground={"slope": name} or {"height": name}, with the name of its parameter.'
            )

        if walker.invariants:
            raise ValueError(
                "the walker conserves a quantity, so that deviations do not decay and no norm is "
                "finite: take a walker without invariants."
            )

        def take_step(start_and_ground: Array) -> Array:
            start, ground = start_and_ground[:-1], start_and_ground[-1]
            step_params = replace_tree_parameter(params, ground_parameter, ground)
            step = compile_step(walker)(step_params, start, self.step_options)
            measures = {"period": step.duration} | self.measure_step(step_params, start, step)
            values = [jnp.ravel(measures[name]) for name in measure_names]
            return jnp.concatenate([step.section_state, *values])

        ground = jax.tree.leaves(params)[find_tree_parameter(params, ground_parameter)]
        _, jacobian = evaluate_with_jacobian(take_step, jnp.append(x, ground))
        # A slope belongs to one step. The height of a foothold ends one step and begins the next.
        own_column = jacobian[:, -1:]
        previous_column = jnp.zeros_like(own_column) if "slope" in walker.ground else -own_column
        return SlopeResponse.from_jacobian(
            jnp.concatenate([jacobian[:, :-1], previous_column, own_column], 1), len(x)
        )

    def find_cycle(self, params: Any, cycle_guess: Any = None) -> HybridGait:  # type: ignore[override]
        guesses = propose_starts(self.model.walker, params) if cycle_guess is None else cycle_guess
        guesses = jnp.atleast_2d(jnp.asarray(guesses))
        return find_gait_from_guesses(
            (self.model.walker, self.period_n), params, guesses, self.step_options
        )

    def make_initial_guess(self, parameter_values: ParameterValues) -> Array:
        _, params = self.model.from_parameter_values(parameter_values, 0)
        return propose_starts(self.model.walker, params)

    def find_gait_by_walk(self, params: Any) -> Array | None:
        """Return the section state of a gait to which a walk leads, shape (1, n).

        Return None if no walk leads to a gait.
        """
        walker, period_n = self.model.walker, self.period_n
        gait = find_walker_gaits(walker, params, None, period_n, self.step_options)
        return gait.warm_start if gait.converged else None

    def read_step(self, cycle: Any) -> Any:
        return cycle.last_step

    def precompile_programs(self, params: Any) -> None:
        values = self.model.collect_parameter_values(params)
        self.find_gait(values, self.make_initial_guess(values))

    def take_gait_step(self, params: Any, section_state: Array) -> Any:
        return compile_step(self.model.walker)(params, section_state, self.step_options)

    @property
    def measure_reader(self) -> "WalkerMeasureReader":  # type: ignore[override]
        return WalkerMeasureReader(self.coordinates)


@dataclasses.dataclass(frozen=True)
class WalkerMeasureReader:
    """Function that returns a measure of a gait by its name."""

    coordinates: tuple[str, ...]

    def __call__(self, name: str, gait: HybridGait, step: Any = None) -> Array:
        if name in gait.values:
            return gait.values[name]
        if name == "period":
            return gait.period
        return gait.section_state[..., self.coordinates.index(name)]


def make_walker_finder(
    walker: Any, params: Any, options: StepOptions, guess: Any = None, period_n: int = 1
) -> WalkerFinder:
    """Return the finder of the gaits of a walker near given parameters.

    - `guess`: section coordinates from which each search begins, instead of the walker's starts.
    """
    params, guess = check_one_walker(params), convert_gait_guess(guess)
    start = propose_starts(walker, params) if guess is None else check_reals("guess", guess)
    start = jnp.atleast_1d(start)
    coordinates = name_coordinates(walker, jnp.shape(start)[-1])
    check_measure_names(walker, coordinates)
    described_measures = {
        "period": Measure("period", "s", "T", "period", "Duration of all steps of the gait."),
        **{
            name: Measure(name, unit, name, name.replace("_", " "), "Section coordinate.")
            for name, unit in coordinates.items()
        },
        **{measure.name: measure for measure in walker.measures},
    }
    check_arguments(walker, params, jnp.atleast_2d(start)[0], options, 1)
    return WalkerFinder(
        model=parameterize_walker(walker, params),
        n_legs=0,  # as of no wheel
        step_options=options,
        coordinates=tuple(coordinates),
        described_measures=tuple(described_measures.values()),
        period_n=check_int("period_n", period_n),
    )
