"""Explicit methods have diffrax's coefficients, and a step does not import diffrax."""

import json
import subprocess
import sys
from pathlib import Path

import diffrax
import numpy as np
import pytest

from vrw_jax.base.options import SOLVER_NAMES
from vrw_jax.flow import load_explicit_tableau, solver_steps


def read_tableau(name):
    """Return an entry of `tableaus.json`; None for methods that are not explicit."""
    solver_class = getattr(diffrax, name)
    given = getattr(solver_class, "tableau", None)
    if given is None or not hasattr(given, "a_lower"):
        return None
    if getattr(given, "a_diagonal", None) is not None and np.any(given.a_diagonal):
        return None
    return {
        "order": int(solver_class().order(None)),
        "a_lower": [list(map(float, row)) for row in given.a_lower],
        "b_sol": list(map(float, given.b_sol)),
        "b_error": list(map(float, given.b_error)),
        "ssal": bool(given.ssal),
    }


@pytest.mark.parametrize("name", SOLVER_NAMES)
def test_coefficients_equal_those_of_diffrax(name):
    parsed = json.loads(Path(solver_steps.__file__).with_name("tableaus.json").read_text())
    assert parsed.get(name) == read_tableau(name)
    assert (load_explicit_tableau(name) is None) == (read_tableau(name) is None)


def test_a_step_does_not_load_diffrax():
    code = (
        "import sys, vrw_jax as vrw; vrw.start_jax();"
        "vrw.return_map(vrw.WheelParams(), vrw.paper_start());"
        "sys.exit('diffrax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
