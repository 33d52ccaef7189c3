"""A new model needs edits in one place: its class declares what the library offers for it."""

from typing import ClassVar

import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.app.config import parse_config
from vrw_jax.models import MODEL_CLASSES, describe_accepted_models


class PointFeetWheel(vrw.AbstractWheel):
    """A user's model, whose motion is that of the rigid wheel."""

    model_name: ClassVar[str] = "point_feet"
    commands = frozenset({"branch"})
    reports_contacts: ClassVar[bool] = False
    is_compliant: ClassVar[bool] = False

    def advance(self, params, x, options):
        return vrw.RigidWheel().advance(params, x, options)

    def take_step(self, params, x, options):
        return vrw.RigidWheel().take_step(params, x, options)

    def sample_step(self, params, x, options, n_samples):
        return vrw.RigidWheel().sample_step(params, x, options, n_samples)

    def compute_default_start(self, params):
        return vrw.RigidWheel().compute_default_start(params)


PARAMS = vrw.WheelParams(slope=0.15)


def test_a_new_model_has_gaits():
    cycle = vrw.limit_cycle(PARAMS, model=PointFeetWheel())
    reference = vrw.limit_cycle(PARAMS, model=vrw.RigidWheel())
    assert float(cycle.period) == float(reference.period)


START = np.array([np.pi / 8, 2.0, 0.0])
GRID = {"theta_touchdown": np.pi / 8, "dtheta_touchdown": [1.0, 2.0], "dL1_touchdown": 0.0}
BOX = GRID | {"dtheta_touchdown": (0.5, 2.0)}
CALLS = {
    "walk": lambda model: vrw.walk(PARAMS, START, 3, model=model).steps.section_state,
    "step_batch": lambda model: vrw.step_batch(PARAMS, START[None], 3, model=model).section_state,
    "simulate": lambda model: vrw.simulate(PARAMS, START, 2, model=model, n_samples=9).theta,
    "basin": lambda model: vrw.basin(PARAMS, GRID, model=model).steps,
}
SLOW_CALLS = {
    "limit_cycles": lambda model: (
        vrw.limit_cycles(vrw.WheelParams(slope=np.array([0.15, 0.2])), model=model).period
    ),
    "sensitivities": lambda model: (
        vrw.sensitivities(PARAMS, measures=["period", "speed"], model=model).derivative
    ),
    "basin_share": lambda model: vrw.basin_share(PARAMS, BOX, model=model, n_starts=32).share,
    "gait_sensitivity": lambda model: vrw.gait_sensitivity(PARAMS, "period", model=model).norm,
}


@pytest.mark.parametrize(
    "call",
    [
        *CALLS.values(),
        *(pytest.param(call, marks=pytest.mark.slow) for call in SLOW_CALLS.values()),
    ],
    ids=[*CALLS, *SLOW_CALLS],
)
def test_functions_take_a_new_model_without_further_edits(call):
    """The reference is the rigid wheel, whose motion the model has."""
    np.testing.assert_array_equal(call(PointFeetWheel()), call(vrw.RigidWheel()))


@pytest.mark.slow
def test_a_new_model_has_branches():
    branch = vrw.continue_branch(PARAMS, "slope", (0.1, 0.2), model=PointFeetWheel())
    assert float(branch.dataset.slope.min()) == pytest.approx(0.1, abs=1e-12)


def test_a_new_model_in_the_registry_is_known_to_configurations_and_messages(monkeypatch):
    text = '[model]\nname = "point_feet"\n[branch]\nparameter = "slope"\nbounds = [0.1, 0.2]\n'
    with pytest.raises(ValueError, match="viscoelastic"):
        parse_config(text)
    monkeypatch.setitem(MODEL_CLASSES, "point_feet", PointFeetWheel)
    assert isinstance(parse_config(text).make_model(), PointFeetWheel)
    assert describe_accepted_models("branch").endswith(" or vrw.PointFeetWheel()")


@pytest.mark.parametrize("model_class", MODEL_CLASSES.values(), ids=lambda entry: entry.__name__)
def test_each_model_declares_known_commands(model_class):
    assert model_class.commands <= {"scan", "map", "tune", "branch", "explore"}
