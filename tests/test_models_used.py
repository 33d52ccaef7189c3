"""Whatever takes a model uses it: an option of the model shows in what every function tells."""

import inspect

import jax
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax import Outcome

GAIT = vrw.WheelParams(damping=150.0)
START = (0.1, 1.6, -0.1)
LIFTS = vrw.WheelParams(
    damping=134.39206145462754,
    stiffness=2258.0532914678806,
    natural_length=1.0596233895151306,
    slope=0.09007963482854395,
)
LIFTING = (0.3461248827269049, 3.702368426186512, -1.6963747021942828)
"""From here the ground would have to pull on Leg 1 for a while in single support II."""


def batch(params):
    return jax.tree.map(lambda x: x[None], params)


def of_branches(branches):
    return branches[0].dataset.friction_fore[0]


FRICTION = {
    "step": lambda m: vrw.step(GAIT, START, model=m).monitors.friction_fore,
    "limit_cycle": lambda m: vrw.limit_cycle(GAIT, model=m).monitors.friction_fore,
    "limit_cycles": lambda m: vrw.limit_cycles(batch(GAIT), model=m).monitors.friction_fore[0],
    "scan": lambda m: vrw.scan(
        vrw.grid(damping=[150.0]), ["friction_fore"], model=m
    ).friction_fore.values.ravel()[0],
    "basin": lambda m: vrw.basin(
        GAIT,
        {"theta_touchdown": 0.1, "dtheta_touchdown": 1.6, "dL1_touchdown": -0.1},
        model=m,
    ).orbit_friction_fore.values.ravel()[0],
    "sensitivities": lambda m: vrw.sensitivities(GAIT, measures=("friction_fore",), model=m).value[
        0
    ],
    "continue_branch": lambda m: of_branches(
        [vrw.continue_branch(GAIT, "damping", (149.9, 150.1), model=m)]
    ),
    "continue_branches": lambda m: of_branches(
        vrw.continue_branches(batch(GAIT), "damping", (149.9, 150.1), model=m)
    ),
    "tune": lambda m: (
        vrw.tune(
            GAIT, "speed", ["damping"], {"damping": (149.9, 150.1)}, {}, model=m, max_evaluations=1
        ).step.monitors.friction_fore
    ),
}
"""By function: the margin to the friction needed at the fore foot that it tells."""
LONG = {"sensitivities", "continue_branch", "continue_branches", "tune", "basin"}
"""Those that compile for minutes where nothing is kept."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LONG)) for n in FRICTION]
)
def test_the_friction_of_the_model_shows(name):
    told = [float(FRICTION[name](vrw.ViscoelasticWheel(friction=mu))) for mu in (1.0, 20.0)]
    np.testing.assert_allclose(told[1] - told[0], 19.0, rtol=1e-9)


OUTCOMES = {
    "step": lambda m: vrw.step(LIFTS, LIFTING, model=m).outcome,
    "walk": lambda m: vrw.walk(LIFTS, LIFTING, 1, model=m).outcome,
    "steps": lambda m: vrw.steps(LIFTS, np.array([LIFTING]), model=m).outcome[0],
    "simulate": lambda m: Outcome[vrw.simulate(LIFTS, LIFTING, 1, model=m).outcome],
    "basin": lambda m: vrw.basin(
        LIFTS,
        dict(zip(("theta_touchdown", "dtheta_touchdown", "dL1_touchdown"), LIFTING, strict=True)),
        model=m,
        most_steps=1,
    ).outcome.values.ravel()[0],
}
"""By function: how a step ends from `LIFTING`."""


@pytest.mark.parametrize("name", OUTCOMES)
def test_a_ground_that_may_pull_shows(name):
    lifted, held = (
        int(OUTCOMES[name](vrw.ViscoelasticWheel(stop_at_lift_off=stops)))
        for stops in (True, False)
    )
    assert lifted == Outcome.LEG_1_LIFTED_OFF
    assert held != lifted


def test_the_return_map_goes_on_where_the_ground_may_pull():
    lifted, held = (
        vrw.return_map(LIFTS, LIFTING, model=vrw.ViscoelasticWheel(stop_at_lift_off=stops))
        for stops in (True, False)
    )
    assert np.all(np.asarray(lifted) == 0.0)
    assert np.all(np.asarray(held) != 0.0)


PULLED = vrw.WheelParams(damping=41.2, stiffness=684.0, natural_length=1.066, slope=0.124)
"""In its gait the ground would have to pull on Leg 1 for a while in double support."""
NEAR = (683.0, 685.0)


def goes(call):
    """Whether it does not refuse for want of a gait."""
    try:
        call()
    except ValueError as refusal:
        if "no gait" not in str(refusal):
            raise
        return False
    return True


def branch_of(branch):
    return branch.outcome == Outcome.STEPPED


GAITS = {
    "limit_cycle": lambda m: vrw.limit_cycle(PULLED, model=m).found,
    "limit_cycles": lambda m: vrw.limit_cycles(batch(PULLED), model=m).found[0],
    "scan": lambda m: (
        not vrw.scan(
            vrw.grid(damping=[41.2], stiffness=[684.0], natural_length=[1.066], slope=[0.124]),
            ["speed"],
            model=m,
        ).outcome.values.ravel()[0]
    ),
    "sensitivities": lambda m: goes(
        lambda: vrw.sensitivities(PULLED, measures=("speed",), model=m)
    ),
    "continue_branch": lambda m: branch_of(vrw.continue_branch(PULLED, "stiffness", NEAR, model=m)),
    "continue_branches": lambda m: branch_of(
        vrw.continue_branches(batch(PULLED), "stiffness", NEAR, model=m)[0]
    ),
    "tune": lambda m: goes(
        lambda: vrw.tune(
            PULLED, "speed", ["stiffness"], {"stiffness": NEAR}, {}, model=m, max_evaluations=1
        )
    ),
}
"""By function: whether it tells of that gait."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LONG)) for n in GAITS]
)
def test_a_gait_on_ground_that_pulls_is_one_where_the_ground_may(name):
    lifted, held = (
        bool(GAITS[name](vrw.ViscoelasticWheel(stop_at_lift_off=stops))) for stops in (True, False)
    )
    assert held
    assert not lifted


def test_every_function_that_takes_a_model_is_tried_with_both_of_its_options():
    public = {name: getattr(vrw, name) for name in vrw.__all__ if name != "plot"}
    functions = {name: f for name, f in public.items() if inspect.isfunction(f)}
    taking = {name for name, f in functions.items() if "model" in inspect.signature(f).parameters}
    assert taking - {"return_map"} == set(OUTCOMES) | set(GAITS)
    measured = {"steps", "walk", "simulate", "return_map"}  # tell no margin of friction
    assert taking - measured == set(FRICTION)


@pytest.mark.slow
def test_a_curve_of_a_border_is_that_of_the_model_of_its_gait():
    # The need of friction at the fore foot that this border of the gait's ground marks.
    rough = vrw.ViscoelasticWheel(friction=1.05)
    gait = vrw.limit_cycle(vrw.WheelParams(damping=40.0), model=rough)
    (border,) = [
        border
        for border in vrw.continue_branch(
            vrw.WheelParams(damping=40.0), "damping", (20.0, 45.0), model=rough
        ).borders
        if border.name == "friction_fore"
    ]
    curve = vrw.border_curve(
        "friction_fore", ("damping", "stiffness"), gait, bounds={"stiffness": (498.0, 502.0)}
    )
    off = np.abs(curve.values - (border.value, 500.0)).max(1)
    assert np.min(off) < 1e-6
