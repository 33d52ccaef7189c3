"""What the page computes: the library's own step by lanes, as functions of plain arrays.

A wheel is a column of nine parameters in the order of `WheelParams`, a start one of three numbers.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax import lanes
from vrw_jax.base import StepOptions, compute_sine_cosine
from vrw_jax.flow import divide_equally, load_explicit_tableau, sample_batch_phase
from vrw_jax.models import (
    MARGIN_MEASURES,
    N_STEP_INPUTS,
    STOPPER_MARGIN_MEASURES,
    RequiredFriction,
    RigidWheel,
    StepResult,
    UnilateralWheel,
    advance_gait_step,
    compute_jacobian_columns,
)
from vrw_jax.models.contact_kernel import BatchWalkSettings, advance_to_events, init_lane_states
from vrw_jax.models.contact_mechanics import (
    compute_kinetic_energy,
    compute_potential_energy,
    unpack_motion,
)
from vrw_jax.models.contact_record import compute_full_section_size, embed_section_state
from vrw_jax.models.contact_state import N_LOSSES, ContactState
from vrw_jax.models.phase_sequence import evaluate_phase_states, make_step_result
from vrw_jax.models.rigid import RollingMotion
from vrw_jax.models.unilateral_wheel import sample_contact_interval
from vrw_jax.models.viscoelastic import make_batch_phase, run_batch_phases
from vrw_jax.wheel import PARAMETER_NAMES, Symbols, WheelParams, make_wheel_from_parameters

LEGS = (6, 8, 10)
"""Numbers of legs that the page offers: each is code of its own."""
SAMPLES = 24
"""Times of each phase that the animation knows, ends included."""

MAX_ENTRIES_IN_WALKS = 64
"""Largest unrolled array, with which small arrays stay whole in a walk with unilateral contact: for
ten legs the code is five times as long otherwise."""

SOLVER = StepOptions.__dataclass_fields__["solver"].default


class Program(NamedTuple):
    """A function of `numbers` numbers and of a wheel and a start."""

    function: Callable[..., tuple]
    numbers: int
    max_unrolled_entries: int = lanes.MAX_UNROLLED_ENTRIES
    section: int = 3

    def object(self, name: str) -> bytes:
        """Return the program as object code for WebAssembly."""
        rows = len(PARAMETER_NAMES), self.section
        return lanes.compile_wasm_object(
            self.function, self.numbers, rows, name, self.max_unrolled_entries
        )


PAGE_MARGINS = {name: m for name, m in MARGIN_MEASURES.items() if name != "takeoff_acceleration"}
"""Margins on the page: of scuffing the clearances tell there."""

PAGE_FRICTION = tuple(name for name in RequiredFriction.measure_name_by_field if name != "stopper")
"""Required friction coefficients on the page: that of collision II may be infinite."""


class _OfAnyLegs(WheelParams):
    """A wheel whose number of legs only the program's run knows."""

    legs: Array | float = 8.0

    @property
    def leg_angle(self) -> Any:
        return 2.0 * math.pi / self.legs

    def symbols(self) -> Symbols:
        """Those of a step's motion, in which legs in the air are not told one by one."""
        alpha = self.leg_angle
        sin, cos = compute_sine_cosine(alpha)
        return (
            super()
            .symbols()
            ._replace(
                Mh=self.hub_mass + (self.legs - 1.0) * self.leg_mass,
                Mt=self.hub_mass + self.legs * self.leg_mass,
                n=self.legs,
                sin_alpha=sin,
                cos_alpha=cos,
                alpha=alpha,
            )
        )


def make_shared_programs() -> dict[str, Program]:
    """Return by name the programs that do not depend on the number of legs."""

    def linearised(tolerance: Array, legs: Array, parameters: Array, x: Array) -> tuple:
        """Section state and durations; outcome and solver's steps; how the first two move with each
        of the start's numbers."""
        given = dict(zip(PARAMETER_NAMES, tuple(parameters), strict=True))
        params, options = _OfAnyLegs(**given, legs=legs), _options(tolerance)
        shift = lambda *start: _advance(params, start, options)
        columns, numbers, codes = compute_jacobian_columns(shift, tuple(x), range(3))
        return jnp.stack(numbers), jnp.stack(codes), jnp.stack(columns, 1)

    return {"linearised": Program(linearised, 2, N_STEP_INPUTS)}


def programs(n_legs: int) -> dict[str, Program]:
    """Return by name the programs of a step for a number of legs."""

    def wheel(parameters: Array) -> WheelParams:
        return make_wheel_from_parameters(tuple(parameters), n_legs)

    def told(tolerance: Array, friction: Array, parameters: Array, x: Array) -> tuple:
        """Return all outputs of the step in the order of `result_of`, and its motion by phase."""
        params, options = wheel(parameters), _options(tolerance)
        walk_result = run_batch_phases(
            params, x, options, stop_at_lift_off=True, records_margins=True
        )
        step = make_step_result(walk_result, friction, "lanes")
        motion = []
        for phase, start, end in zip(
            walk_result.phases,
            walk_result.phase_start_states,
            walk_result.phase_end_results,
            strict=True,
        ):
            flow = make_batch_phase(phase, records_margins=False)
            lengths = divide_equally(end.duration, SAMPLES)
            sampled_states = sample_batch_phase(
                flow, load_explicit_tableau(SOLVER), *start, lengths, options
            )
            motion.append(
                jnp.concatenate(evaluate_phase_states(phase, jnp.moveaxis(sampled_states, 1, 0)))
            )
        codes = jnp.stack([step.outcome, step.solver_steps]).astype(jnp.int32)
        return _numbers_of(step), codes, *motion

    return {"told": Program(told, 2), **_of_rigid_legs(wheel), **_on_ground(wheel, n_legs)}


GROUND_TOLD = (
    "duration_dls", "duration_single", "duration_flight", "step_length",
    "theta_post_impact", "dtheta_post_impact", "slip",
    "energy_lost_impacts", "energy_lost_damping", "energy_lost_friction", *STOPPER_MARGIN_MEASURES,
)  # fmt: skip
"""Measures of a step with unilateral contact that follow its section state, by name."""


def _on_ground(wheel: Callable[[Array], WheelParams], n_legs: int) -> dict[str, Program]:
    """Return the programs of a walk with unilateral contact from event to event.

    The state of the walk is a column of numbers, which include flags and codes.
    """
    model, tableau = UnilateralWheel(), load_explicit_tableau(SOLVER)
    size, n = compute_full_section_size(n_legs), 3 + n_legs

    def on(tolerance: Array) -> BatchWalkSettings:
        rules = (
            jnp.int32(1),
            model.max_events,
            model.has_one_sided_stoppers,
            model.uses_paper_rule,
            True,
        )
        return BatchWalkSettings(n_legs, *rules, _options(tolerance), tableau)

    def columns(parameters: Array, friction: Array) -> Array:
        return jnp.concatenate([parameters, (friction + 0.0 * parameters[0])[None]])

    def begun(parameters: Array, x: Array) -> tuple:
        """Return the section state with unilateral contact for a section state of the paper's
        model.
        """
        return (embed_section_state(wheel(parameters).symbols(), x),)

    def opened(tolerance: Array, friction: Array, parameters: Array, x: Array) -> tuple:
        """Return the state of a step before its first event."""
        return (_flat(init_lane_states(on(tolerance), columns(parameters, friction), x)[1]),)

    lane = jax.ShapeDtypeStruct((size, 1), float)
    number, given = jax.ShapeDtypeStruct((), float), jax.ShapeDtypeStruct((9, 1), float)
    form = jax.eval_shape(
        lambda t, mu, p, x: init_lane_states(on(t), columns(p, mu), x)[1],
        number,
        number,
        given,
        lane,
    )

    def onward(tolerance: Array, friction: Array, parameters: Array, lane: Array) -> tuple:
        """Through an event and on to the next: where it stands then; the stretch between, from its
        coordinates, rates, contacts and stoppers, and how long it lasted; what the step tells so
        far; and its outcome, -1 while it goes on."""
        walk = on(tolerance)
        past, after = advance_to_events(
            walk, columns(parameters, friction), _rebuild_tree(lane, form)
        )
        q, v, stance = past.q, past.v[:n], past.contact_state
        codes = [stance.contact_modes.astype(float), stance.is_leg_locked.astype(float)]
        step = walk.compute_step_result(after, columns(parameters, friction))
        result = (
            step.durations, step.step_length, step.post_impact, step.slip, step.energy_impacts,
            step.energy_damping, step.energy_friction,
            *(getattr(step.margins, name) for name in STOPPER_MARGIN_MEASURES),
        )  # fmt: skip
        stretch = jnp.concatenate([q, v, *codes, after.interval_duration[None]])
        return _flat(after), stretch, _flat((step.section_state, *result)), after.walk_outcome

    def between(tolerance: Array, friction: Array, parameters: Array, stretch: Array) -> tuple:
        """Return samples of the motion between two events.

        A sample has coordinates, the normal and tangential forces of the first two loaded feet,
        and the energies (kinetic, of gravity, of springs)."""
        q, v = stretch[:n], stretch[n : 2 * n]
        contact = stretch[2 * n : 2 * n + n_legs].astype(jnp.int32)
        locked = stretch[2 * n + n_legs : -1] > 0.5
        walk, none = on(tolerance), locked & False
        stance = ContactState(contact, locked, none, none, none)
        flow = walk.make_lane_contact_dynamics(columns(parameters, friction), stance)
        v = jnp.concatenate([v, jnp.zeros_like(q[:N_LOSSES])])
        rows = sample_contact_interval(flow, q, v, stretch[-1], SAMPLES, walk.step_options, tableau)

        def row(row_values: Array) -> Array:
            motion = unpack_motion(row_values[:n], row_values[n : 2 * n])
            energies = (
                compute_kinetic_energy(flow.s, motion),
                *compute_potential_energy(flow.s, motion),
            )
            return jnp.concatenate(
                [
                    row_values[:n],
                    row_values[2 * n + N_LOSSES :],
                    jnp.stack(energies),
                ]
            )

        return (jnp.moveaxis(jax.vmap(row)(rows), 1, 0),)

    return {
        "ground_begun": Program(begun, 0),
        "ground_opened": Program(opened, 2, section=size),
        "ground_onward": Program(onward, 2, MAX_ENTRIES_IN_WALKS, _size(form)),
        "ground_between": Program(between, 2, section=2 * n + 2 * n_legs + 1),
    }


def ground_rows(n_legs: int) -> dict[str, int]:
    """Return the numbers of rows of a section state and of the state of a walk."""
    onward = _on_ground(lambda p: make_wheel_from_parameters(tuple(p), n_legs), n_legs)[
        "ground_onward"
    ]
    return {"section": compute_full_section_size(n_legs), "lane": onward.section}


def _size(form: Any) -> int:
    return sum(math.prod(leaf.shape[:-1]) for leaf in jax.tree.leaves(form))


def _flat(tree: Any) -> Array:
    """Return all arrays of a tree as rows of floats."""
    rows = [x.astype(float).reshape(-1, x.shape[-1]) for x in jax.tree.leaves(tree)]
    return jnp.concatenate(rows)


def _rebuild_tree(rows: Array, form: Any) -> Any:
    """Return the tree of the given form from the rows of `_flat`."""
    leaves, structure = jax.tree.flatten(form)
    solution, begin = [], 0
    for leaf in leaves:
        end = begin + math.prod(leaf.shape[:-1])
        leaf_values = rows[begin:end].reshape(*leaf.shape[:-1], rows.shape[-1])
        solution.append(leaf_values > 0.5 if leaf.dtype == bool else leaf_values.astype(leaf.dtype))
        begin = end
    return jax.tree.unflatten(structure, solution)


def _of_rigid_legs(wheel: Callable[[Array], WheelParams]) -> dict[str, Program]:
    """Return the programs of the rigid model, whose formulas have no tolerance."""

    def rolled(parameters: Array, x: tuple) -> tuple[tuple, tuple]:
        step = RigidWheel().compute_step_elementwise(wheel(parameters), x, jnp.ones_like(x[0]))
        return (*step.section_state, *step.durations), (step.outcome, step.solver_steps)

    def linearised(tolerance: Array, parameters: Array, x: Array) -> tuple:
        shift = lambda *start: rolled(parameters, start)
        columns, numbers, codes = compute_jacobian_columns(shift, tuple(x), range(3))
        return jnp.stack(numbers), jnp.stack(codes), jnp.stack(columns, 1)

    def told(tolerance: Array, friction: Array, parameters: Array, x: Array) -> tuple:
        params = wheel(parameters)
        step = RigidWheel().compute_step_elementwise(params, tuple(x), friction + 0.0 * x[0])
        half = 0.5 * params.leg_angle
        share = jnp.arange(SAMPLES)[:, None] * (1.0 / (SAMPLES - 1))
        roll = RollingMotion(params.symbols(), params.slope, step.post_impact[1], -half, half)
        theta = half * (2.0 * share - 1.0) + 0.0 * x[0]
        rows = jnp.concatenate(
            [*roll.evaluate_states_at_angles(theta), roll.compute_time_to_angle(theta)[None]]
        )
        codes = jnp.stack([step.outcome, step.solver_steps])
        return _numbers_of(step), codes, rows

    return {
        "rigid_linearised": Program(linearised, 1, N_STEP_INPUTS),
        "rigid_told": Program(told, 2),
    }


def _numbers_of(step: StepResult) -> Array:
    """Return the outputs of a step as rows."""
    parts = (
        step.section_state, step.post_impact, step.durations, step.step_length,
        *vars(step.indicators).values(), *(getattr(step.margins, name) for name in PAGE_MARGINS),
        *(getattr(step.required_friction, name) for name in PAGE_FRICTION),
        *vars(step.energy).values(),
    )  # fmt: skip
    return jnp.concatenate([jnp.atleast_2d(part) for part in parts])


def _advance(
    params: WheelParams, x: tuple[Array, ...], options: StepOptions
) -> tuple[tuple, tuple]:
    step, _ = advance_gait_step(params, x, options, stop_at_lift_off=True)
    return (*step.section_state, *step.durations), (step.outcome, step.solver_steps)


def _options(tolerance: Array) -> StepOptions:
    """Return the default step options with another tolerance."""
    return eqx.tree_at(lambda o: (o.rtol, o.atol), StepOptions(), (tolerance, tolerance))
