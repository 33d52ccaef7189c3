"""Configs: what stands in the files of the library is right, and every mistake gets a sentence."""

from pathlib import Path

import numpy as np
import pytest

from vrw_jax.app.config import Config, ConfigError, assignment, load, parse
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams

CONFIGS = Path(__file__).parents[2] / "configs"

MISTAKES = {
    "not TOML": ("[wheel", "not valid TOML"),
    "unknown table": ("[whel]\nslope = 0.3", "did you mean 'wheel'"),
    "table as value": ("wheel = 3", "must be a table"),
    "unknown parameter": ("[wheel]\ndampin = 3.0", "did you mean 'damping'"),
    "text for a number": ('[wheel]\ndamping = "much"', "must be a finite number"),
    "true for a number": ("[wheel]\ndamping = true", "must be a finite number"),
    "not finite": ("[wheel]\ndamping = nan", "must be a finite number"),
    "out of its domain": ("[wheel]\ndamping = -1.0", "must lie in [0, 1e+09) N s/m"),
    "mass beyond the hub": ("[wheel]\nleg_com = 2.0", "leg_com < locked_length"),
    "too few legs": ("[wheel]\nn_legs = 4", "at least 5"),
    "part of a leg": ("[wheel]\nn_legs = 8.5", "whole number"),
    "unknown setting": ("[scan]\nchunks = 3", "did you mean 'chunk'"),
    "no samples in a chunk": ("[scan]\nchunk = 0", "at least 1"),
    "measures as text": ('[scan]\nmeasures = "speed"', "list of names"),
    "unknown measure": ('[scan]\nmeasures = ["sped"]', "did you mean 'speed'"),
    "derivative of what": ('[scan]\nmeasures = ["d sped / d damping"]', "did you mean 'speed'"),
    "derivative by what": ('[scan]\nmeasures = ["d speed / d dampin"]', "did you mean 'damping'"),
    "derivative of a margin": (
        '[scan]\nmeasures = ["d clearance_sls1 / d damping"]',
        "a scan differentiates only",
    ),
    "empty grid": ("[grid]", "sweeps no parameter"),
    "empty axis": ("[grid]\ndamping = []", "empty list"),
    "axis as number": ("[grid]\ndamping = 3.0", "list of numbers or { from"),
    "axis without count": ("[grid]\ndamping = { from = 1.0, to = 2.0 }", "no 'count'"),
    "axis with no values": ("[grid]\ndamping = { from = 1.0, to = 2.0, count = 0 }", "at least 1"),
    "axis out of its domain": ("[grid]\nslope = { from = 0.1, to = 2.0, count = 3 }", "rad"),
    "value twice": ("[grid]\ndamping = [1.0, 1.0]", "holds a value twice"),
    "unknown axis key": (
        "[grid]\ndamping = { from = 1.0, to = 2.0, cout = 3 }",
        "did you mean 'count'",
    ),
    "columns of two lengths": ("[samples]\ndamping = [1.0]\nslope = [0.1, 0.2]", "one length"),
    "no number of samples": ("[sobol]\ndamping = [1.0, 2.0]", "says not how many"),
    "range of three": ("[sobol]\nn = 4\ndamping = [1.0, 2.0, 3.0]", "range of two numbers"),
    "range upside down": ("[uniform]\nn = 4\ndamping = [2.0, 1.0]", "lower one first"),
    "negative seed": ("[uniform]\nn = 4\nseed = -1\ndamping = [1.0, 2.0]", "at least 0"),
    "two designs": ("[grid]\ndamping = [1.0]\n[samples]\nslope = [0.1]", "keep one"),
    "fixed and swept": ("[wheel]\nslope = 0.3\n[grid]\nslope = [0.1]", "drop one of the two"),
    "unknown option": ("[options]\nrtoll = 1e-9", "did you mean 'rtol'"),
    "tolerance not positive": ("[options]\nrtol = -1.0", "must be positive"),
    "tolerance out of reach": ("[options]\nrtol = 1e-30", "can't resolve"),
    "solver as number": ("[options]\nsolver = 5", "must be a name"),
    "no steps": ("[gait]\nsteps = 0", "at least 1"),
    "start of two numbers": ("[gait]\nstart = [0.1, 1.6]", "three numbers"),
    "friction not positive": ("[model]\nfriction = 0", "must be positive"),
    "switch as number": ("[model]\nstop_at_lift_off = 1", "true or false"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_a_config_gets_one_sentence_that_helps(mistake: str) -> None:
    text, expected = MISTAKES[mistake]
    with pytest.raises(ConfigError) as caught:
        parse(text, "my.toml")
    sentence = str(caught.value)
    assert expected in sentence
    assert sentence.startswith("my.toml: ")
    assert "\n" not in sentence or "TOML" in sentence
    assert sentence.endswith(".")


def test_a_missing_file_is_named_with_its_neighbour() -> None:
    with pytest.raises(ConfigError, match=r"no config file .*did you mean 'quickstart.toml'"):
        load(CONFIGS / "quikstart.toml")


def test_a_folder_or_a_binary_file_is_no_config(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a folder"):
        load(tmp_path)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="can't be read"):
        load(binary)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.name)
def test_every_config_of_the_library_is_valid(path: Path) -> None:
    config = load(path)
    assert config.params().n_legs == 8
    assert config.text == path.read_text()


def test_the_quickstart_covers_table_1_with_at_least_4096_samples() -> None:
    design = load(CONFIGS / "quickstart.toml").design
    assert design is not None
    assert design.size >= 4096
    assert set(design.names) == {"damping", "stiffness", "natural_length", "slope"}
    for name, (_, values) in design.coordinates().items():
        assert values.min() <= float(getattr(WheelParams(), name)) <= values.max()


def test_table_1_as_a_config_is_the_default_wheel() -> None:
    told, default = load(CONFIGS / "table1.toml").params(), WheelParams()
    for name in PARAMETER_NAMES:
        assert float(getattr(told, name)) == float(getattr(default, name))


def test_an_empty_config_is_table_1() -> None:
    assert parse("") == Config(name="config")


def test_an_axis_is_a_list_or_from_to_count() -> None:
    design = parse(
        "[grid]\ndamping = [1.0, 5.0, 2.0]\nslope = { from = 0.1, to = 0.3, count = 3 }"
    ).design
    assert design is not None
    np.testing.assert_array_equal(design.values["damping"], [1.0, 5.0, 2.0])
    np.testing.assert_allclose(design.values["slope"], [0.1, 0.2, 0.3])


@pytest.mark.parametrize("kind", ["sobol", "uniform"])
def test_drawn_samples_are_reproduced_by_their_seed_and_stay_in_their_box(kind: str) -> None:
    def draw(seed: int) -> np.ndarray:
        text = f"[{kind}]\nn = 100\nseed = {seed}\ndamping = [100.0, 200.0]\nslope = [0.2, 0.3]"
        design = parse(text).design
        assert design is not None
        return np.stack(list(design.values.values()))

    assert draw(1).shape == (2, 100)
    np.testing.assert_array_equal(draw(1), draw(1))
    assert not np.array_equal(draw(1), draw(2))
    assert np.all((draw(1) >= [[100.0], [0.2]]) & (draw(1) <= [[200.0], [0.3]]))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("damping", "has no '='"),
        ("dampin=3", "did you mean 'damping'"),
        ("damping=much", "must be a finite number"),
        ("damping=-3", "must lie in"),
        ("n_legs=8.5", "whole number"),
    ],
)
def test_a_mistake_in_an_assignment_gets_one_sentence(text: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        assignment(text)
    assert expected in str(caught.value)


def test_an_assignment_changes_one_parameter() -> None:
    assert assignment("damping = 150") == ("damping", 150.0)
    assert assignment("n_legs=10") == ("n_legs", 10)
