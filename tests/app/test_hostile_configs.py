"""Each key of a config accepts an invalid value, or raises one sentence."""

import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import vrw_jax as vrw
from vrw_jax.app import config
from vrw_jax.models import list_model_config_names

SWEPT = (*config.PARAMETER_NAMES, config.FRICTION_NAME)
RANGES = dict.fromkeys(config.RANDOM_DESIGN_FUNCTIONS, ("n", "seed", *SWEPT))
KEYS = {
    "wheel": (*config.PARAMETER_NAMES, "n_legs"),
    "model": ("name", "friction", "max_events", "stoppers", "restitution",
              "infinite_friction_rule", "uneven", "stop_at_lift_off"),
    "options": tuple(config.StepOptions.__dataclass_fields__),
    "gait": tuple(config.GaitConfig.__dataclass_fields__),
    "scan": tuple(config.ScanConfig.__dataclass_fields__),
    "tune": tuple(config.TuneConfig.__dataclass_fields__),
    "branch": tuple(config.BranchConfig.__dataclass_fields__),
    "grid": SWEPT, "samples": SWEPT, **RANGES,
    "tune.bounds": config.PARAMETER_NAMES, "tune.constraints": ("speed",),
}  # fmt: skip
"""Keys of each table."""
SOUND = {
    "tune": "[tune.bounds]\nslope = [0.2, 0.3]\n",
    "tune.constraints": "[tune.bounds]\nslope = [0.2, 0.3]\n",
    "sobol": "n = 4\n", "uniform": "n = 4\n", "saltelli": "n = 4\n",
    "branch": 'parameter = "slope"\nbounds = [0.2, 0.3]\n',
}  # fmt: skip
"""What a table needs besides."""
ODD = (
    "nan", "-nan", "inf", "-inf", "0x1F", "1e400", "-1e400", "5e-324", "9" * 400, "-" + "9" * 400,
    "9" * 5000, "0x" + "f" * 9000, "1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", "[]", "{}",
    '""', '"\\u0000"', "[[[]]]", "[" * 2000 + "]" * 2000, "{a = {b = {c = 1}}}", "[1, 'a']",
    "{from = 1, to = nan, count = 3}", "{from = 1, to = 2, count = -3}", "true", "[true, false]",
    "[1.0, 2.0]", "[2.0, 1.0]", "[nan, 1.0]", "[1979-05-27, 1]", "'inf'", "3", "0", "-1", "2.5",
)  # fmt: skip
LITERALS = (
    st.sampled_from(ODD)
    | st.integers().map(str)
    | st.floats().map(repr)
    | st.text(st.characters(codec="utf-8"), max_size=12).map(json.dumps)
    | st.lists(st.floats() | st.integers(-9, 9), max_size=4).map(repr)
)
PLACES = [(table, key) for table, keys in KEYS.items() for key in keys]


@pytest.mark.parametrize("model_name", list_model_config_names())
@settings(
    max_examples=150, derandomize=True, database=None, deadline=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
@given(place=st.sampled_from(PLACES), literal=LITERALS)
def test_a_key_takes_or_refuses_a_hostile_value(model_name, place, literal):
    vrw.CycleOptions()  # Types are checked in the first call of a test; the config checks others.
    table, key = place
    named = "" if place == ("model", "name") else f'name = "{model_name}"\n'
    lines = [line for line in SOUND.get(table, "").splitlines() if not line.startswith(f"{key} =")]
    before = "".join(f"{line}\n" for line in lines if table.startswith("tune"))
    inside = "".join(f"{line}\n" for line in lines if not table.startswith("tune"))
    head = f"[model]\n{named}" if table == "model" else f"[model]\n{named}\n{before}[{table}]\n"
    if table == "tune" and key == "bounds":
        head = f"[model]\n{named}[tune]\n"
    text = f"{head}{inside}{key} = {literal}\n"
    try:
        config.parse_config(text, "my.toml")
    except ValueError as error:
        sentence = str(error)
        assert sentence.startswith("my.toml: "), sentence
        assert sentence.endswith("."), sentence
        assert "\n" not in sentence, sentence
