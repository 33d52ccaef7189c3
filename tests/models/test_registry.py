"""A new model needs edits in one place: its class declares what the library offers for it."""

from typing import ClassVar

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
