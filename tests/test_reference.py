"""Every public name documents its arguments, result and errors, with an example that runs."""

import contextlib
import doctest
import inspect
import operator
import re
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from support.slow_variants import make_params_with_slow_marks

import vrw_jax as vrw
from vrw_jax.hybrid import HybridSolution, Termination
from vrw_jax.wheel import PARAMETER_DOMAINS

ROOT = Path(__file__).parent.parent
NAMES = [name for name in vrw.__all__ if name not in ("MEASURES", "parameter_sets", "plot")]
FIGURE_FUNCTIONS = [
    f"plot.{name}"
    for name, thing in vars(vrw.plot).items()
    if inspect.isfunction(thing) and thing.__module__.startswith("vrw_jax.plot")
]
SLOW_EXAMPLES = {
    "plot.branch_figure", "plot.scan_figures", "plot.map_figure", "plot.tuning_figure",
    "UnilateralWheel", "UnilateralStep", "LadderWheel", "LadderStep", "continue_branches",
    "continue_special_point", "SpecialPointCurve",
    "measure_to_tolerance", "MeasureResult", "multifidelity_mean", "MultifidelityMean",
    "gait_sensitivity", "GaitSensitivity", "measure_gait_sensitivity",
    "smallest_disturbance", "phase_response", "PhaseResponse", "tune", "TuneResult",
    "ReturnMapCycle", "compare_laws", "OptimumCurve",
    "WheelObjective", "measure_basins", "FirstPassage", "SmallestDisturbance",
}  # fmt: skip
"""Names whose examples compile for a minute, or compute for seconds what other tests cover."""


def get_documentation(name):
    return inspect.getdoc(operator.attrgetter(name)(vrw)) or ""


@pytest.mark.parametrize(
    "name", make_params_with_slow_marks([*NAMES, *FIGURE_FUNCTIONS], SLOW_EXAMPLES)
)
def test_the_example_of_a_public_name_runs_unchanged(name, monkeypatch):
    text = get_documentation(name)
    monkeypatch.setattr(vrw, "start_jax", lambda *_: None)  # it has started
    globs = {"jax": jax, "jnp": jnp, "np": np, "xr": xr, "vrw": vrw}
    globs |= {"tempfile": tempfile, "Path": Path}
    if name == "explore":
        pytest.importorskip("anywidget")
    test = doctest.DocTestParser().get_doctest(text, globs, name, None, 0)
    assert test.examples, f"{name} has no example"
    out: list[str] = []
    with contextlib.suppress(doctest.UnexpectedException):
        doctest.DocTestRunner(verbose=False).run(test, out=out.append, clear_globs=False)
    assert not out, "".join(out)


@pytest.mark.parametrize("name", [*NAMES, *FIGURE_FUNCTIONS])
def test_every_argument_and_field_of_a_public_name_is_documented(name):
    thing, text = operator.attrgetter(name)(vrw), get_documentation(name)
    given = [] if name == "Outcome" else list(inspect.signature(thing).parameters)
    if inspect.isfunction(thing):
        section = text.partition("Args:")[2].partition("\n\n")[0]
        assert [n for n in given if not re.search(rf"^ +\*{{0,2}}{n}: ", section, re.M)] == []
        assert "Returns:\n" in text
        assert not given or "Raises:\n" in text or name in FIGURE_FUNCTIONS
    else:
        assert [n for n in given if f"`{n}`" not in text] == []


def test_every_public_name_is_in_the_reference():
    pages = "".join(path.read_text() for path in (ROOT / "docs" / "reference").glob("*.md"))
    documented_names = set(re.findall(r"^::: vrw_jax\.(\w+)$", pages, re.M))
    assert set(NAMES) | {"MEASURES", "parameter_sets"} == documented_names
    documented_figures = set(re.findall(r"^::: vrw_jax\.figures\.(\w+)$", pages, re.M))
    assert {name.removeprefix("plot.") for name in FIGURE_FUNCTIONS} == documented_figures


def test_the_reference_shows_existing_names_and_the_result_of_a_hybrid_simulation():
    page = (ROOT / "docs" / "reference" / "methods.md").read_text()
    shown = re.findall(r"^::: vrw_jax\.([\w.]+)$", page, re.M)
    things = [operator.attrgetter(name)(vrw) for name in shown]
    assert HybridSolution in things
    assert all(map(inspect.getdoc, things))


def test_documentation_of_wheel_fields_agrees_with_their_domains():
    for name, d in PARAMETER_DOMAINS.items():
        assert f"- `{name}`: {d.symbol}, {d.description}, in {d};" in get_documentation(
            "WheelParams"
        )


@pytest.mark.parametrize("kind", [vrw.Outcome, Termination])
def test_every_code_has_its_sentence_and_a_remedy(kind):
    page = (ROOT / "docs" / "sharp_bits.md").read_text()
    for code in kind:
        row_start = f"| {code.value} `{code.name}` | {code.meaning} | "
        assert len(page.partition(row_start)[2].partition(" |\n")[0]) > 5, code
