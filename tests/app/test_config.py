"""Configs: what stands in the files of the library is right, and every mistake gets a sentence."""

from pathlib import Path

import numpy as np
import pytest

from vrw_jax.app.config import Config, assignment, load, parse
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams

CONFIGS = Path(__file__).parents[2] / "configs"


def test_a_missing_file_is_named_with_its_neighbour() -> None:
    with pytest.raises(ValueError, match=r"no config file .*did you mean 'quickstart.toml'"):
        load(CONFIGS / "quikstart.toml")


def test_a_folder_or_a_binary_file_is_no_config(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is a folder"):
        load(tmp_path)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="can't be read"):
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


def test_an_assignment_changes_one_parameter() -> None:
    assert assignment("damping = 150") == ("damping", 150.0)
    assert assignment("n_legs=10") == ("n_legs", 10)
