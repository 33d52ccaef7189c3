"""Unilateral contact: contact laws, impacts, energy, the paper's gait, and a second formulation."""

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import moreau_jean
from scipy.optimize import brentq
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax import lanes
from vrw_jax.hybrid import GuardsAndMargins, integrate_phase
from vrw_jax.models.contact_impacts import ContactLaw, classify_event, resolve_event
from vrw_jax.models.contact_mechanics import (
    WheelMotion,
    compute_foot_heights,
    compute_kinetic_energy,
    compute_leg_directions,
    compute_potential_energy,
)
from vrw_jax.models.contact_record import unpack_section_state
from vrw_jax.models.contact_state import (
    ContactState,
    EnergyLossAccumulators,
    compute_contact_quantities,
    compute_forces,
    evaluate_guards,
    evaluate_vector_field,
    make_contact_mode_dynamics,
    make_guard_layout,
    pack_state,
    unpack_state,
)
from vrw_jax.wheel import ContactMode

START = (0.1, 1.6, -0.1)
TIGHT_OPTIONS = vrw.StepOptions.tight()
TABLE_1 = vrw.WheelParams()
STEP_SCENES = {  # friction, damping, dtheta at the start: what happens in the first step
    "lands sliding": (0.7, 200.0, 1.6),
    "slips, sticks, slips again": (2.0, 200.0, 1.6),
    "sticks": (0.35, 300.0, 1.6),
    "reverses": (0.5, 100.0, 2.2),
    "flies": (0.5, 100.0, 1.2),
    "drags the rear foot": (math.inf, 100.0, 1.6),
    "the paper's gait": (math.inf, 200.0, 1.6),
}


def compute_step(friction, damping=200.0, x=START, options=TIGHT_OPTIONS):
    """Return one full step; infinite friction follows the paper's rule."""
    params = vrw.WheelParams(damping=damping)
    model = vrw.UnilateralWheel(friction=friction, infinite_friction_rule="paper")
    return vrw.step(params, x, model=model, options=options)


@pytest.fixture(scope="module")
def scene_traces():
    """Return the motion of each scene by phase, with its energy losses."""
    result_by_name = {}
    for name, (friction, damping, dtheta) in STEP_SCENES.items():
        wheel, params = vrw.UnilateralWheel(friction=friction), vrw.WheelParams(damping=damping)
        x = wheel.complete_section_state(params, jnp.asarray([START[0], dtheta, START[2]]))
        result_by_name[name] = (params, friction, wheel.sample_step(params, x, TIGHT_OPTIONS, 12))
    return result_by_name


def iterate_phases(params, trace):
    """Yield motions and accumulators, samples first, of the phases that occur."""
    for k in np.flatnonzero(np.asarray(trace.duration) > 0.0):
        motion, tally = jax.vmap(unpack_state)(trace.state[k])
        yield k, motion, tally


def compute_total_energy(s, motion):
    return np.asarray(
        jax.vmap(lambda m: compute_kinetic_energy(s, m) + sum(compute_potential_energy(s, m)))(
            motion
        )
    )


def test_without_slip_the_gait_equals_that_of_the_paper():
    paper = vrw.walk(TABLE_1, START, 40, options=TIGHT_OPTIONS).steps
    model_without_slip = vrw.UnilateralWheel(math.inf, infinite_friction_rule="paper")
    ground = vrw.walk(TABLE_1, START, 40, model=model_without_slip, options=TIGHT_OPTIONS).steps
    assert float(jnp.max(jnp.abs(paper.section_state[-1] - paper.section_state[-2]))) < 1e-12
    theta_rates = ground.section_state[-1][jnp.asarray([0, 1, 12])]
    np.testing.assert_allclose(theta_rates, paper.section_state[-1], atol=1e-11)
    np.testing.assert_allclose(ground.durations[-1, 0], paper.durations[-1, 0], atol=1e-11)
    assert abs(float(jnp.sum(ground.durations[-1] - paper.durations[-1]))) < 1e-11


def test_without_slip_a_step_equals_that_of_the_paper_to_round_off():
    paper = vrw.step(TABLE_1, START, options=TIGHT_OPTIONS)
    step = compute_step(math.inf)
    np.testing.assert_allclose(step.section_state[:2], paper.section_state[:2], atol=1e-12)
    np.testing.assert_allclose(step.section_state[12], paper.section_state[2], atol=1e-12)
    np.testing.assert_allclose(step.landing_normal[1], paper.indicators.lambda_I4, atol=1e-11)


def test_feet_stay_above_the_slope_and_contacts_only_push(scene_traces):
    for params, _, trace in scene_traces.values():
        s = params.symbols()
        for k, motion, _ in iterate_phases(params, trace):
            legs = jax.vmap(compute_leg_directions, (None, 0))(s, motion.theta)
            heights = jax.vmap(compute_foot_heights)(motion, legs)
            assert float(jnp.min(heights)) >= -1e-9
            assert float(jnp.min(trace.normal[k])) >= -1e-9


def test_friction_lies_in_coulombs_cone_and_opposes_slip(scene_traces):
    for params, friction, trace in scene_traces.values():
        for k, motion, _ in iterate_phases(params, trace):
            legs = jax.vmap(compute_leg_directions, (None, 0))(params.symbols(), motion.theta)
            speed = motion.vx[:, None] - motion.dL * legs.sin
            speed = speed - motion.L * motion.dtheta[:, None] * legs.cos
            tangential, normal = trace.tangential[k], trace.normal[k]
            if math.isfinite(friction):
                assert float(jnp.max(jnp.abs(tangential) - friction * normal)) <= 1e-9
            for mode, sign in ((ContactMode.SLIP_DOWN, 1.0), (ContactMode.SLIP_UP, -1.0)):
                sliding = np.asarray(trace.contact[k] == mode)
                assert np.all(np.asarray(sign * speed)[:, sliding] >= -1e-9)
                assert np.all(np.asarray(sign * tangential)[:, sliding] <= 1e-9)
            resting = np.asarray(trace.contact[k] == ContactMode.STICK)
            assert np.all(np.abs(np.asarray(speed)[:, resting]) <= 1e-9)


def test_energy_balances_between_impacts_and_never_grows_at_an_impact(scene_traces):
    for params, _, trace in scene_traces.values():
        s, last = params.symbols(), None
        for _, motion, tally in iterate_phases(params, trace):
            balance = compute_total_energy(s, motion) + np.asarray(
                tally.damping_loss + tally.friction_loss
            )
            np.testing.assert_allclose(balance, balance[0], atol=1e-9)
            if last is not None:
                assert balance[0] <= last + 1e-9
            last = balance[-1]


def test_energy_lost_in_a_step_is_reported_by_cause(scene_traces):
    params, friction, trace = scene_traces["lands sliding"]
    s = params.symbols()
    wheel = vrw.UnilateralWheel(friction=friction)
    before, _ = unpack_section_state(s, wheel.complete_section_state(params, jnp.asarray(START)))
    begin = float(compute_kinetic_energy(s, before) + sum(compute_potential_energy(s, before)))
    *_, (_, motion, _) = iterate_phases(params, trace)
    step = compute_step(friction)
    energy_loss = step.energy_impacts + step.energy_damping + step.energy_friction
    assert abs(float(energy_loss) - (begin - compute_total_energy(s, motion)[-1])) < 1e-9
    assert float(step.energy_friction) > 0.0


@pytest.mark.parametrize("friction", mark_slow(0.7, 1.3))
def test_time_stepping_converges_to_the_same_step_in_first_order(friction):
    reference = compute_step(friction)
    sizes = (16e-4, 8e-4, 4e-4, 2e-4)
    wheel = moreau_jean.TimeSteppingWheel(friction)
    walks = [
        moreau_jean.compute_step(wheel, moreau_jean.paper_start(wheel, *START), h) for h in sizes
    ]
    errors = np.array([w.time - float(reference.period) for w in walks])
    np.testing.assert_allclose(errors[:-1] / errors[1:], 2.0, atol=0.15)
    once = 2.0 * errors[1:] - errors[:-1]  # extrapolated, s
    assert abs(once[-1]) < 1e-5
    assert abs(4.0 * once[-1] - once[-2]) / 3.0 < 1e-6  # and once more
    theta = 2.0 * walks[3].theta - walks[2].theta
    assert abs(theta - float(reference.section_state[0])) < 1e-5
    assert abs(walks[3].loaded_twice - float(reference.durations[0])) < 2e-3


def make_reference_start(x):
    """Return a full section state in the form of the time-stepping reference."""
    theta = float(x[0]) - moreau_jean.ALPHA
    L, dL, code = (np.roll(x[4 + 8 * i : 12 + 8 * i], 1) for i in range(3))
    hub = [L[0] * np.sin(theta), L[0] * np.cos(theta), theta]
    rates = [x[2], x[3], x[1]]
    code = np.round(code).astype(int)
    return moreau_jean.StepStart(
        np.r_[hub, L], np.r_[rates, dL], code >= 4, code % 4 != ContactMode.OFF
    )


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "damping"), [(0.7, 300.0), (1.3, 200.0)])
def test_the_period_of_a_gait_agrees_with_time_stepping(friction, damping):
    model, params = vrw.UnilateralWheel(friction=friction), vrw.WheelParams(damping=damping)
    walk = vrw.walk(params, START, 120, model=model, options=TIGHT_OPTIONS)
    x = np.asarray(walk.steps.section_state[-1])
    np.testing.assert_allclose(x, walk.steps.section_state[-2], atol=1e-9)  # a gait: it repeats
    wheel = moreau_jean.TimeSteppingWheel(friction, c=damping)
    steps = [
        moreau_jean.compute_step(wheel, make_reference_start(x), h)
        for h in (16e-4, 8e-4, 4e-4, 2e-4)
    ]
    once = lambda values: 2.0 * values[1:] - values[:-1]  # extrapolated; below once more
    twice = lambda values: (4.0 * once(values)[1:] - once(values)[:-1]) / 3.0
    periods = twice(np.array([step.time for step in steps]))
    # Time stepping's own error: its last extrapolation moved by up to 4e-6 s.
    assert abs(periods[1] - float(jnp.sum(walk.steps.durations[-1]))) < 2e-6
    thetas = twice(np.array([step.theta for step in steps]))
    assert abs(thetas[1] - float(x[0])) < 2e-6  # and the step ends where it began


@pytest.mark.parametrize("name", STEP_SCENES)
def test_landings_agree_between_tolerances(name):
    friction, damping, dtheta = STEP_SCENES[name]
    x = (START[0], dtheta, START[2])
    loose, tight = (
        compute_step(friction, damping, x, options=o) for o in (vrw.StepOptions(), TIGHT_OPTIONS)
    )
    assert int(tight.outcome) == vrw.Outcome.STEPPED
    assert int(loose.events) == int(tight.events)
    np.testing.assert_allclose(loose.section_state, tight.section_state, atol=1e-8)
    assert abs(float(loose.period - tight.period)) < 1e-8


@pytest.mark.slow
def test_a_foot_that_leaves_the_ground_is_not_taken_for_one_that_lands_again():
    # Its height grows as the cube of the time. Inner stages of Tsit5 have errors as large, so that
    # a search for dips repeats each first solver step hundreds of times, and changes nothing.
    options = vrw.StepOptions(solver="Tsit5", rtol=1e-7, atol=1e-7)
    slopes = vrw.WheelParams(slope=np.linspace(0.26, 0.34, 8))
    starts = np.tile(START, (8, 1))
    steps = vrw.step_batch(slopes, starts, model=vrw.UnilateralWheel(), options=options)
    # Tsit5 has half the order of the default method, which needs 40 solver steps.
    assert np.all(steps.solver_steps < 2 * 40)


def test_feet_with_vanishing_alternating_impacts_come_to_rest():
    """Past c = 311 each foot's landing lifts the other, after 3e-5 s, 2e-5 s, 5e-8 s and so on."""
    params = vrw.WheelParams(damping=312.0, slope=0.294)
    wheel = vrw.UnilateralWheel(friction=0.7)
    walk = vrw.walk(params, START, 12, model=wheel)
    assert int(walk.outcome) == vrw.Outcome.STEPPED
    assert int(vrw.step(params, walk.steps.section_state[-1], model=wheel).events) < 12
    assert abs(float(jnp.sum(walk.steps.durations[-1] - walk.steps.durations[-2]))) < 1e-6


@pytest.mark.parametrize("friction", [0.5, 0.7, 1.0])
def test_at_friction_below_one_every_event_has_exactly_one_solution(friction):
    step = compute_step(friction)
    assert int(step.fewest_solutions) == 1
    assert int(step.most_solutions) == 1


def make_contact_law(s, friction):
    return ContactLaw(
        s,
        jnp.asarray(friction),
        has_one_sided_stoppers=False,
        counts_all_solutions=True,
        rest_speed=1e-6,
    )


def make_resting_motion(theta, **changes):
    """Return a wheel at rest on legs of length L0, with the lower foot on the slope."""
    zero = jnp.zeros(())
    height = jnp.maximum(jnp.cos(theta), jnp.cos(theta + math.pi / 4))
    motion = WheelMotion(
        zero, height, jnp.asarray(theta), zero, zero, zero, jnp.ones(8), jnp.zeros(8)
    )
    return motion._replace(**changes)


def make_contact_state(contact, locked):
    none = jnp.zeros(8, bool)
    codes = jnp.asarray(list(contact) + [ContactMode.OFF] * 6, jnp.int32)
    return ContactState(codes, jnp.asarray(locked), none, none, none)


def test_a_wheel_on_two_stiff_legs_slides_like_a_block():
    s, friction = TABLE_1.symbols(), 0.2
    flow = make_contact_mode_dynamics(
        s,
        jnp.asarray(friction),
        False,
        make_contact_state((ContactMode.SLIP_DOWN, ContactMode.SLIP_DOWN), [True] * 8),
    )
    motion = make_resting_motion(-math.pi / 8, vx=jnp.asarray(0.1))
    solution = jax.jit(partial(compute_forces, flow))(motion).force_solution
    g, slope = 9.81, 0.30
    downhill_acceleration = g * (math.sin(slope) - friction * math.cos(slope))
    np.testing.assert_allclose(
        jnp.stack(solution.hub_motion), [downhill_acceleration, 0.0, 0.0], atol=1e-12
    )
    assert abs(float(sum(solution.normal_forces)) - 18.0 * g * math.cos(slope)) < 1e-10


def test_a_wheel_in_the_air_falls_freely():
    s = TABLE_1.symbols()
    flow = make_contact_mode_dynamics(
        s,
        jnp.asarray(0.7),
        False,
        make_contact_state((ContactMode.OFF, ContactMode.OFF), [True] * 8),
    )
    motion = make_resting_motion(-0.3, z=jnp.asarray(2.0), dtheta=jnp.asarray(3.0))
    contact_forces = jax.jit(partial(compute_forces, flow))(motion)
    expected = [9.81 * math.sin(0.3), -9.81 * math.cos(0.3), 0.0]
    np.testing.assert_allclose(
        jnp.stack(contact_forces.force_solution.hub_motion), expected, atol=1e-12
    )
    # Preload and spin press each leg on its stopper: 500 * 0.02 + 0.7 * 3^2 N.
    np.testing.assert_allclose(contact_forces.airborne_stopper_forces, 10.0 + 6.3, atol=1e-12)


def test_a_vertical_leg_lands_with_its_own_mass_alone():
    s, speed = TABLE_1.symbols(), 2.0
    motion = make_resting_motion(0.0, vz=jnp.asarray(-speed))
    in_the_air = make_contact_state((ContactMode.OFF, ContactMode.OFF), [True] * 8)
    event = classify_event(make_guard_layout(8, False), jnp.int32(0))
    law = make_contact_law(s, 0.7)
    change = lanes.jit(lambda motion: resolve_event(law, motion, in_the_air, event))(motion)
    # The leg's 1 kg stops, the other 17 kg go on; the spring then begins to work.
    assert abs(float(change.normal_impulse[0]) - 1.0 * speed) < 1e-12
    assert abs(float(change.impact_energy_loss) - 0.5 * speed**2) < 1e-12
    assert abs(float(change.motion.vz) + speed) < 1e-12
    assert abs(float(change.motion.dL[0]) + speed) < 1e-12
    assert not bool(change.contact_state.is_leg_locked[0])


def test_a_single_leg_bounces_as_a_damped_oscillator():
    """Upright on flat ground: 17 kg on one spring and damper, until the foot no longer pushes."""
    make_symbols = lambda: vrw.WheelParams(
        slope=0.0, stiffness=2000.0, damping=60.0, natural_length=1.005
    ).symbols()
    s, speed = make_symbols(), 3.0
    mass, omega = s.Mt - s.m, jnp.sqrt(s.k / (s.Mt - s.m) - (0.5 * s.c / (s.Mt - s.m)) ** 2)
    decay, rest = 0.5 * s.c / mass, s.Ls - mass * s.g / s.k
    a, b = s.L0 - rest, (-speed + decay * (s.L0 - rest)) / omega

    def length(t):
        return rest + np.exp(-decay * t) * (a * np.cos(omega * t) + b * np.sin(omega * t))

    def push(t, h=1e-5):  # of the ground: the leg's own weight, and what spring and damper give
        rate = (length(t + h) - length(t - h)) / (2.0 * h)
        return float(s.m * s.g + s.k * (s.Ls - length(t)) - s.c * rate)

    first = next(t for t in np.linspace(0.01, 1.0, 100) if push(t) < 0.0)
    time = brentq(push, first - 0.01, first, xtol=1e-12)
    zero = jnp.zeros(())
    motion = make_resting_motion(0.0, vz=jnp.asarray(-speed))._replace(
        dL=jnp.zeros(8).at[0].set(-speed)
    )
    lift = make_guard_layout(8, False).liftoff.start

    @lanes.jit
    def integrate_until_lift(start):
        contact_state = make_contact_state(
            (ContactMode.STICK, ContactMode.OFF), [False] + [True] * 7
        )
        flow = make_contact_mode_dynamics(make_symbols(), jnp.asarray(0.7), False, contact_state)

        def evaluate_lift(y):
            motion, _ = unpack_state(y)
            contact_quantities = compute_contact_quantities(flow, motion)
            return evaluate_guards(flow, motion, contact_quantities)[lift : lift + 1]

        field, watched = partial(evaluate_vector_field, flow), GuardsAndMargins(evaluate_lift, 1)
        options = vrw.StepOptions(solver="Tsit5", rtol=1e-12, atol=1e-12)
        return integrate_phase(field, watched, start, jnp.asarray(True), options)

    end = integrate_until_lift(pack_state(motion, EnergyLossAccumulators(zero, zero, zero, zero)))
    landed, tally = unpack_state(end.state)
    assert abs(float(end.duration) - time) < 1e-8
    assert abs(float(landed.L[0]) - length(time)) < 1e-9
    assert abs(float(landed.theta)) < 1e-12
    energy_loss = 0.5 * mass * speed**2 - 0.5 * mass * float(landed.vz) ** 2
    energy_loss += 0.5 * float(s.k) * float((s.Ls - s.L0) ** 2 - (s.Ls - landed.L[0]) ** 2)
    energy_loss += float(mass * s.g * (s.L0 - landed.L[0]))
    assert abs(float(tally.damping_loss) - energy_loss) < 1e-9


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.5])
def test_a_foot_that_lands_sliding_takes_coulombs_impulse(friction):
    s = TABLE_1.symbols()
    motion = make_resting_motion(0.0, vz=jnp.asarray(-1.0), vx=jnp.asarray(5.0))
    in_the_air = make_contact_state((ContactMode.OFF, ContactMode.OFF), [True] * 8)
    event = classify_event(make_guard_layout(8, False), jnp.int32(0))
    resolve = lambda f: resolve_event(make_contact_law(s, f), motion, in_the_air, event)
    change = lanes.jit(resolve)(friction)
    normal, tangential = float(change.normal_impulse[0]), float(change.tangential_impulse[0])
    assert int(change.contact_state.contact_modes[0]) == ContactMode.SLIP_DOWN
    assert abs(tangential + friction * normal) < 1e-12


def test_bad_input_is_an_outcome_and_never_nan():
    # Friction is refused in a sentence as a plain number, and is a code where no one saw it.
    model = vrw.UnilateralWheel(infinite_friction_rule="paper")
    for friction, x in ((0.7, (math.nan, 1.0, 0.0)), (-1.0, START), (math.nan, START)):
        unseen = eqx.tree_at(lambda model: model.friction, model, jnp.asarray(friction))
        step = vrw.step(TABLE_1, x, model=unseen, options=TIGHT_OPTIONS)
        assert int(step.outcome) == vrw.Outcome.BAD_INPUT
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(step))
        assert not np.any(np.asarray(step.section_state))


@pytest.mark.parametrize(
    ("friction", "damping", "x", "outcome"),
    [
        (1.5, 16.39, (0.001, 0.6, -0.4), vrw.Outcome.THREE_FEET_LOADED),  # Leg 3's foot is 1 mm up
        (8.0, 183.0, (0.037, 2.31, -0.065), vrw.Outcome.PAINLEVE_PARADOX),  # Painlevé's singularity
    ],
)
@pytest.mark.parametrize("engines", [("lanes",), *mark_slow((("lanes", "diffrax"),))], ids="-".join)
def test_situations_outside_the_model_end_a_step_with_an_outcome(
    friction, damping, x, outcome, engines
):
    """By both engines alike, in time too: to what is left of the singularity where lanes see it."""
    times = []
    for engine in engines:
        model = vrw.UnilateralWheel(friction=friction)
        params = vrw.WheelParams(damping=damping)
        step = vrw.step(params, x, model=model, options=TIGHT_OPTIONS, engine=engine)
        assert int(step.outcome) == outcome
        assert not np.any(np.asarray(step.section_state))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(step))
        times.append(float(step.durations.sum()))
    assert times[0] == pytest.approx(times[-1], abs=1e-7)


def test_infinite_event_sequences_end_with_an_outcome():
    enough = int(compute_step(0.7).events)
    wheel = vrw.UnilateralWheel(friction=0.7, max_events=enough - 1)
    x = wheel.complete_section_state(TABLE_1, jnp.asarray(START))
    cut_short = wheel.advance(TABLE_1, x, TIGHT_OPTIONS)
    assert int(cut_short.outcome) == vrw.Outcome.TOO_MANY_EVENTS
    assert not np.any(np.asarray(cut_short.section_state))


def test_too_flat_a_slope_ends_the_walk_with_an_outcome():
    params, model = vrw.WheelParams(slope=0.0), vrw.UnilateralWheel(infinite_friction_rule="paper")
    walk = vrw.walk(params, (0.1, 1.0, -0.1), 40, model=model, options=TIGHT_OPTIONS)
    assert int(walk.outcome) in (vrw.Outcome.FELL_BACK, vrw.Outcome.NO_TOUCHDOWN_IN_TIME)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(walk.steps))


def test_sliding_uphill_is_a_separate_contact_mode(scene_traces):
    modes = np.concatenate([np.unique(trace.contact) for _, _, trace in scene_traces.values()])
    assert {ContactMode.OFF, ContactMode.STICK, ContactMode.SLIP_DOWN, ContactMode.SLIP_UP} <= set(
        modes.tolist()
    )
