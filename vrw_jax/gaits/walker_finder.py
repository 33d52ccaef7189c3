"""Gaits of a walker of the user as functions of the vector of its parameters."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.base.checks import check_int
from vrw_jax.base.measures import Measure
from vrw_jax.base.options import StepOptions
from vrw_jax.base.parameters import ParameterDomain, list_tree_parameters
from vrw_jax.base.walker import (
    AbstractWalker,
    check_arguments,
    check_parameters,
    compile_step,
    name_coordinates,
)
from vrw_jax.gaits.finder import (
    AbstractGaitFinder,
    Gait,
    GaitBranchPoint,
    ParameterValues,
    compute_value_and_tangents,
    move_derivative_axis_first,
)
from vrw_jax.gaits.hybrid_gait import HybridGait, find_gait_from_guesses
from vrw_jax.lanes.autodiff import evaluate_with_jacobian


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

    def from_parameter_values(self, values: Any, _n_legs: int) -> tuple[Any, Any]:
        """Return the walker and its parameters with the given values."""
        return self, jax.tree.unflatten(self.structure, list(values))

    def attach_laws(self, params: Any) -> Any:
        """Return the parameters, which contain all of a leg's law."""
        return params


class WalkerFinder(AbstractGaitFinder):
    """Finder of the gaits of a walker of the user, by Newton's method on its return map."""

    model: ParameterizedWalker
    n_legs: int = eqx.field(static=True)
    step_options: StepOptions
    coordinates: tuple[str, ...] = eqx.field(static=True)
    described_measures: tuple[Measure, ...] = eqx.field(static=True)
    period_n: int = eqx.field(static=True, default=1)

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

    def find_cycle(self, params: Any, cycle_guess: Any = None) -> HybridGait:  # type: ignore[override]
        guesses = self.model.walker.starts(params) if cycle_guess is None else cycle_guess  # type: ignore[misc]
        return find_gait_from_guesses(
            (self.model.walker, self.period_n), params, jnp.atleast_2d(guesses), self.step_options
        )

    def make_initial_guess(self, parameter_values: ParameterValues) -> Array:
        _, params = self.model.from_parameter_values(parameter_values, 0)
        return jnp.atleast_2d(self.model.walker.starts(params))  # type: ignore[misc]

    @eqx.filter_jit
    def find_gait(self, parameter_values: ParameterValues, cycle_guess: Any) -> Gait:
        cycle, jacobian = evaluate_with_jacobian(
            lambda values: self.find_cycle_from_values(values, cycle_guess), parameter_values
        )
        derivatives = move_derivative_axis_first(jacobian)
        coordinates = compute_value_and_tangents(
            lambda gait: jnp.append(gait.section_state, gait.period), (cycle,), (derivatives,)
        )
        point = GaitBranchPoint(*coordinates, jnp.ones(1), cycle.fixed_point.jacobian)
        return Gait(cycle, cycle.last_step, derivatives, derivatives.last_step, point)

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
    params = check_parameters(params)
    named_domains = []
    for parameter in list_tree_parameters(params):
        if parameter.value.ndim:
            raise ValueError(
                f"{parameter.name} has shape {parameter.value.shape}, but this function is for one "
                "walker whose parameters are numbers: give one number."
            )
        parameter.domain.require_value_in_domain(parameter.name, float(parameter.value))
        named_domains.append((parameter.name, parameter.domain))
    if walker.starts is None and guess is None:
        raise ValueError(
            "this walker has no starts, but the search for its gaits begins there: give a function "
            "starts= of its parameters in its definition, which returns section coordinates."
        )
    start = walker.starts(params) if guess is None else guess
    coordinates = name_coordinates(walker, jnp.shape(start)[-1])
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
        model=ParameterizedWalker(walker, jax.tree.structure(params), tuple(named_domains)),
        n_legs=0,  # as of no wheel
        step_options=options,
        coordinates=tuple(coordinates),
        described_measures=tuple(described_measures.values()),
        period_n=check_int("period_n", period_n),
    )
