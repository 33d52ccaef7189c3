"""Without llvmlite XLA computes the same; a request for machine code names the missing library."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import vrw_jax as vrw

PROGRAM = """
import json, sys
sys.modules["llvmlite"] = sys.modules["llvmlite.ir"] = sys.modules["llvmlite.binding"] = None
import numpy as np
import vrw_jax as vrw
from vrw_jax import lanes
vrw.start_jax(sys.argv[1])
params, start = vrw.WheelParams(), vrw.paper_start()
wheels = vrw.WheelParams(damping=np.array([150.0, 200.0]))
results = {
    "section_state": vrw.return_map(params, start).tolist(),
    "period": float(vrw.limit_cycle(params).period),
    "section_states": vrw.step_batch(wheels, np.tile(start, (2, 1))).section_state.tolist(),
    "branch": vrw.continue_branch(params, "damping", (199.5, 200.5)).dataset.speed.values.tolist(),
    "is_available": lanes.is_machine_code_available(),
}
try:
    vrw.step(params, start, engine="lanes")
except ValueError as error:
    results["engine"] = str(error)
print(json.dumps(results))
"""


def test_the_library_is_imported_without_llvmlite_and_names_it():
    hide = "import sys; sys.modules.update(dict.fromkeys(('llvmlite', 'llvmlite.ir', "
    check = hide + "'llvmlite.binding'))); import vrw_jax.lanes as lanes; "
    check += "import jax; assert not lanes.is_machine_code_available(); "
    check += "lanes.machine_code.write_llvm_kernel(jax.make_jaxpr(lambda x: x)(1.0), 4)"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.run(
        [sys.executable, "-c", check], env=environment, capture_output=True, text=True
    )
    message = "ImportError: machine code needs llvmlite, which is not installed: pip install it."
    assert process.stderr.endswith(message + "\n")


@pytest.mark.slow
def test_the_library_computes_without_llvmlite():
    """Reference: machine code, to the tolerance of a step."""
    cache = os.environ.get("VRW_TEST_CACHE", ".jax_cache")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.run(
        [sys.executable, "-c", PROGRAM, cache], env=environment, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr[-2000:]
    results, params, start = json.loads(process.stdout), vrw.WheelParams(), vrw.paper_start()
    wheels = vrw.WheelParams(damping=np.array([150.0, 200.0]))
    assert_close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)
    assert not results["is_available"]
    assert_close(results["section_state"], vrw.return_map(params, start))
    assert_close(results["period"], vrw.limit_cycle(params).period)
    section_states = vrw.step_batch(wheels, np.tile(start, (2, 1))).section_state
    assert_close(results["section_states"], section_states)
    branch = vrw.continue_branch(params, "damping", (199.5, 200.5))
    assert_close(results["branch"], branch.dataset.speed)
    assert "llvmlite" in results["engine"]
