"""Peers with a Python of their own, Drake and Siconos: asked once a run, told as rows of the table.

VRW_DRAKE and VRW_SICONOS say how to start that Python: `VRW_DRAKE=/opt/drake/bin/python`. Where one
is missing its rows say what Python said.
"""

import functools
import json
import math
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from experiments.atlas.results import Row, compute_error

ROOT = Path(__file__).parents[2]


@functools.cache
def _run_peer(name: str, *arguments: str) -> dict:
    start = shlex.split(os.environ.get(f"VRW_{name.upper()}", sys.executable))
    command = [*start, "-m", f"experiments.atlas.elsewhere.{name}", *arguments]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    if run.returncode:
        return {"version": "none", "says": f"not here: {run.stderr.strip().splitlines()[-1]}"}
    return json.loads(run.stdout.splitlines()[-1])


def make_rows(
    name: str, case: str, references: dict[str, float], *arguments: str, relative: bool = False
) -> Iterator[Row]:
    """Yield the results of `elsewhere/NAME` for the questions of a case, beside the references."""
    result = _run_peer(name, *arguments)
    answers = {a["name"]: a for a in result.get("answers", ()) if a["case"] == case}
    for question, reference in references.items():
        answer = answers.get(question, {"value": math.nan, "work": 0, "seconds": 0.0})
        solution = float(answer["value"])
        yield Row(
            question, name.capitalize(), solution, reference, compute_error(solution, reference,
            relative=relative),
            answer.get("says", result.get("says", "")), answer.get("admits", not answers),
            answer["work"], answer["seconds"], answer.get("options", result.get("options", "none")),
            result["version"],
        )  # fmt: skip
