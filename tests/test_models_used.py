"""Every function that takes a model uses the model's options in its results."""

import inspect

import jax
import numpy as np
import pytest
from support.slow_variants import make_params_with_slow_marks

import vrw_jax as vrw
from vrw_jax import Outcome

GAIT = vrw.WheelParams(damping=150.0)
START = (0.1, 1.6, -0.1)
LIFT_OFF_WHEEL = vrw.WheelParams(
    damping=134.39206145462754,
    stiffness=2258.0532914678806,
    natural_length=1.0596233895151306,
    slope=0.09007963482854395,
)
LIFT_OFF_START = (0.3461248827269049, 3.702368426186512, -1.6963747021942828)
"""From here the ground would have to pull on Leg 1 for a while in single support II."""


def make_batch(params):
    return jax.tree.map(lambda x: x[None], params)


def first_fore_friction(branches):
    return branches[0].dataset.friction_fore[0]


FRICTION = {
    "step": lambda m: vrw.step(GAIT, START, model=m).margins.friction_fore,
    "limit_cycle": lambda m: vrw.limit_cycle(GAIT, model=m).margins.friction_fore,
    "limit_cycles": lambda m: vrw.limit_cycles(make_batch(GAIT), model=m).margins.friction_fore[0],
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
    "continue_branch": lambda m: first_fore_friction(
        [vrw.continue_branch(GAIT, "damping", (149.9, 150.1), model=m)]
    ),
    "continue_branches": lambda m: first_fore_friction(
        vrw.continue_branches(make_batch(GAIT), "damping", (149.9, 150.1), model=m)
    ),
    "map_special_points": lambda m: vrw.map_special_points(
        vrw.grid(damping=[150.0, 150.1], stiffness=[500.0, 500.1]), model=m
    ).scan.friction_fore.values.ravel()[0],
    "tune": lambda m: (
        vrw.tune(
            GAIT, "speed", ["damping"], {"damping": (149.9, 150.1)}, {}, model=m, max_evaluations=1
        ).step.margins.friction_fore
    ),
}
"""By function: the margin to the friction needed at the fore foot that it tells."""
SLOW_FUNCTIONS = {
    "gait_sensitivity",
    "scan",
    "first_passage",
    "basin_share",
    "measure_basins",
    "measure_gait_sensitivity",
    "smallest_disturbance",
    "sensitivities",
    "continue_branch",
    "continue_branches",
    "tune",
    "basin",
    "map_special_points",
    "fit",
    "compare_laws",
    "phase_response",
}
"""Those that compile for minutes where nothing is kept."""


@pytest.mark.parametrize(
    "name",
    make_params_with_slow_marks(FRICTION, SLOW_FUNCTIONS),
)
def test_friction_margins_use_the_friction_of_the_model(name):
    rows = [float(FRICTION[name](vrw.ViscoelasticWheel(friction=mu))) for mu in (1.0, 20.0)]
    np.testing.assert_allclose(rows[1] - rows[0], 19.0, rtol=1e-9)


ONE_GAIT = {"period": [0.7], "period_error": [1.0], "speed": [1.0], "speed_error": [1.0]}

OUTCOMES = {
    "step": lambda m: vrw.step(LIFT_OFF_WHEEL, LIFT_OFF_START, model=m).outcome,
    "walk": lambda m: vrw.walk(LIFT_OFF_WHEEL, LIFT_OFF_START, 1, model=m).outcome,
    "step_batch": lambda m: vrw.step_batch(
        LIFT_OFF_WHEEL, np.array([LIFT_OFF_START]), model=m
    ).outcome[0],
    "simulate": lambda m: Outcome[vrw.simulate(LIFT_OFF_WHEEL, LIFT_OFF_START, 1, model=m).outcome],
    "basin": lambda m: vrw.basin(
        LIFT_OFF_WHEEL,
        dict(
            zip(
                ("theta_touchdown", "dtheta_touchdown", "dL1_touchdown"),
                LIFT_OFF_START,
                strict=True,
            )
        ),
        model=m,
        max_steps=1,
    ).outcome.values.ravel()[0],
}
"""By function: the outcome of a step from `LIFT_OFF_START`."""

SLOW_OUTCOME_FUNCTIONS = ("simulate", "walk")
"""Functions that compile a program of their own for the same walking step."""


@pytest.mark.parametrize("name", make_params_with_slow_marks(OUTCOMES, SLOW_OUTCOME_FUNCTIONS))
def test_steps_continue_after_lift_off_only_if_the_model_allows_it(name):
    lifted, held_values = (
        int(OUTCOMES[name](vrw.ViscoelasticWheel(stop_at_lift_off=stops)))
        for stops in (True, False)
    )
    assert lifted == Outcome.LEG_1_LIFTED_OFF
    assert held_values != lifted


def test_the_return_map_continues_after_lift_off_if_allowed():
    lifted, held_values = (
        vrw.return_map(
            LIFT_OFF_WHEEL, LIFT_OFF_START, model=vrw.ViscoelasticWheel(stop_at_lift_off=stops)
        )
        for stops in (True, False)
    )
    assert np.all(np.asarray(lifted) == 0.0)
    assert np.all(np.asarray(held_values) != 0.0)


PULLED_WHEEL = vrw.WheelParams(damping=41.2, stiffness=684.0, natural_length=1.066, slope=0.124)
"""In its gait the ground would have to pull on Leg 1 for a while in double support."""
PULLED_BOX = {"theta_touchdown": 0.1, "dtheta_touchdown": (1.0, 2.0), "dL1_touchdown": 0.0}
STIFFNESS_BOUNDS = (683.0, 685.0)


def is_successful(call):
    """Whether it does not refuse for want of a gait."""
    try:
        call()
    except ValueError as refusal:
        if "no gait" not in str(refusal):
            raise
        return False
    return True


def is_branch_found(branch):
    return branch.outcome == Outcome.STEPPED


GAITS = {
    "limit_cycle": lambda m: vrw.limit_cycle(PULLED_WHEEL, model=m).found,
    "limit_cycles": lambda m: vrw.limit_cycles(make_batch(PULLED_WHEEL), model=m).found[0],
    "scan": lambda m: (
        not vrw.scan(
            vrw.grid(damping=[41.2], stiffness=[684.0], natural_length=[1.066], slope=[0.124]),
            ["speed"],
            model=m,
        ).outcome.values.ravel()[0]
    ),
    "sensitivities": lambda m: is_successful(
        lambda: vrw.sensitivities(PULLED_WHEEL, measures=("speed",), model=m)
    ),
    "gait_sensitivity": lambda m: is_successful(
        lambda: vrw.gait_sensitivity(PULLED_WHEEL, ("period",), model=m)
    ),
    "first_passage": lambda m: is_successful(
        lambda: vrw.first_passage(PULLED_WHEEL, 0.005, model=m, n_walkers=256, max_steps=20_000)
    ),
    "basin_share": lambda m: is_successful(
        lambda: vrw.basin_share(PULLED_WHEEL, PULLED_BOX, model=m, n_starts=2)
    ),
    "smallest_disturbance": lambda m: is_successful(
        lambda: vrw.smallest_disturbance(PULLED_WHEEL, model=m)
    ),
    "measure_basins": lambda m: is_successful(
        lambda: vrw.measure_basins(
            vrw.continue_branch(PULLED_WHEEL, "stiffness", STIFFNESS_BOUNDS, model=m),
            PULLED_BOX,
            model=m,
            n_points=1,
            n_starts=2,
        )
    ),
    "measure_gait_sensitivity": lambda m: is_successful(
        lambda: vrw.measure_gait_sensitivity(
            vrw.continue_branch(PULLED_WHEEL, "stiffness", STIFFNESS_BOUNDS, model=m),
            "period",
            model=m,
            n_points=1,
        )
    ),
    "continue_branch": lambda m: is_branch_found(
        vrw.continue_branch(PULLED_WHEEL, "stiffness", STIFFNESS_BOUNDS, model=m)
    ),
    "continue_branches": lambda m: is_branch_found(
        vrw.continue_branches(make_batch(PULLED_WHEEL), "stiffness", STIFFNESS_BOUNDS, model=m)[0]
    ),
    "map_special_points": lambda m: is_successful(
        lambda: vrw.map_special_points(
            vrw.grid(damping=[41.2, 41.201], stiffness=[684.0, 684.01]), base=PULLED_WHEEL, model=m
        )
    ),
    "tune": lambda m: is_successful(
        lambda: vrw.tune(
            PULLED_WHEEL,
            "speed",
            ["stiffness"],
            {"stiffness": STIFFNESS_BOUNDS},
            {},
            model=m,
            max_evaluations=1,
        )
    ),
    "phase_response": lambda m: is_successful(
        lambda: vrw.phase_response(PULLED_WHEEL, model=m, n_samples=2)
    ),
    "fit": lambda m: vrw.fit(ONE_GAIT, PULLED_WHEEL, ["stiffness"], model=m, n_starts=1).converged,
    "compare_laws": lambda m: vrw.compare_laws(
        ONE_GAIT, PULLED_WHEEL, ["stiffness"], model=m, n_folds=0, n_starts=1
    ).converged.sel(law="linear"),
}
"""By function: whether it tells of that gait."""


@pytest.mark.parametrize("name", make_params_with_slow_marks(GAITS, SLOW_FUNCTIONS))
def test_a_gait_beyond_lift_off_is_found_only_if_the_model_allows_it(name):
    lifted, held_values = (
        bool(GAITS[name](vrw.ViscoelasticWheel(stop_at_lift_off=stops))) for stops in (True, False)
    )
    assert held_values
    assert not lifted


def test_every_function_with_a_model_argument_is_tested_with_both_options():
    public = {name: getattr(vrw, name) for name in vrw.__all__ if name != "plot"}
    functions = {name: f for name, f in public.items() if inspect.isfunction(f)}
    taking = {name for name, f in functions.items() if "model" in inspect.signature(f).parameters}
    # The gait of a wheel contains its model; a curve takes the model of a user's walker only.
    taking -= {"continue_special_point"}
    assert taking - {"return_map"} == set(OUTCOMES) | set(GAITS)
    # These report no margin of friction, or only how it varies.
    measured = {"step_batch", "walk", "simulate", "return_map", "gait_sensitivity"}
    measured |= {"first_passage", "basin_share", "smallest_disturbance", "measure_basins"}
    measured |= {"measure_gait_sensitivity", "fit", "compare_laws", "phase_response"}
    assert taking - measured == set(FRICTION)


@pytest.mark.slow
def test_a_special_point_curve_uses_the_model_of_its_gait():
    # The need of friction at the fore foot that this border of the gait's ground marks.
    rough = vrw.ViscoelasticWheel(friction=1.05)
    gait = vrw.limit_cycle(vrw.WheelParams(damping=40.0), model=rough)
    (border,) = [
        border
        for border in vrw.continue_branch(
            vrw.WheelParams(damping=40.0), "damping", (20.0, 45.0), model=rough
        ).special_points
        if border.name == "friction_fore"
    ]
    curve = vrw.continue_special_point(
        "friction_fore", ("damping", "stiffness"), gait, bounds={"stiffness": (498.0, 502.0)}
    )
    off = np.abs(curve.values - (border.value, 500.0)).max(1)
    assert np.min(off) < 1e-6
