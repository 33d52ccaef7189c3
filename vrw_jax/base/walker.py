"""Interface of a walker: what steps, walks, gaits and studies need to know about it."""

import abc
import contextlib
import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax import lanes
from vrw_jax.base.checks import check_reals, check_type, has_traced_leaf
from vrw_jax.base.options import (
    StepOptions,
    find_tree_parameter,
    is_tree_in_domain,
    list_tree_parameters,
    replace_tree_parameter,
)
from vrw_jax.base.results import Measure, Outcome


class AdvanceResult(eqx.Module):
    """Section state, durations and outcome at the end of a step, without indicators and margins.

    - `section_state`: section coordinates at the end of the step;
    - `durations`: durations of the phases of the step, s; for the wheel of DLS, SLS-I and SLS-II;
    - `outcome`: an `Outcome`;
    - `solver_steps`: number of attempted solver steps;
    - `model_code`, `reason_code`: codes of the model that "auto" selected, and of the reason;
    - `engine`: see `StepOptions`.

    Examples:
        >>> vrw.AdvanceResult(jnp.ones(1), jnp.ones(1)).outcome
        0
    """

    section_state: Float[Array, "section ..."]
    durations: Float[Array, "phases ..."]
    outcome: Any = 0
    solver_steps: Any = 0
    model_code: Int[Array, "..."] | None = None
    reason_code: Int[Array, "..."] | None = None
    engine: str = eqx.field(static=True, default="")

    @property
    def is_complete(self) -> Any:
        """Return whether the step ended at the next touchdown."""
        return self.outcome == Outcome.STEPPED

    @property
    def duration(self) -> Array:
        """Return the duration of the step, s, or those of a batch on the first axis."""
        return jnp.sum(jnp.asarray(self.durations), -1)


class AbstractWalker(abc.ABC):
    """Walker: a step from section to section, and what functions need to know about it.

    `HybridSystem` and the models of the wheel are walkers. If your step is neither, for example in
    closed form, write a class with the method `advance`. What else a function needs is optional:

    - `coordinates`: names and units of the section coordinates;
    - `starts`: method that returns section coordinates from which the search for a gait begins, as
      rows with the best first, for given parameters;
    - `invariants`: functions of section coordinates and parameters that a step conserves;
    - `measures`: measures of a gait, see `vrw.measure`;
    - `ground`: `{"height": name}` names the parameter that is the rise from the foothold of a step
      to the next one, so that walks and batches take `heights` above the line of this rise.
      `{"slope": name}` names the slope of a step. `first_passage` draws either at random;
    - `sample_motion`: method that returns the motion during a step, for fits to time series.

    Parameters are a tree of numbers, such as a dictionary or an `equinox.Module`.

    Examples:
        >>> class JuggledBall(vrw.AbstractWalker):
        ...     def advance(self, params, x, options):
        ...         v = params["restitution"] * x + params["kick"]
        ...         return vrw.AdvanceResult(v, 2.0 * v / 9.81)
        >>> params = {"restitution": 0.5, "kick": 1.0}
        >>> gait = vrw.limit_cycle(params, model=JuggledBall(), guess=[1.0])
        >>> print(f"{gait.section_state[0]:.3f} m/s, {gait.period:.3f} s")
        2.000 m/s, 0.408 s
    """

    is_wheel: ClassVar[bool] = False
    """Whether the walker is a model of the wheel, for which functions have methods of their own."""
    can_start_within_gait_step: ClassVar[bool] = False
    """Whether the walker has `finish_step`, so that pushes within a step can be computed."""
    coordinates: Mapping[str, str] = {}
    starts: Callable[..., Any] | None = None
    invariants: Sequence[Callable[..., Any]] = ()
    measures: Sequence[Measure] = ()
    ground: Mapping[str, str] = {}

    @property
    def leg_period(self) -> int:
        """Return the number of steps after which the legs are in the same roles again."""
        return 1

    @abc.abstractmethod
    def advance(self, params: Any, x: Any, options: StepOptions) -> AdvanceResult:
        """Return the end of one step of one element from section coordinates `x`."""

    def advance_checked(self, params: Any, x: Any, options: StepOptions) -> AdvanceResult:
        """Return the end of one step, with BAD_INPUT if a parameter or the start is not valid."""
        result = self.advance(params, x, options)
        if self.is_wheel:  # Steps of wheels contain this check.
            return result
        is_valid = is_tree_in_domain(params) & jnp.all(jnp.isfinite(x))
        outcome = jnp.where(is_valid, result.outcome, Outcome.BAD_INPUT)
        return dataclasses.replace(result, outcome=outcome)

    def take_step(self, params: Any, x: Any, options: StepOptions) -> Any:
        """Return all results of one step: those of `advance`, if there are no others."""
        return self.advance_checked(params, x, options)

    def with_parameter(self, params: Any, name: str, value: Any) -> tuple[Any, Any]:
        """Return the walker and its parameters with a new value of one of them."""
        return self, replace_tree_parameter(params, name, value)

    def select_params(self, params: Any, step_index: Any) -> Any:
        """Return the parameters in a step of a gait: the same, unless legs alternate."""
        return params

    def with_step_ground(self, params: Any, step_parameters: Any) -> tuple[Any, Any]:
        """Return the walker and all its parameters in one step of a walk.

        - `step_parameters`: those that differ from step to step; the others are in `params`.
        """
        return self, eqx.combine(step_parameters, params)

    def put_on_heights(self, params: Any, heights: Any, n_steps: int) -> Any:
        """Return the parameters with the rises between footholds, one for each step of a walk.

        - `heights`: heights of the footholds above the line of the rise in `params` on the last
          axis, from that at the start of the walk.
        """
        if "height" not in self.ground:
            raise ValueError(
                "heights are given, but the walker does not declare what they change: give it "
                'ground={"height": name}, with the name of its parameter.'
            )
        heights = check_reals("heights", heights, "give one height for each foothold, in m")
        if heights.ndim == 0 or heights.shape[-1] != n_steps + 1:
            raise ValueError(
                f"heights have shape {heights.shape}, but a walk of {n_steps} steps begins and "
                f"ends on a foothold: give {n_steps + 1} heights."
            )
        name = self.ground["height"]
        rise = jnp.asarray(jax.tree.leaves(params)[find_tree_parameter(params, name)])
        if 0 < rise.ndim < heights.ndim:
            rise = rise[:, None]
        return replace_tree_parameter(params, name, rise + jnp.diff(heights))

    def evaluate_invariants(self, params: Any, x: Array) -> Array:
        """Return the quantities that a step conserves."""
        return jnp.stack([invariant(x, params) for invariant in self.invariants])

    def measure_step(
        self,
        params: Any,
        x: Array,
        step: Any,
        options: StepOptions,
        measures: Sequence[Measure] | None = None,
    ) -> dict[str, Array]:
        """Return the values of measures, by default its own, for the step from `x`, by name."""
        measures = self.measures if measures is None else measures
        return {measure.name: jnp.asarray(measure(step, params)) for measure in measures}

    def sample_motion(
        self, params: Any, x: Any, options: StepOptions, n_samples: int
    ) -> tuple[dict[str, Any], Any]:
        """Return the motion during a step, with which `vrw.fit` compares measured time series.

        The first result contains variables by name, each at `n_samples` equidistant times of every
        phase, shape (phases, n_samples). The second contains the durations of the phases, s.
        """
        raise TypeError(
            f"the motion within a step of a {type(self).__name__} is unknown, so that only its "
            "steps can be fitted: write its method sample_motion."
        )

    def check_definition(self, params: Any, x: Any, name: str) -> None:
        """Raise an error if functions of the walker do not fit to parameters and a start.

        The arguments are shapes, and `name` is "x" for section coordinates.
        """
        end = jax.eval_shape(self.advance, params, x, StepOptions())
        if end.section_state.shape != x.shape:
            raise ValueError(
                f"advance returns section coordinates of shape {end.section_state.shape} for "
                f"{name} of shape {x.shape}: both must be the same."
            )
        if len(end.durations.shape) != 1:
            raise ValueError(
                f"advance returns durations of shape {end.durations.shape}, but they have one "
                "entry for each phase of the step: give a vector."
            )


def name_section(walker: AbstractWalker) -> str:
    """Return the name of the event at which steps begin and end, for sentences."""
    return getattr(walker, "section", "section").replace("_", " ")


def is_own_walker(model: Any) -> TypeGuard[AbstractWalker]:
    """Return whether a model is a walker of the user, and no model of the wheel."""
    return isinstance(model, AbstractWalker) and not model.is_wheel


def check_parameters(params: Any) -> Any:
    """Return a tree of parameters as arrays, or raise an error."""

    def check(leaf: Any) -> Array:
        remedy = (f"give an instance, {leaf.__name__}()",) if isinstance(leaf, type) else ()
        return check_reals("a parameter", leaf, *remedy)

    return jax.tree.map(check, params)


def check_one_walker(params: Any) -> Any:
    """Return a tree of parameters as numbers within their domains, or raise an error.

    The error names the first parameter that has a batch axis or is outside its domain. The values
    of traced parameters are not checked.
    """
    params = check_parameters(params)
    for parameter in list_tree_parameters(params):
        if parameter.value.ndim:
            raise ValueError(
                f"{parameter.name} has shape {parameter.value.shape}, but this function is for one "
                "walker whose parameters are numbers: give one number."
            )
        if not has_traced_leaf(parameter.value):
            parameter.domain.require_value_in_domain(parameter.name, float(parameter.value))
    return params


@contextlib.contextmanager
def name_missing_parameters(params: Any) -> Iterator[None]:
    """Return a context in which a parameter that a walker lacks raises an error with its name."""
    try:
        yield
    except (KeyError, AttributeError, TypeError) as error:
        names = [parameter.name for parameter in list_tree_parameters(params)]
        name, kind = error.args[0] if error.args else None, type(params).__name__
        is_list = lambda node: isinstance(node, list)
        if "'list'" in str(name) and any(map(is_list, jax.tree.leaves(params, is_leaf=is_list))):
            raise TypeError(
                "params contains a list, each entry of which is a parameter of its own: give a "
                "batch of values as np.array([...])."
            ) from error
        if isinstance(error, AttributeError) and _is_node(error.obj, jax.tree.structure(params)):
            missing = f"the attribute {error.name!r} of a {type(error.obj).__name__}"
        elif isinstance(error, KeyError) and isinstance(name, str) and name not in names:
            missing = repr(name)
        elif name == f"{kind!r} object is not subscriptable":
            missing = f"an entry of a {kind} in brackets"
        else:
            raise
        raise ValueError(
            f"a function of the walker reads {missing}, but params is a {kind}, which contains "
            f"{', '.join(names) or 'nothing'}: add it to params, or correct the function."
        ) from error


def check_measure_names(walker: AbstractWalker, coordinates: Iterable[str]) -> None:
    """Raise an error if a measure has the name of another one or of a coordinate."""
    names = Counter((*coordinates, *(measure.name for measure in walker.measures)))
    (name, count), *_ = names.most_common(1) or [("", 0)]
    if count > 1:
        raise ValueError(
            f"{count} measures or coordinates have the name {name!r}, but each has its own: rename "
            "the measure, as @vrw.measure(name)."
        )


def propose_starts(walker: AbstractWalker, params: Any) -> Array:
    """Return the starts of a walker with these parameters, shape (starts, n)."""
    if walker.starts is None:
        raise ValueError(
            "this walker has no starts for searches and walks: give section coordinates as guess "
            "or start, or starts= in the definition of the walker."
        )
    with name_missing_parameters(params):
        return jnp.atleast_2d(check_reals("starts", walker.starts(params)))


def _is_node(tree: Any, structure: Any) -> bool:
    """Return whether a tree, of more than a number, has the structure of a node of another one."""
    if structure.num_leaves == 0 or structure.num_nodes == 1:
        return False
    return jax.tree.structure(tree) == structure or any(
        _is_node(tree, child) for child in structure.children()
    )


def find_batch_length(params: Any, x: Any, name: str = "x", row_axes: int = 1) -> int:
    """Return the length of a batch, or raise an error with the length of each array.

    - `row_axes`: number of axes of `x` for one element.
    """
    arrays = [(entry.name, entry.value) for entry in list_tree_parameters(params)]
    lengths = {key: len(array) for key, array in arrays if np.ndim(array)}
    lengths |= {name: len(x)} if x.ndim > row_axes else {}
    if len({*lengths.values()}) != 1:
        entries = ", ".join(f"{n} entries of {key or 'params'}" for key, n in lengths.items())
        raise ValueError(
            f"the batch has {entries or 'no arrays'}, but parameters that are arrays and {name} "
            "have one common length: give arrays of one length, and numbers for all elements."
        )
    return next(iter(lengths.values()))


def check_arguments(
    walker: AbstractWalker,
    params: Any,
    x: Any,
    options: StepOptions | None,
    max_axes: int,
    name: str = "x",
) -> tuple[Any, Array, StepOptions]:
    """Return parameters, section coordinates and options of a step, or raise an error.

    - `max_axes`: 2 if there may be a batch axis, and else 1.
    """
    options = StepOptions() if options is None else options
    check_type("options", options, StepOptions, "give vrw.StepOptions()")
    params, x = check_parameters(params), check_reals(name, x)
    if not 1 <= x.ndim <= max_axes:
        shapes = "(n,)" if max_axes == 1 else "(n,) or (batch, n)"
        raise ValueError(f"{name} has shape {x.shape}, but its shape must be {shapes}.")
    if max_axes == 2:
        find_batch_length(params, x, name)
    leaves, structure = jax.tree.flatten(params)
    leaf_shapes = tuple((leaf.shape[max_axes - 1 :], leaf.dtype) for leaf in leaves)
    with name_missing_parameters(params):
        _check_definition(walker, structure, leaf_shapes, x.shape[-1:], x.dtype, name)
    options.check_tolerances(x.dtype)
    return params, x, options


@functools.lru_cache  # Walks of many calls check the same shapes.
def _check_definition(
    walker: AbstractWalker, structure: Any, shapes: tuple, x_shape: tuple, x_dtype: Any, name: str
) -> None:
    params = structure.unflatten([jax.ShapeDtypeStruct(*shape) for shape in shapes])
    walker.check_definition(params, jax.ShapeDtypeStruct(x_shape, x_dtype), name)


def find_batch_axes(params: Any, x: Array) -> tuple:
    """Return the axes of parameters, section coordinates and options in a batch."""
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, params)
    return axes, 0 if x.ndim == 2 else None, None


@functools.lru_cache
def compile_step(walker: AbstractWalker) -> Any:
    """Return the compiled step, the same for each call, so that JAX traces it once."""
    return lanes.jit(walker.take_step)


def step_batch_of_walker(
    walker: AbstractWalker, params: Any, x: Any, options: StepOptions | None
) -> Any:
    """Return one step of each element of a batch as NumPy arrays, computed on all cores."""
    params, x, options = check_arguments(walker, params, x, options, 2)
    in_axes = find_batch_axes(params, x)
    return compile_step(walker).batch(params, x, options, in_axes=in_axes)


def make_return_map(
    walker: AbstractWalker, params: Any, options: StepOptions
) -> Callable[[Float[Array, " n"]], Float[Array, " n"]]:
    """Return the map from section coordinates to those after one step, for Newton's method.

    The map returns NaN if the step fails, so that its last state is not taken for a return.
    """

    def map_section_state(x: Array) -> Array:
        step = walker.advance_checked(params, x, options)
        return jnp.where(step.outcome == Outcome.STEPPED, step.section_state, jnp.nan)

    return map_section_state


def name_coordinates(walker: AbstractWalker, n: int) -> dict[str, str]:
    """Return the names of the `n` section coordinates with their units.

    Coordinates without names are numbered.
    """
    if not walker.coordinates:
        return {f"x{i}": "1" for i in range(n)}
    if len(walker.coordinates) != n:
        raise ValueError(
            f"coordinates names {', '.join(walker.coordinates)}, but the section has {n} "
            "coordinates: name each."
        )
    return dict(walker.coordinates)
