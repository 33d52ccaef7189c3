"""The configs of the library are valid, and every mistake in a config raises one sentence."""

import sys
from pathlib import Path

import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax import WheelParams, parameter_sets
from vrw_jax.app.config import Config, load_config, parse_assignments, parse_config
from vrw_jax.wheel import PARAMETER_NAMES

CONFIG_FOLDER = Path(__file__).parents[2] / "configs"


def test_a_missing_file_is_reported_with_a_similar_name() -> None:
    with pytest.raises(ValueError, match=r"no config file .*did you mean 'quickstart.toml'"):
        load_config(CONFIG_FOLDER / "quikstart.toml")


def test_a_folder_or_a_binary_file_is_no_config(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is a folder"):
        load_config(tmp_path)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="can't be read"):
        load_config(binary)


def test_a_byte_order_mark_is_no_part_of_a_config(tmp_path: Path) -> None:
    """Some editors of Windows write this mark before a text in UTF-8."""
    path, text = tmp_path / "marked.toml", "[wheel]\ndamping = 150.0\n"
    path.write_text(text, encoding="utf-8-sig")
    assert path.read_bytes().startswith(b"\xef\xbb\xbf")
    assert load_config(path) == parse_config(text, "marked.toml")


@pytest.mark.parametrize("path", sorted(CONFIG_FOLDER.glob("*.toml")), ids=lambda path: path.name)
def test_every_config_of_the_library_is_valid(path: Path) -> None:
    config = load_config(path)
    assert config.make_wheel().n_legs == 8
    assert config.source_text == path.read_text()


def test_the_quickstart_covers_table_1_with_at_least_4096_samples() -> None:
    design = load_config(CONFIG_FOLDER / "quickstart.toml").design
    assert design is not None
    assert design.size >= 4096
    assert set(design.swept_parameters) == {"damping", "stiffness", "natural_length", "slope"}
    for name, values in design.values_by_parameter.items():
        assert values.min() <= float(getattr(WheelParams(), name)) <= values.max()


def test_table_1_as_a_config_is_the_default_wheel() -> None:
    result, default = load_config(CONFIG_FOLDER / "table1.toml").make_wheel(), WheelParams()
    for name in PARAMETER_NAMES:
        assert float(getattr(result, name)) == float(getattr(default, name))


def test_a_restitution_of_zero_is_a_setting_and_uneven_is_none() -> None:
    text = '[model]\nname = "unilateral"\n'
    model = parse_config(text + "restitution = 0.0").make_model()
    assert repr(model) == repr(vrw.UnilateralWheel(restitution=0.0))
    with pytest.raises(ValueError, match="restitution"):
        parse_config(text + "restitution = 2.0")
    with pytest.raises(ValueError, match="unknown key 'uneven'"):
        parse_config(text + "uneven = 1.0")


LAW_FILE = """
from __future__ import annotations
import dataclasses
import equinox as eqx

class Leg(eqx.Module):
    k3: float = 10.0

    def __call__(self, L, dL, params):
        x = params.natural_length - L
        return params.stiffness * x + self.k3 * x**3 - params.damping * dL

@dataclasses.dataclass
class Gains:
    k3: float = 10.0

leg = Leg(Gains().k3)
"""


@pytest.mark.parametrize("name", ["leg", "Leg"])
def test_a_law_is_a_class_of_a_file_with_postponed_annotations(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_leg.py").write_text(LAW_FILE)
    config = parse_config(f'[model]\nleg_force = "my_leg.py:{name}"\n')
    assert config.make_model().leg_force.k3 == 10.0
    # Workers of dask, which do not have the file, would import the module.
    assert not any("my_leg" in module for module in sys.modules)


def test_an_empty_config_is_table_1() -> None:
    assert parse_config("") == Config(file_name="config")


def test_an_axis_is_a_list_or_from_to_count() -> None:
    design = parse_config(
        "[grid]\ndamping = [1.0, 5.0, 2.0]\nslope = { from = 0.1, to = 0.3, count = 3 }"
    ).design
    assert design is not None
    np.testing.assert_array_equal(design.values_by_parameter["damping"], [1.0, 5.0, 2.0])
    np.testing.assert_allclose(design.values_by_parameter["slope"], [0.1, 0.2, 0.3])


@pytest.mark.parametrize("kind", ["sobol", "uniform"])
def test_random_samples_are_reproduced_by_their_seed_and_stay_in_their_box(kind: str) -> None:
    def draw(seed: int) -> np.ndarray:
        text = f"[{kind}]\nn = 100\nseed = {seed}\ndamping = [100.0, 200.0]\nslope = [0.2, 0.3]"
        design = parse_config(text).design
        assert design is not None
        return np.stack(list(design.values_by_parameter.values()))

    assert draw(1).shape == (2, 100)
    np.testing.assert_array_equal(draw(1), draw(1))
    assert not np.array_equal(draw(1), draw(2))
    assert np.all((draw(1) >= [[100.0], [0.2]]) & (draw(1) <= [[200.0], [0.3]]))


def test_assignments_change_parameters_of_the_wheel_or_of_a_named_set() -> None:
    assert parse_assignments(["damping = 150", "n_legs=10"]) == {"damping": 150.0, "n_legs": 10}
    two_peaks = parameter_sets["two_peaks"].values
    changed = parse_assignments(["damping=150", "parameter_set=two_peaks"])
    assert changed == two_peaks | {"damping": 150.0}


LEG_FILE = """
import equinox as eqx
import vrw_jax as vrw

class SoftLeg(eqx.Module):
    k: float = vrw.parameter(450.0, unit="N/m")

    def __call__(self, L, dL, params):
        return self.k * (params.natural_length - L) - params.damping * dL

class BareLeg(SoftLeg):
    k: float

    def __init__(self, k):
        self.k = k

stiffness = 600.0
stiff_leg = SoftLeg(stiffness)
"""


def test_a_config_takes_a_law_of_the_legs_from_a_python_file(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my_leg.py").write_text(LEG_FILE)
    config_text = '[model]\nleg_force = "my_leg.py:{}"\n[grid]\n"leg.k" = [450.0, 500.0]\n'
    config = parse_config(config_text.format("SoftLeg"))
    assert config.design.swept_parameters == ("leg.k",)
    assert float(config.make_model().leg_force.k) == 450.0
    stiff_config = parse_config(config_text.format("stiff_leg"))
    assert float(stiff_config.make_model().leg_force.k) == 600.0


def test_a_config_drives_the_hub_by_a_torque_and_sweeps_it() -> None:
    text = '[wheel]\nslope = 0.0\n[model]\nhub_torque = 47.23\n[grid]\n"hub.torque" = [45, 47]\n'
    config = parse_config(text)
    assert float(config.make_model().hub_torque.torque) == 47.23
    assert config.design.swept_parameters == ("hub.torque",)
    contact_config = parse_config('[model]\nname = "unilateral"\nhub_torque = 1.0\n')
    assert float(contact_config.make_model().hub_torque.torque) == 1.0
    with pytest.raises(ValueError, match="has the unknown key 'hub_torque'"):
        parse_config('[model]\nname = "rigid"\nhub_torque = 1.0\n')


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ('"my_leg"', 'a Python file and a name in it, as "my_leg.py:leg"'),
        ('"my_leg.py:leg"', "my_leg.py does not define leg"),
        ('"other.py:leg"', "names the file other.py, which"),
        ("3", "a Python file and a name in it"),
        ('"torn.py:leg"', r"torn.py:leg, but this raises SyntaxError .*: mend torn.py"),
        ('"lonely.py:leg"', r"raises ModuleNotFoundError \(No module named 'nowhere'\): mend"),
        ('"my_leg.py:BareLeg"', "raises TypeError .*'k'.*: mend my_leg.py, where arguments of"),
        ('"my_leg.py:stiffness"', "raises TypeError .*leg_force is 600.0, but it is the force"),
    ],
)
def test_a_wrong_place_of_a_law_is_one_sentence(setting, message, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my_leg.py").write_text(LEG_FILE)
    Path("torn.py").write_text("def leg(L, dL, params:")
    Path("lonely.py").write_text("import nowhere")
    with pytest.raises(ValueError, match=message):
        parse_config(f"[model]\nleg_force = {setting}\n")
