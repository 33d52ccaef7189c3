"""`vrw.explore`: Python reads and sets the parameters of the displayed wheel."""

import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import vrw_jax as vrw
from vrw_jax.app.commands import app


@pytest.fixture
def widget():
    pytest.importorskip("anywidget", reason="widgets are anywidget's")
    return vrw.explore(vrw.WheelParams(damping=150.0, n_legs=10), friction=0.8)


def test_parameters_are_read_and_set(widget):
    assert float(widget.params.damping) == 150.0
    assert widget.params.n_legs == 10
    assert widget.friction == 0.8
    widget.values = {**widget.values, "damping": 170.0}  # as the page does when a slider moves
    assert float(widget.params.damping) == 170.0
    widget.params = vrw.WheelParams(slope=0.28)
    assert widget.values["slope"] == 0.28
    assert widget.values["n_legs"] == 8
    assert widget.friction == 0.8
    widget.friction = 0.7
    assert widget.values["friction"] == 0.7
    assert widget.model_name == "viscoelastic"
    widget.model_name = "rigid"
    widget.params = vrw.WheelParams(slope=0.2)
    assert widget.values["rung"] == "rigid"


def test_the_widget_contains_the_page(widget):
    assert widget.page.startswith("<!doctype html>")
    assert 'id="code"' in widget.page


def grid(**outside):
    damping, slope = np.linspace(100.0, 200.0, 3), np.linspace(0.28, 0.32, 2)
    speed = np.arange(6.0).reshape(3, 2)
    speed[0, 0] = np.nan
    dims = ("damping", "slope")
    force = xr.DataArray(np.arange(36.0).reshape(3, 2, 6), dims=(*dims, "leg"))
    return xr.Dataset(
        {
            "speed": (dims, speed),
            "locked_stopper_force": force,
            "outcome": (dims, np.zeros((3, 2), int)),
        },
        coords={"damping": damping, "slope": slope, **outside},
    )


def test_a_dataset_becomes_the_map():
    pytest.importorskip("anywidget", reason="widgets are anywidget's")
    page_map = vrw.explore(dataset=grid()).map
    assert [axis["name"] for axis in page_map["axes"]] == ["damping", "slope"]
    assert page_map["measures"]["speed"] == [
        [None, 2.0, 4.0],
        [1.0, 3.0, 5.0],
    ]  # rows: of the slope
    assert page_map["measures"]["locked_stopper_force"][0] == [
        0.0,
        12.0,
        24.0,
    ]  # least of the legs
    with pytest.raises(ValueError, match="two parameters: give a scan"):
        vrw.explore(dataset=grid().isel(slope=0))


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"params": vrw.WheelParams(damping=np.ones(3))}, "show one after the other"),
        ({"friction": -1.0}, "a coefficient of friction is at least 0"),
        ({"height": 0}, "height"),
        ({"model_name": "rigit"}, "did you mean 'rigid'|must be one of"),
    ],
)
def test_invalid_arguments_of_explore_are_refused_in_one_sentence(wrong, sentence):
    with pytest.raises((TypeError, ValueError), match=sentence):
        vrw.explore(**wrong)


def test_a_missing_anywidget_is_reported_with_the_install_command(monkeypatch):
    from vrw_jax.app import explorer

    monkeypatch.setitem(sys.modules, "anywidget", None)
    explorer._make_widget_class.cache_clear()
    with pytest.raises(ImportError, match=r"pip install 'vrw-jax\[explore\]'"):
        vrw.explore()
    explorer._make_widget_class.cache_clear()


def test_the_documentation_page_of_explore_runs_unchanged():
    pytest.importorskip("anywidget", reason="widgets are anywidget's")
    text = (Path(__file__).parents[2] / "docs" / "explore.md").read_text()
    known_by_name = {}
    exec(re.search(r"```python\n(.*?)```", text, re.DOTALL)[1], known_by_name)
    assert float(known_by_name["wheel"].params.damping) == 160.0
    assert int(known_by_name["cycle"].outcome) == vrw.Outcome.STEPPED


@pytest.mark.parametrize(
    ("arguments", "values"),
    [
        ((), {}),
        (("--set", "damping=150", "--set", "n_legs=6"), {"damping": ["150.0"], "n_legs": ["6"]}),
        (("--model", "rigid"), {"rung": ["rigid"]}),
    ],
)
def test_the_command_opens_the_page_at_an_address_that_holds_the_wheel(
    arguments, values, monkeypatch
):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    result = CliRunner().invoke(app, ["explore", *arguments])
    assert result.exit_code == 0
    assert opened == [result.output.strip()]
    address = urlsplit(opened[0])
    assert address.path.endswith("wheel.html")
    assert parse_qs(address.fragment) == values


def test_import_of_the_library_does_not_import_the_widget():
    code = "import sys, vrw_jax; assert not {'anywidget', 'ipywidgets'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
