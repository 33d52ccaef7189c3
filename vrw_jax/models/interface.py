"""Interface of every model: its declarations, and the methods that compute its steps."""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vrw_jax.base.checks import has_traced_leaf
from vrw_jax.base.elementwise import Elementwise
from vrw_jax.base.options import ParameterDomain, StepOptions
from vrw_jax.base.results import Measure, format_quantity
from vrw_jax.base.walker import AbstractWalker, AdvanceResult
from vrw_jax.models.measures import MEASURES
from vrw_jax.models.step_results import SectionState, combine_steps
from vrw_jax.wheel.laws import count_kinks
from vrw_jax.wheel.params import (
    LAW_NAMES,
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    WheelLaws,
    WheelParams,
    WheelUnits,
    list_law_parameters,
    make_wheel_from_parameters,
)
from vrw_jax.wheel.transitions import compute_foot_distance

StepGroundValues = tuple[Array, ...]
"""Arrays that describe the ground under one step or under all steps: slopes, rises and, for some
models, friction coefficients. `with_step_ground` takes the arrays of one step.
"""


class AbstractWheel(AbstractWalker, eqx.Module):
    """Model of the wheel.

    The classes of models are final, and the rest of the library uses only this interface.

    `advance` and `take_step` are compiled on their first call, once per structure of their
    arguments.

    Examples:
        >>> isinstance(vrw.RigidWheel(), vrw.AbstractWheel)
        True
    """

    is_wheel = True  # type: ignore[misc]  # without annotation no field
    model_name: eqx.AbstractClassVar[str]
    """Name of the model that results report."""
    reports_contacts: eqx.AbstractClassVar[bool]
    """Whether trajectories report the contact mode of every leg instead of the paper's phases."""
    batch_kernel: ClassVar[str] = ""
    """Kind of the compiled batch kernel: "phases" for the paper's phases, "legs", or "" for no
    kernel. Gaits of the paper's phases are found by collocation, and gaits of "legs" by walks of
    many wheels. Any other gait is found by Newton's method for the return map.
    """
    is_compliant: ClassVar[bool] = True
    """Whether springs and dampers affect the motion. Only then do tuning and scans vary their
    parameters.
    """
    # Without annotation, the following attributes are no fields, and stores do not contain them.
    commands = frozenset[str]()
    """Commands that accept the model: "scan", "map", "tune", "branch" and "explore"."""
    fixed_fields_of_tolerance = None
    """Fields that must have their default values for a measure requested to a tolerance. None means
    that the model does not support measures to a tolerance.
    """
    can_walk_on_uneven_ground = True
    """Whether the slope may change from step to step of a walk."""
    can_start_within_gait_step = False
    """Whether the model has `finish_step`, so that a step can be disturbed at any instant."""

    def __new__(cls, *_: Any, **settings: Any) -> "AbstractWheel":
        """Raise a `TypeError` if a model with the paper's laws is given another law."""
        for law_name, place in {"leg_force": "legs", "hub_torque": "hub"}.items():
            if law_name in settings and law_name not in cls.__dataclass_fields__:
                raise TypeError(
                    f"{law_name} is given, but a {cls.__name__} has no law of its own for the "
                    f"{place}: give vrw.ViscoelasticWheel({law_name}=...), or another model with "
                    "compliant legs."
                )
        return super().__new__(cls)

    def __repr__(self) -> str:
        if has_traced_leaf(self):
            return eqx.tree_pformat(self)

        def format_module(module: eqx.Module) -> str:
            field_texts = ", ".join(f"{name}={format_field(x)}" for name, x in vars(module).items())
            return f"{type(module).__name__}({field_texts})"

        def format_field(x: Any) -> str:
            if eqx.is_array(x):
                return repr(float(x)) if x.ndim == 0 else format_quantity(x, "")
            return (
                format_module(x)
                if isinstance(x, eqx.Module)
                else getattr(x, "__qualname__", repr(x))
            )

        return format_module(self)

    @property
    def fallback_model(self) -> "AbstractWheel":
        """Return the model that is valid for any start.

        It is the most general model of a ladder of models; any other model returns itself.
        """
        return self

    def collect_parameter_values(self, params: WheelParams) -> Float[Array, " n_values"]:
        """Return the value of each parameter in `parameter_names`, for one wheel on this model's
        ground.
        """
        return jnp.stack(
            [jnp.asarray(x, params.damping.dtype) for x in self.list_parameter_values(params)]
        )

    @property
    def laws(self) -> WheelLaws | None:
        """Return the laws that a user gives, or None for the paper's."""
        leg, hub = (getattr(self, law_name, None) for law_name in LAW_NAMES)
        return None if leg is None and hub is None else WheelLaws(leg, hub)

    def with_laws(self, laws: WheelLaws | None) -> Any:
        """Return the model with other laws, such as those that `attach_laws` has added."""
        if laws is None and self.laws is None:
            return self
        laws = laws or WheelLaws()
        return eqx.tree_at(
            lambda model: [getattr(model, law_name) for law_name in LAW_NAMES],
            self,
            [laws.leg, laws.hub],
            is_leaf=lambda x: x is None,
        )

    @property
    def own_parameters(self) -> Any:
        """Return the values that are the model's own parameters, as a pytree."""
        return self.laws

    @property
    def own_parameter_domains(self) -> dict[str, ParameterDomain]:
        """Return the domains of these parameters by name: those of laws, and then friction."""
        return {x.name: x.domain for x in list_law_parameters(self.laws)}

    @property
    def parameter_domains(self) -> dict[str, ParameterDomain]:
        """Return the domains of the inputs on which the motion depends, by name.

        The parameters of the wheel come first.
        """
        return PARAMETER_DOMAINS | self.own_parameter_domains

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Return the names of `parameter_domains`."""
        return (*PARAMETER_NAMES, *self.own_parameter_domains)

    @property
    def units(self) -> dict[str, str]:
        """Return the SI units of all measures and parameters, by name."""
        domains = self.parameter_domains
        return {name: measure.unit for name, measure in MEASURES.items()} | {
            name: domain.unit or "1" for name, domain in domains.items()
        }

    def attach_laws(self, params: WheelParams) -> WheelParams:
        """Return the parameters with the laws of this model, unless they have laws already."""
        if params.laws is not None or self.laws is None:
            return params
        if self.leg_period == 2 and params.n_legs % 2:
            raise ValueError(
                f"n_legs is {params.n_legs}, but legs alternate only if their number is even: give "
                "an even number, or one law for all legs."
            )
        return params.attach_laws(self.laws)

    def list_parameter_values(self, params: WheelParams) -> list[Any]:
        """Return the value of each parameter in `parameter_names`, for one wheel or a batch."""
        wheel_values = [getattr(params, parameter_name) for parameter_name in PARAMETER_NAMES]
        return [*wheel_values, *self._list_own_values(params)]

    def _list_own_values(self, params: WheelParams) -> list[Any]:
        """Return the values of the own parameters, with those of attached laws."""
        model = self if params.laws is None else self.with_laws(params.laws)
        return jax.tree.leaves(model.own_parameters)

    def get_parameter(self, params: WheelParams, parameter_name: str) -> Any:
        """Return the value of one parameter of `parameter_names`."""
        return self.list_parameter_values(params)[self.parameter_names.index(parameter_name)]

    def collect_batch_parameter_values(
        self, params: WheelParams
    ) -> Float[np.ndarray, "wheels n_values"]:
        """Return the values of `parameter_names` for each wheel in a batch, computed with NumPy.

        JAX would compile a program for each batch size.
        """
        parameter_columns = map(np.asarray, self.list_parameter_values(params))
        return np.stack(np.broadcast_arrays(*parameter_columns), -1)

    def from_parameter_values(
        self, parameter_values: Array | tuple[Array, ...], n_legs: int
    ) -> tuple["AbstractWheel", WheelParams]:
        """Return a model and a wheel with the given values of the parameters in `parameter_names`.

        This function is the inverse of `collect_parameter_values`. The values may be tracers.
        """
        n = len(PARAMETER_NAMES)
        model = self._replace_own_parameters(parameter_values[n:])
        return model, make_wheel_from_parameters(parameter_values[:n], n_legs)

    def _replace_own_parameters(self, values: Any) -> "AbstractWheel":
        return self.with_laws(jax.tree.unflatten(jax.tree.structure(self.laws), list(values)))

    def without_values(self) -> "AbstractWheel":
        """Return the model with 1 as the value of each parameter of its laws."""
        return self.with_laws(jax.tree.map(jnp.ones_like, self.laws))

    def with_parameter(
        self, params: WheelParams, parameter_name: str, parameter_value: Elementwise
    ) -> tuple["AbstractWheel", WheelParams]:
        """Return the model and the wheel with a new value of the parameter `parameter_name`.

        The parameter is one of `parameter_names`, and the value may be a tracer.
        """
        if parameter_name not in PARAMETER_NAMES:
            own_values = self._list_own_values(params)
            own_values[list(self.own_parameter_domains).index(parameter_name)] = parameter_value
            model = self._replace_own_parameters(own_values)
            if params.laws is not None:
                params = params.attach_laws(model.laws)
            return model, params
        return self, eqx.tree_at(
            lambda wheel: getattr(wheel, parameter_name), params, parameter_value
        )

    @abc.abstractmethod
    def advance(self, params: WheelParams, x: SectionState, options: StepOptions) -> AdvanceResult:
        """Return the section state after one walking step from `x`, with its durations and outcome.

        The results are differentiable in any mode, to any order.
        """

    @abc.abstractmethod
    def take_step(self, params: WheelParams, x: SectionState, options: StepOptions) -> Any:
        """Return all results of one walking step from the section state `x`.

        The results include indicators, margins and energies. The type is `StepResult`, or the
        model's counterpart of `StepResult`. The results are differentiable in any mode.
        """

    def take_steps(self, params: WheelParams, x: np.ndarray, options: StepOptions) -> Any:
        """Return the steps of a batch of wheels, whose arrays have the batch on their first axis.

        The function is not traced by JAX, and returns NumPy arrays.
        """
        return jax.tree.map(np.asarray, _take_steps(self, params, x, options))

    def measure_force_peaks(
        self, params: WheelParams, x: SectionState, options: StepOptions
    ) -> dict[str, Array]:
        """Return the `measures.FORCE_PEAK_MEASURES` of one walking step from the section state `x`.

        The measures have first derivatives. Raise a `ValueError` for a model without these
        measures.
        """
        raise ValueError(
            f"force peaks are measured for a {type(self).__name__}, but its steps have no such "
            "measures: take vrw.ViscoelasticWheel() or vrw.UnilateralWheel()."
        )

    def measure_step(
        self,
        params: WheelParams,
        x: SectionState,
        step: Any,
        options: StepOptions,
        measures: Sequence[Measure] | None = None,
    ) -> dict[str, Array]:
        for measure in measures or ():
            if measure.phases:
                raise ValueError(
                    f"{measure.name} is a measure of phases, but a {type(self).__name__} has none: "
                    "take model=vrw.ViscoelasticWheel()."
                )
        return super().measure_step(params, x, step, options, measures)

    @abc.abstractmethod
    def sample_step(
        self, params: WheelParams, x: SectionState, options: StepOptions, n_samples: int
    ) -> Any:
        """Return the motion during a walking step at `n_samples` times of each phase.

        The type is `Trajectory`, or the model's counterpart of `Trajectory`.
        """

    def finish_step(
        self,
        params: WheelParams,
        phase_index: int,
        foot_distance: Elementwise,
        phase_state: Float[Array, " 6"],
        options: StepOptions,
    ) -> AdvanceResult:
        """Compute the rest of a step on flat ground, starting from a state within one of its
        phases.

        - `phase_index`: index of the phase (0 for DLS, 1 for SLS-I, 2 for SLS-II);
        - `foot_distance`: distance between the two feet in the double support of this step, m;
        - `phase_state`: (theta, L1, L2) and their rates, rad, m, rad/s, m/s.

        Only models with `can_start_within_gait_step` implement this method.
        """
        raise NotImplementedError

    def make_vertical_rate_map(self, params: WheelParams) -> Any:
        """Return the map of a step in closed form, by which `first_passage` computes means.

        The result is None if there is no such map, so that walks are sampled.
        """
        return None

    def explain_impossible_gait(self, params: WheelParams) -> str:
        """Return a sentence that states why one wheel can't have a gait, or "" if it may have one.

        During a gait, gravity must supply the energy that impacts and dampers take.
        """
        slope, hub_torque = float(params.slope), (self.laws or WheelLaws()).hub
        has_motor = hub_torque is not None and getattr(hub_torque, "torque", 1.0) > 0.0
        if slope > 0.0 or has_motor:
            return ""
        return (
            f"No steady gait can exist: the slope is {slope:g} rad, but impacts and dampers take "
            "energy, which gravity supplies on a positive slope only."
        )

    @abc.abstractmethod
    def compute_default_start(self, params: WheelParams) -> SectionState:
        """Return a section state from which a walk can start."""

    def split_ground_by_step(
        self, params: WheelParams, n_steps: int, heights: Array | None = None
    ) -> StepGroundValues | None:
        """Return the ground of each step if heights are given, or if slope or friction are arrays
        with one entry per step.

        Return None otherwise, and for models that do not support uneven ground. If the legs
        alternate, the indices of the steps precede the ground.
        """
        step_ground = self._split_uneven_ground(params, n_steps, heights)
        if self.leg_period == 1:
            return step_ground
        return (jnp.arange(n_steps), *(step_ground or ()))

    def _split_uneven_ground(
        self, params: WheelParams, n_steps: int, heights: Array | None
    ) -> StepGroundValues | None:
        if not self.can_walk_on_uneven_ground:
            return None
        if heights is not None:
            rises = compute_rises(heights, n_steps)
            mean_slopes = jnp.full(n_steps, params.slope)
            return (jnp.stack([mean_slopes, rises[:-1], rises[1:]], axis=-1),)
        if jnp.ndim(params.slope) == 0:
            return None
        line_slopes = complete_ground_line_slopes(params.slope, n_steps)
        return (jnp.stack([line_slopes[:-1], line_slopes[1:]], axis=-1),)

    @property
    def has_kinks(self) -> bool:
        """Return whether the law of the legs declares kinks."""
        return count_kinks((self.laws or WheelLaws()).leg) > 0

    @property
    def leg_period(self) -> int:
        """Return the number of steps after which the legs have the same parameters again."""
        return (self.laws or WheelLaws()).leg_period

    def exchange_legs(self, parameter_matrix: np.ndarray) -> None:
        """Change a matrix of parameters, whose rows have the order of `parameter_names`, to those
        of the next step, if the legs alternate.
        """
        if self.leg_period == 2:
            turns = parameter_matrix[self.parameter_names.index("leg.turn")]
            turns[:] = turns < 0.5

    def select_params(self, params: WheelParams, step_index: Array | int) -> WheelParams:
        """Return the parameters in a step of a walk, which differ from step to step if the legs
        alternate.
        """
        laws = self.attach_laws(params).laws
        if laws is None or self.leg_period == 1:
            return params
        return params.attach_laws(laws.exchange_legs(step_index % 2))

    def list_models_of_legs(self) -> list["AbstractWheel"]:
        """Return the model as it is in each step until the legs repeat."""
        laws = self.laws
        if laws is None or self.leg_period == 1:
            return [self]
        return [self.with_laws(laws.exchange_legs(k)) for k in range(self.leg_period)]

    def take_step_of_gait(self, params: WheelParams, x: Any, options: StepOptions) -> Any:
        """Return one step, or all steps until the legs repeat as one, see `combine_steps`."""
        result = self.take_step(params, x, options)
        for k in range(1, self.leg_period):
            step = self.take_step(self.select_params(params, k), result.section_state, options)
            result = combine_steps(result, step)
        return result

    def with_step_ground(
        self, params: WheelParams, step_ground: StepGroundValues
    ) -> tuple["AbstractWheel", WheelParams]:
        """Return the model and the wheel on the ground of one walking step, with its legs.

        `step_ground` contains the values of one step from `split_ground_by_step`.
        """
        if self.leg_period > 1:
            params = self.select_params(params, step_ground[0])
            step_ground = step_ground[1:]
        return self._put_on_ground(params, step_ground) if step_ground else (self, params)

    def _put_on_ground(
        self, params: WheelParams, step_ground: StepGroundValues
    ) -> tuple["AbstractWheel", WheelParams]:
        """Return the model and the wheel with values of the slope that `select_stance_line`
        separates.
        """
        return self, eqx.tree_at(lambda wheel: wheel.slope, params, step_ground[0])

    def compute_foot_distance(self, params: WheelParams, x: Array) -> Elementwise:
        """Return the distance between the landing foot and the foot of Leg 1 in the section state
        `x`, along the line that joins them, m.
        """
        return compute_foot_distance(params.symbols(), x[0])

    def count_section_entries(self, params: WheelParams) -> int:
        """Return the number of entries of a section state."""
        return 3

    def count_continuous_section_entries(self, params: WheelParams) -> int:
        """Return the number of entries of a section state that vary continuously.

        These entries come first. The other entries are integer codes.
        """
        return self.count_section_entries(params)

    def collect_section_units(self, wheel_units: WheelUnits, n_legs: int) -> list[Elementwise]:
        """Return the unit of each entry of a section state, computed from `wheel_units`."""
        return [
            wheel_units.length_unit / wheel_units.length_unit,
            wheel_units.rate_unit,
            wheel_units.velocity_unit,
        ]

    def complete_section_state(self, params: WheelParams, x: Array) -> Array:
        """Return `x` as a section state of this model.

        `x` may be the paper's section state, which has three entries.
        """
        return x


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0, None))
def _take_steps(model: AbstractWheel, params: WheelParams, x: Array, options: StepOptions) -> Any:
    return model.take_step(params, x, options)


def complete_ground_line_slopes(slope: Array, n_steps: int) -> Array:
    """Return the slopes of the n + 1 lines of the ground under a walk of n steps, rad.

    If `slope` has n entries, the last slope is repeated.
    """
    require_stepwise_shape("slope", slope, n_steps)
    return slope if len(slope) > n_steps else jnp.append(slope, slope[-1:])


def compute_rises(heights: Array, n_steps: int) -> Array:
    """Return the height of each of the n + 1 footholds of a walk minus that of the foothold before.

    If `heights` has n + 1 entries, the foothold before the walk lies on the mean line.
    """
    if jnp.shape(heights) not in ((n_steps + 1,), (n_steps + 2,)):
        raise ValueError(
            f"heights has shape {jnp.shape(heights)}, but a walk of {n_steps} steps of one wheel "
            f"takes {n_steps + 1} heights of footholds, or {n_steps + 2} with the foothold before "
            "the walk: map over batches of wheels with jax.vmap."
        )
    return jnp.diff(heights, prepend=0.0)[-(n_steps + 1) :]


def require_stepwise_shape(quantity_name: str, stepwise_values: Array, n_steps: int) -> None:
    """Raise a `ValueError` unless an array has n or n + 1 entries for n steps."""
    if jnp.shape(stepwise_values) not in ((n_steps,), (n_steps + 1,)):
        n_steps_text = "a step" if n_steps == 1 else f"a walk of {n_steps} steps"
        raise ValueError(
            f"{quantity_name} has shape {jnp.shape(stepwise_values)}, but {n_steps_text} of one "
            "wheel "
            f"takes one number, or an array of {n_steps} or {n_steps + 1} over its steps: map "
            "over batches of wheels with jax.vmap."
        )
