"""A measure added as the how-to describes works everywhere that measures have names."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import vrw_jax as vrw

ROOT = Path(__file__).parent.parent.parent
HOWTO = ROOT / "docs" / "howto" / "add_a_measure.md"

USE = """
import json, sys
import numpy as np
import pytest
import vrw_jax as vrw

vrw.start_jax(sys.argv[1])
name, wheel = "cost_of_transport", vrw.WheelParams(damping=150.0)
table = vrw.sensitivities(wheel, measures=["speed", name])
scan = vrw.scan(vrw.grid(damping=[140.0, 150.0]), [name])
branch = vrw.continue_branch(wheel, "slope", (0.29, 0.31))
bounds = {"slope": (0.28, 0.32)}
least = vrw.tune(wheel, {name: -1.0}, ["slope"], bounds, {"speed": 0.1})
kept = vrw.tune(wheel, "speed", ["slope"], bounds, {name: (None, 53.0)})
print(json.dumps({
    "value": float(table.value[1]),
    "by_slope": float(table.derivative.sel(measure=name, parameter="slope")),
    "scan": scan[name].values.tolist(),
    "scan_unit": scan[name].attrs["units"],
    "slopes": branch.values.tolist(),
    "branch": branch.dataset[name].values.tolist(),
    "least": [float(least.params.slope), -least.value],
    "kept": float(kept.params.slope),
    "held_by": [active.name for active in kept.active],
}))
"""

CALL_TEST = "\ntest_the_cost_of_transport_is_the_weight_times_the_sine_of_the_slope()\n"
"""Call of the test that the page shows."""


def changed(source: str, change: str) -> str:
    """Return the source with the lines of a change that begin with + inserted below the others."""
    lines = change.splitlines(keepends=True)
    below = "".join(line[1:] for line in lines if line.startswith(" "))
    added = "".join(line[1:] for line in lines if line.startswith("+"))
    assert source.count(below) == 1, f"the how-to's context is not there once: {below}"
    return source.replace(below, below + added)


@pytest.mark.slow
def test_a_measure_added_by_the_how_to_works_wherever_measures_are_named(tmp_path):
    """In a steady gait the energy lost per distance is the weight times the slope's sine."""
    shutil.copytree(ROOT / "vrw_jax", tmp_path / "vrw_jax")
    change, _, page_end = HOWTO.read_text().partition("```diff\n")[2].partition("```")
    page_test = page_end.partition("```python\n")[2].partition("```")[0]
    for part in change.split("--- ")[1:]:
        path, _, lines = part.partition("\n")
        (tmp_path / path).write_text(changed((tmp_path / path).read_text(), lines))
    cache = os.environ.get("VRW_TEST_CACHE", str(ROOT / ".jax_cache"))
    program = USE + page_test + CALL_TEST
    run = subprocess.run(
        [sys.executable, "-c", program, cache], cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(tmp_path)}, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    printed, wheel = json.loads(run.stdout.splitlines()[-1]), vrw.WheelParams()
    weight = float((wheel.hub_mass + wheel.n_legs * wheel.leg_mass) * wheel.gravity)
    at = lambda slope: weight * np.sin(slope)
    np.testing.assert_allclose(printed["value"], at(0.3), rtol=1e-7)
    np.testing.assert_allclose(printed["by_slope"], weight * np.cos(0.3), rtol=1e-5)
    np.testing.assert_allclose(printed["scan"], at(0.3), rtol=1e-7)
    np.testing.assert_allclose(printed["branch"], at(np.array(printed["slopes"])), rtol=1e-7)
    np.testing.assert_allclose(printed["least"], [0.28, at(0.28)], rtol=1e-7)
    np.testing.assert_allclose(printed["kept"], np.arcsin(53.0 / weight), rtol=1e-5)
    assert printed["scan_unit"] == "N"
    assert printed["held_by"] == ["cost_of_transport"]
