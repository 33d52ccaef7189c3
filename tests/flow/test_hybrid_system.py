"""Walkers and other systems of a user: steps, batches, derivatives and gaits with known answers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import walkers
from support.machine_code import CodeRegistrySpy
from support.walkers import SIMPLEST_WALKER

import vrw_jax as vrw
from vrw_jax.hybrid import Guard, HybridSystem, Mode, Termination

TIGHT = vrw.StepOptions.tight()


def make_ball():
    """A ball on a floor; its section coordinate is its velocity after an impact."""
    fall = lambda y, p: jnp.stack([y[1], -p["gravity"] + 0.0 * y[1]])
    bounce = lambda y, p: jnp.stack([0.0 * y[0], -p["restitution"] * y[1]])
    return HybridSystem(
        modes={"flight": Mode(fall, {"impact": Guard(lambda y, p: y[0], bounce)})},
        section="impact",
        state=("height", "velocity"),
        project=lambda y, p: y[1:],
        embed=lambda x, p: jnp.stack([0.0 * x[0], x[0]]),
    )


BALL, BALL_PARAMS = make_ball(), {"gravity": 9.81, "restitution": 0.8}


def spring_force(x, y, p):
    tension = p["stiffness"] * (1.0 / jnp.sqrt(x * x + y * y) - 1.0)
    return tension * x, tension * y


def single_support(s, p):
    fx, fy = spring_force(s[0], s[1], p)
    return jnp.stack([s[2], s[3], fx, fy - 1.0, 0.0 * fx])


def double_support(s, p):
    (fx, fy), (gx, gy) = spring_force(s[0], s[1], p), spring_force(s[0] - s[4], s[1], p)
    return jnp.stack([s[2], s[3], fx + gx, fy + gy - 1.0, 0.0 * fx])


def spring_energy(s, p):
    """Energy per mass in single support, in units of weight and leg length."""
    stretch = 1.0 - jnp.sqrt(s[0] ** 2 + s[1] ** 2)
    return 0.5 * (s[2] ** 2 + s[3] ** 2) + s[1] + 0.5 * p["stiffness"] * stretch**2


SPRING_BIPED = HybridSystem(
    modes={
        "single": Mode(
            single_support,
            {
                "touchdown": Guard(
                    lambda s, p: s[1] - jnp.sin(p["angle"]),
                    lambda s, p: jnp.stack([*s[:4], s[0] + jnp.cos(p["angle"])]),
                    "double",
                )
            },
        ),
        "double": Mode(
            double_support,
            {
                "lift_off": Guard(
                    lambda s, p: 1.0 - s[0] ** 2 - s[1] ** 2,
                    lambda s, p: jnp.stack([s[0] - s[4], *s[1:4], 0.0 * s[4]]),
                    "single",
                )
            },
        ),
    },
    section="lift_off",
    state=("x", "y", "dx", "dy", "foot_distance"),
    project=lambda s, p: s[:4],
    embed=lambda x, p: jnp.stack([*x, 0.0 * x[0]]),
    invariants=(spring_energy,),
)
SPRING_PARAMS = {"stiffness": 20.0, "angle": np.deg2rad(69.0)}
"""A biped of Geyer, Seyfarth and Blickhan (2006), in units of mass, leg length and weight."""
SPRING_START = np.array([-0.3, 0.95, 0.33, 0.08])


def test_a_bounce_has_the_closed_form_of_its_velocity_and_duration():
    step = BALL.step(BALL_PARAMS, [2.0])
    assert Termination(int(step.termination)) == Termination.SECTION_REACHED
    np.testing.assert_allclose(step.section_state, [1.6], rtol=1e-14)
    np.testing.assert_allclose(step.duration, 4.0 / 9.81, rtol=1e-14)
    np.testing.assert_allclose(step.mode_durations, [4.0 / 9.81], rtol=1e-14)
    assert step.events[:2].tolist() == [0, -1]


@pytest.mark.parametrize("differentiate", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_a_bounce_are_those_of_the_closed_form(differentiate):
    duration = lambda gravity: BALL.step(BALL_PARAMS | {"gravity": gravity}, [2.0]).duration
    np.testing.assert_allclose(differentiate(duration)(9.81), -4.0 / 9.81**2, rtol=1e-13)
    np.testing.assert_allclose(
        differentiate(differentiate(duration))(9.81), 8.0 / 9.81**3, rtol=1e-13
    )


def test_the_end_of_a_phase_moves_with_the_guard_by_minus_one():
    """u' = 1 is reset to 0 at u = p. At time 2, u is 2 - 2 p for p slightly below 1."""
    clock = HybridSystem(
        modes={
            "run": Mode(
                lambda y, p: jnp.ones_like(y),
                {
                    "reset": Guard(lambda y, p: p - y[0], lambda y, p: y.at[0].set(0.0)),
                    "end": Guard(lambda y, p: 1.7 - y[1]),
                },
            )
        },
        section="end",
        state=("u", "time"),
    )
    u = lambda p: clock.step(p, [0.0, 0.0]).section_state[0]
    np.testing.assert_allclose(u(1.0), 0.7, rtol=1e-13)
    assert float(jax.grad(u)(1.0)) == float(jax.jacfwd(u)(1.0)) == -1.0


def test_up_and_down_crossings_of_one_quantity_are_two_guards():
    """A rotation crosses zero every half turn, downward at pi/2 and upward at 3 pi/2."""
    turn = lambda y, p: jnp.stack([y[1], -y[0]])
    rotation = HybridSystem(
        modes={
            "above": Mode(turn, {"down": Guard(lambda y, p: y[0], target_mode="below")}),
            "below": Mode(turn, {"up": Guard(lambda y, p: -y[0], target_mode="above")}),
        },
        section="up",
        state=("x", "y"),
    )
    solution = rotation.simulate((), [1.0, 0.0], events=5, options=TIGHT)
    np.testing.assert_allclose(solution.times, np.pi * (0.5 + np.arange(5)), rtol=1e-12)
    assert solution.modes.tolist() == [0, 1, 0, 1, 0]


def test_a_grazing_impact_oscillator_has_its_known_amplitude():
    """x'' + 0.1 x' + x = A cos(w t) touches a stop at 1 if A^2 = (1 - w^2)^2 + 0.01 w^2."""
    frequency = 0.8
    grazing = np.hypot(1.0 - frequency**2, 0.1 * frequency)

    def vibrate(y, p):
        return jnp.stack(
            [y[1], p * jnp.cos(frequency * y[2]) - 0.1 * y[1] - y[0], 1.0 + 0.0 * y[0]]
        )

    oscillator = HybridSystem(
        modes={
            "free": Mode(
                vibrate,
                {
                    "impact": Guard(lambda y, p: 1.0 - y[0], lambda y, p: y.at[1].multiply(-0.8)),
                    "period": Guard(
                        lambda y, p: 2.0 * np.pi / frequency - y[2], lambda y, p: y.at[2].set(0.0)
                    ),
                },
            )
        },
        section="period",
        state=("x", "dx", "time"),
        project=lambda y, p: y[:2],
        embed=lambda x, p: jnp.stack([*x, 0.0 * x[0]]),
    )
    gain = 1.0 / (1.0 - frequency**2 + 0.1j * frequency)  # of the steady vibration
    for factor, n_impacts in ((1.0 - 1e-6, 0), (1.0 + 1e-6, 1)):
        vibration = factor * grazing * gain * np.array([1.0, 1j * frequency])
        step = oscillator.step(factor * grazing, vibration.real, TIGHT)
        assert int(step.n_events) == 1 + n_impacts
        if n_impacts == 0:
            np.testing.assert_allclose(step.section_state, vibration.real, atol=1e-11)


def test_the_simplest_walker_has_the_gait_of_its_paper():
    """Garcia, Chatterjee, Ruina and Coleman (1998), slope 0.009 rad, to the digits known."""
    gait = vrw.limit_cycle(
        {"slope": 0.009}, model=SIMPLEST_WALKER, guess=[0.2, -0.2], options=TIGHT
    )
    assert gait.converged
    np.testing.assert_allclose(gait.section_state, [0.200310901, -0.199832473], atol=5e-10)
    angle = lambda slope: vrw.limit_cycle(
        {"slope": slope}, model=SIMPLEST_WALKER, guess=[0.2, -0.2], options=TIGHT
    ).section_state[0]
    difference = (angle(0.009 + 1e-5) - angle(0.009 - 1e-5)) / 2e-5  # its error is 1e-5 relative
    np.testing.assert_allclose(jax.grad(angle)(0.009), difference, rtol=1e-4)
    np.testing.assert_allclose(jax.grad(angle)(0.009), jax.jacfwd(angle)(0.009), rtol=1e-13)


def test_an_energy_conserving_biped_has_a_gait_on_its_level_set():
    gait = vrw.limit_cycle(SPRING_PARAMS, model=SPRING_BIPED, guess=SPRING_START, options=TIGHT)
    assert "invariants" not in gait.why  # The energy is named already, and its multiplier is 1.
    assert gait.converged, gait.why
    step = SPRING_BIPED.step(SPRING_PARAMS, gait.section_state, TIGHT)
    np.testing.assert_allclose(step.section_state, gait.section_state, atol=1e-11)
    energy = lambda x: spring_energy(x, SPRING_PARAMS)
    np.testing.assert_allclose(energy(gait.section_state), energy(SPRING_START), rtol=1e-13)
    assert np.min(np.abs(np.asarray(gait.multipliers) - 1.0)) < 1e-6


@pytest.mark.parametrize(
    ("level_rate", "armed_rate", "ends_at_start"),
    [(1.0, 2.0, False), (1.0, -1.0, False), (-1.0, -0.5, False), (-1.0, 2.0, True)],
)
def test_a_guard_that_is_zero_with_armed_ends_the_mode_only_if_it_falls(
    level_rate, armed_rate, ends_at_start
):
    field = lambda y, p: jnp.stack([p["level_rate"], p["armed_rate"], 1.0 + 0.0 * y[2]])
    guards = {
        "low": Guard(lambda y, p: y[0], armed=lambda y, p: y[1], ends_walk=True),
        "late": Guard(lambda y, p: 2.0 - y[2]),
    }
    system = vrw.HybridSystem(
        modes={"run": Mode(field, guards)}, section="late", state=("level", "armed", "time")
    )
    rates = {"level_rate": level_rate, "armed_rate": armed_rate}
    step = system.step(rates, jnp.zeros(3))
    assert step.duration == pytest.approx(0.0 if ends_at_start else 2.0, abs=1e-12)


@pytest.mark.parametrize("armed", [None, lambda y, p: -y[1]], ids=["plain", "armed"])
@pytest.mark.parametrize("options", [vrw.StepOptions(), TIGHT], ids=["default", "tight"])
def test_a_foot_that_lifts_off_with_zero_height_rate_and_acceleration_flies(armed, options):
    """Height h and rate v, with v' = s (1 - s) at the time s after take-off: h = 0 at s = 2."""
    stance = lambda y, p: jnp.stack([0.0 * y[0], 0.0 * y[0], 1.0 + 0.0 * y[0]])
    fly = lambda y, p: jnp.stack(
        [y[1], (y[2] - p["end"]) * (1.0 - y[2] + p["end"]), 1.0 + 0.0 * y[0]]
    )
    take_off = Guard(lambda y, p: p["end"] - y[2], target_mode="flight")
    land = Guard(lambda y, p: y[0], target_mode="stance", armed=armed)
    system = vrw.HybridSystem(
        modes={
            "stance": Mode(stance, {"take_off": take_off}),
            "flight": Mode(fly, {"landing": land}),
        },
        section="landing",
        state=("height", "rate", "time"),
    )
    ends = np.linspace(0.3, 2.0, 50)
    batch = system.step_batch({"end": ends}, np.zeros(3), options=options)
    assert np.all(np.asarray(batch.outcome) == vrw.Outcome.STEPPED)
    np.testing.assert_allclose(batch.mode_durations[:, 1], 2.0, atol=1e-6)
    np.testing.assert_allclose(batch.section_state[:, 1], 2.0**2 / 2 - 2.0**3 / 3, atol=1e-6)


def test_a_start_that_is_not_finite_is_a_bad_input():
    outcome = SPRING_BIPED.step(SPRING_PARAMS, [np.nan, *SPRING_START[1:]]).outcome
    assert outcome == vrw.Outcome.BAD_INPUT


def test_a_guard_that_ends_the_walk_adds_no_phase():
    guards = {
        "fall": Guard(lambda y, p: p["level"] - y[0], ends_walk=True),
        "late": Guard(lambda y, p: 2.0 - y[0]),
    }
    system = vrw.HybridSystem(
        modes={"run": Mode(lambda y, p: 1.0 + 0.0 * y, guards)}, section="late", state=("time",)
    )
    walk = vrw.simulate({"level": 1.5}, [0.0], 1, model=system, n_samples=5)
    np.testing.assert_allclose(walk.time, np.linspace(0.0, 1.5, 5), atol=1e-12)
    np.testing.assert_allclose(walk.state_time, walk.time, atol=1e-12)


def test_there_is_no_gait_if_a_declared_invariant_changes():
    """x[1] grows by `drift` in each step, so that no state repeats unless the drift is zero."""

    class DriftingWalker(vrw.AbstractWalker):
        invariants = [lambda x, p: x[1]]  # noqa: RUF012

        def advance(self, params, x, options):
            image = jnp.stack([0.5 * x[0] + 1.0, x[1] + params["drift"]])
            return vrw.AdvanceResult(image, jnp.ones(1))

    find = lambda drift: vrw.limit_cycle({"drift": drift}, model=DriftingWalker(), guess=[1.0, 2.0])
    assert find(0.0).found
    gait = find(0.3)
    assert gait.outcome == vrw.Outcome.NO_CYCLE_FOUND
    assert "conserves the invariants" in gait.ending
    assert "steps failed" not in gait.ending


def test_batches_have_the_bits_of_single_steps_and_reverse_mode_the_values_of_forward_mode():
    starts = SPRING_START + 0.01 * np.random.default_rng(0).uniform(-1.0, 1.0, (37, 4))
    stiffness = np.linspace(18.0, 22.0, 37)
    params = SPRING_PARAMS | {"stiffness": stiffness}
    batch = SPRING_BIPED.step_batch(params, starts)
    for i in (0, 17, 36):
        one = SPRING_BIPED.step_batch(
            SPRING_PARAMS | {"stiffness": stiffness[i : i + 1]}, starts[i]
        )
        np.testing.assert_array_equal(one.section_state[0], batch.section_state[i])
    step = lambda k, x: SPRING_BIPED.step(SPRING_PARAMS | {"stiffness": k}, x).section_state
    forward = jax.jacfwd(step, argnums=(0, 1))(20.0, SPRING_START)
    reverse = jax.jacrev(step, argnums=(0, 1))(20.0, SPRING_START)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), forward, reverse)


def test_the_map_of_a_conservative_biped_keeps_its_energy_and_its_volume():
    """The saltation of smooth forces preserves the symplectic form, so the determinant is 1."""
    x = jnp.asarray(SPRING_START)
    energy = lambda y: spring_energy(y, SPRING_PARAMS)
    step = SPRING_BIPED.step(SPRING_PARAMS, x, TIGHT)
    np.testing.assert_allclose(energy(step.section_state), energy(x), rtol=1e-12)


def test_other_values_of_parameters_compile_nothing(monkeypatch):
    spy = CodeRegistrySpy(monkeypatch)
    BALL.step_batch(BALL_PARAMS, np.ones((3, 1)))
    n_traces, names = spy.n_traces, list(spy.names)
    BALL.step_batch({"gravity": 1.62, "restitution": 0.7}, 2.0 * np.ones((5, 1)))
    make_ball().step_batch({"gravity": 3.7, "restitution": 0.7}, 2.0 * np.ones((5, 1)))
    assert (spy.n_traces, spy.names) == (n_traces, names)


@pytest.mark.filterwarnings("error")  # XLA would compute what has no machine code
def test_a_simulation_of_many_events_is_machine_code():
    simulation = walkers.BALL_SYSTEM.simulate(walkers.BALL_PARAMS, [0.0, 2.0], events=100)
    assert int(simulation.n_events) == 100
    flights = np.arange(1, 101) * 4.0 / walkers.GRAVITY
    np.testing.assert_allclose(simulation.times, flights, rtol=1e-12)
    np.testing.assert_allclose(simulation.states_after, np.tile([0.0, 2.0], (100, 1)), atol=1e-12)


def test_a_step_that_never_reaches_the_section_has_a_code_and_finite_numbers():
    rising = BALL.step_batch(
        BALL_PARAMS | {"gravity": np.array([9.81, -9.81])},
        [2.0],
        vrw.StepOptions(max_phase_time=3.0),
    )
    assert rising.termination.tolist() == [
        Termination.SECTION_REACHED,
        Termination.MAX_TIME_REACHED,
    ]
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(rising))
    codes = np.full(2, Termination.MAX_EVENTS_REACHED)
    endless = eqx.tree_at(lambda step: step.termination, rising, codes)
    assert all("max_events events: raise it" in ending for ending in endless.ending)


to_sky = Guard(lambda y, p: y[0], target_mode="sky")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"section": "landing"}, "impact"),
        ({"modes": {}}, "guard"),
        ({"modes": {"flight": Mode(lambda y, p: y, {})}}, "has no guard"),
        (
            {"modes": BALL.modes | {"rest": Mode(BALL.modes["flight"].field, {"start": to_sky})}},
            "flight",
        ),
        ({"state": ()}, "tuple of names"),
    ],
)
def test_wrong_definitions_are_refused_in_one_sentence(change, message):
    arguments = {"modes": BALL.modes, "section": "impact", "state": ("height", "velocity")}
    with pytest.raises(ValueError, match=message):
        HybridSystem(**(arguments | change))


def test_wrong_shapes_name_the_function_and_the_state():
    wrong = HybridSystem(
        modes={"flight": Mode(lambda y, p: y[:1], {"impact": Guard(lambda y, p: y[0])})},
        section="impact",
        state=("height", "velocity"),
    )
    with pytest.raises(ValueError, match=r"the field of mode 'flight' gives .*'velocity'"):
        wrong.step((), [1.0, 0.0])
    with pytest.raises(ValueError, match="its shape must be"):
        BALL.step(BALL_PARAMS, np.ones((3, 1)))


HELD_OSCILLATOR = HybridSystem(
    modes={
        "swing": Mode(
            lambda y, p: jnp.stack([1.0 + 0.0 * y[0], y[2], -(p["omega"] ** 2) * (y[1] - 0.2)]),
            {"end": Guard(lambda y, p: 1.0 - y[0], lambda y, p: y.at[0].add(-1.0))},
        )
    },
    section="end",
    state=("time", "position", "velocity"),
    project=lambda y, p: y[1:],
    embed=lambda x, p: jnp.stack([0.0 * x[0], *x]),
)


@pytest.mark.filterwarnings("ignore:XLA computes")  # diffrax's steps have no machine code
@pytest.mark.parametrize(
    ("options", "start", "tolerance"),
    # Tangents at rest have errors of 1e-8 of their size in a solver step, in about 100 steps. The
    # solver steps of an implicit method are those of the motion, which is therefore not at rest.
    [
        (vrw.StepOptions(), 0.2, 1e-6),
        (vrw.StepOptions(engine="diffrax"), 0.2, 1e-6),
        pytest.param(vrw.StepOptions(solver="Kvaerno5"), 0.7, 1e-6, marks=pytest.mark.slow),
    ],
    ids=["at rest", "at rest, by diffrax", "implicit"],
)
def test_derivatives_of_an_oscillator_have_the_closed_form(options, start, tolerance):
    omega = 100.0
    take_step = lambda x: (
        vrw.step({"omega": omega}, x, model=HELD_OSCILLATOR, options=options).section_state
    )
    jacobian = jax.jacfwd(take_step)(jnp.array([start, 0.0]))
    c, s = np.cos(omega), np.sin(omega)
    scale = np.array([[1.0, 1.0 / omega], [omega, 1.0]])
    np.testing.assert_allclose(jacobian / scale, [[c, s], [-s, c]], atol=tolerance)
