"""Whatever takes a model uses it: an option of the model shows in what every function tells."""

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
    ).friction_fore.values.ravel()[0],
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
