"""Long walks: does the cycle hold, does error grow, where energy goes."""

import json
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from vrw_jax import Outcome
from vrw_jax.hybrid import GuardsAndMargins, PhaseEnd, integrate_phase
from vrw_jax.models.phase_sequence import ElementPhase, make_element_phase
from vrw_jax.wheel import Motion, dynamics, make_paper_phases, transitions

REFERENCE = Path(__file__).parents[2] / "tests" / "reference_code"
BLOCK = 1000
WALKED_STEP_COUNTS = (1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000)
WALKS = {(1e-6, 1e-8, 1e-13): 10_000, (1e-10,): 100_000}
"""Steps by tolerances that walk side by side; 1e-10 is the default, 1e-13 `Options.tight()`."""


def with_damping(
    phase: ElementPhase,
    start: jax.Array,
    params: vrw.WheelParams,
    options: vrw.StepOptions,
) -> tuple[PhaseEnd, jax.Array, Motion]:
    """Integrate a phase; return the energy lost in dampers (J, eq. 29) and the last motion too.

    The energy is a component of the state, so the solver controls its error.
    """
    s = params.symbols()
    power = lambda y: dynamics.compute_damping_power(s, phase.motion_unpacker(y))
    field = lambda y: jnp.append(phase.vector_field(y[:-1]), power(y[:-1]))
    watched = GuardsAndMargins(
        lambda y: phase.guards.evaluate_guards_and_margins(y[:-1]), phase.guards.n_guards
    )
    zero = 0.0 * start[:1]
    end = integrate_phase(
        field, watched, jnp.concatenate([start, zero]), jnp.asarray(True), options
    )
    return end, end.state[-1], phase.motion_unpacker(end.state[:-1])


def accounted_step(params: vrw.WheelParams, x: jax.Array, options: vrw.StepOptions) -> tuple:
    """Next section state; whether it stepped; duration, gravity's work and energy not accounted.

    Energy before the landing + gravity's work from foot to foot - what both impacts and the
    dampers take - energy at the next touchdown.
    """
    s = params.symbols()
    before = transitions.compute_motion_before_landing(s, *x)
    landing = transitions.resolve_landing(s, *x)
    phases = make_paper_phases(s, landing.foot_distance, stop_at_lift_off=True)
    dls, sls1, sls2 = (make_element_phase(phase, records_margins=False) for phase in phases)
    start = jnp.stack([landing.theta_after_landing, landing.motion_after.dtheta])
    first, lost_1, m = with_damping(dls, start, params, options)
    start = jnp.stack([first.state[0], m.L1, m.L2, m.dtheta, m.dL1, m.dL2])
    second, lost_2, m = with_damping(sls1, start, params, options)
    hit = transitions.resolve_stopper_collision(s, m)
    start = jnp.stack(
        [second.state[0], hit.motion_after.L1, hit.motion_after.dtheta, hit.motion_after.dL1]
    )
    third, lost_3, m = with_damping(sls2, start, params, options)
    ends = first, second, third
    outcomes = [
        p.select_guard_outcome(e.end_guard_index, e.is_timed_out)
        for p, e in zip(phases, ends, strict=True)
    ]
    step_result = jnp.all(jnp.stack(outcomes) == Outcome.STEPPED)
    theta, _, dtheta, dL1, _ = third.state
    work = (s.Mt) * s.g * landing.foot_distance * s.sin_phi
    dissipated_energy = landing.energy_loss + hit.energy_loss + lost_1 + lost_2 + lost_3
    change = (
        dynamics.compute_mechanical_energy(s, m).total_energy
        - dynamics.compute_mechanical_energy(s, before).total_energy
    )
    duration = first.duration + second.duration + third.duration
    return (
        jnp.stack([theta, dtheta, dL1]),
        step_result,
        duration,
        work,
        work - dissipated_energy - change,
    )


def long_walk() -> Iterator[dict[str, object]]:
    """Many steps of Table 1's wheel from its limit cycle, at four tolerances."""
    reference = json.loads((REFERENCE / "reference_values.json").read_text())["cases"][0]["cycle"]
    first = np.array([float(value) for value in reference["section_state"]])
    period = float(reference["period"])
    params = vrw.WheelParams()

    def walk(x: jax.Array, tolerance: jax.Array) -> tuple:
        options = vrw.StepOptions(rtol=tolerance, atol=tolerance)

        def one(x: jax.Array, _: None) -> tuple:
            x, *result = accounted_step(params, x, options)
            return x, result

        return jax.lax.scan(one, x, None, length=BLOCK)

    block = jax.jit(jax.vmap(walk))
    for tolerances, length in WALKS.items():
        x = jnp.tile(first, (len(tolerances), 1))
        failed, largest, clock, work, rest = np.zeros((5, len(tolerances)))
        for count in range(BLOCK, length + 1, BLOCK):
            x, (step_result, durations, works, rests) = block(x, jnp.asarray(tolerances))
            failed += np.sum(~np.asarray(step_result), 1)
            distance = np.max(np.abs(np.asarray(x) - first), 1)
            largest, clock = np.maximum(largest, distance), clock + np.sum(durations, 1)
            work, rest = work + np.sum(works, 1), rest + np.sum(rests, 1)
            for i, tolerance in enumerate(tolerances if count in WALKED_STEP_COUNTS else ()):
                yield {
                    "tolerance": f"{tolerance:.0e}",
                    "steps": count,
                    "failed": int(failed[i]),
                    "distance": f"{distance[i]:.2e}",
                    "largest_distance": f"{largest[i]:.2e}",
                    "clock_error_s": f"{abs(clock[i] - count * period):.2e}",
                    "work_of_gravity_J": f"{work[i]:.6e}",
                    "not_accounted_J": f"{rest[i]:+.2e}",
                    "share": f"{abs(rest[i]) / work[i]:.1e}",
                }
