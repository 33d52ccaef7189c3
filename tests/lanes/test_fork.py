"""A forked child that needs JAX's threads gets an error of one sentence and does not block."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import vrw_jax as vrw

HOWTO = Path(__file__).parents[2] / "docs" / "howto" / "processes.md"

CALLS = {
    "step": "vrw.step(params, start)",
    "walk": "vrw.walk(params, start, 2)",
    "return_map": "vrw.return_map(params, start)",
    "simulate": "vrw.simulate(params)",
    "step_batch": "vrw.step_batch(params, np.asarray(start)[None])",
    "limit_cycle": "vrw.limit_cycle(params)",
    "limit_cycles": "vrw.limit_cycles(several)",
    "sensitivities": "vrw.sensitivities(params)",
    "measure_to_tolerance": "vrw.measure_to_tolerance('speed', params, 1e-3, friction=20.0)",
    "multifidelity_mean": "vrw.multifidelity_mean('speed', several, 1e-3, friction=20.0)",
    "scan": "vrw.scan(vrw.grid(damping=[150.0]), ['speed'])",
    "basin": "vrw.basin(params, {'theta_post_impact': [-0.6], 'dtheta_post_impact': [1.0]})",
    "tune": "vrw.tune(params, 'speed', ['damping'], {'damping': (100.0, 300.0)})",
    "continue_branch": "vrw.continue_branch(params, 'damping', (150.0, 230.0))",
    "continue_map": "vrw.continue_map(lambda x, p: p * x * (1 - x), [0.5], 2.5, (2.0, 3.5))",
    "solve_fixed_point": "vrw.solve_fixed_point(lambda x: 0.5 * x, [0.5])",
    "choose_model": "vrw.choose_model(params, start)",
    "WheelParams": "vrw.WheelParams(damping=150.0)",
    "simulate_hybrid": "hybrid.simulate_hybrid(modes, [1.0, 0.0], events=1)",
    "start_jax": "vrw.start_jax()",
}

PROGRAM = """
import json, multiprocessing, sys, warnings
import numpy as np, jax
import vrw_jax as vrw
from vrw_jax import hybrid

def call(text):
    try:
        eval(text, globals())
    except BaseException as error:
        return type(error).__name__, str(error)
    return "", ""

def child(queue, text):
    queue.put(call(text))

if __name__ == "__main__":
    warnings.simplefilter("ignore")  # JAX's own, in the parent
    falls = hybrid.Mode(lambda y: jax.numpy.stack([y[1], -9.81]), (
        hybrid.Guard(lambda y: y[0], lambda y: y),))
    modes = (falls,)
    if sys.argv[1] == "arrays":
        start, params = vrw.paper_start(), vrw.WheelParams()
        several = vrw.WheelParams(damping=np.linspace(100.0, 200.0, 3))
        jax.numpy.ones(3).block_until_ready()
    context, told = multiprocessing.get_context("fork"), {}
    for name, text in json.loads(sys.argv[2]).items():
        queue = context.SimpleQueue()
        process = context.Process(target=child, args=(queue, text))
        process.start()
        process.join(float(sys.argv[3]))
        told[name] = queue.get() if not queue.empty() else ("waits", "")
        process.kill()
    print(json.dumps(told))
"""


def fork(parent, calls, seconds, tmp_path):
    """Return the result of each call in a forked child, from a parent with or without arrays."""
    place = tmp_path / "parent.py"
    place.write_text(PROGRAM)
    results = subprocess.run(
        [sys.executable, place, parent, json.dumps(calls), str(seconds)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, capture_output=True, text=True,
    )  # fmt: skip
    assert results.returncode == 0, results.stderr
    return json.loads(results.stdout)


@pytest.fixture(scope="module")
def children(tmp_path_factory):
    return fork("arrays", CALLS, 20, tmp_path_factory.mktemp("fork"))


@pytest.mark.parametrize("name", CALLS)
def test_a_forked_child_is_told_to_be_spawned(children, name):
    kind, sentence = children[name]
    assert kind == "RuntimeError", (kind, sentence)
    assert sentence.startswith("this process was forked after JAX had made an array")
    assert 'get_context("spawn") or "forkserver"' in sentence
    assert sentence.endswith(".")


def test_a_child_forked_before_any_array_computes(tmp_path):
    calls = {"arithmetic": "float(vrw.WheelParams(damping=150.0).damping)"}
    assert fork("none", calls, 60, tmp_path) == {"arithmetic": ["", ""]}


@pytest.mark.slow
def test_the_how_to_runs_as_a_file_and_prints_what_it_says(tmp_path):
    """Reference: the gaits' periods, computed one by one in this process."""
    code, results = re.search(
        r"```python\n(.*?)```\n\n```text\n(.*?)```", HOWTO.read_text(), re.S
    ).groups()
    (tmp_path / "spawned.py").write_text(code)
    run = subprocess.run(
        [sys.executable, tmp_path / "spawned.py"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert run.stdout == results
    periods = [float(vrw.limit_cycle(vrw.WheelParams(damping=c)).period) for c in (120.0, 150.0)]
    assert [round(period, 3) for period in periods] == json.loads(results)
