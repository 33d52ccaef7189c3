"""Wrong uses of the command line print one sentence, exit with code 2, and write nothing."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from support.scanning import evaluate_arithmetically
from typer.testing import CliRunner

from vrw_jax.app.commands import app
from vrw_jax.studies import ScanPlan

WRONG_CONFIGS: dict[str, tuple[str, str]] = {
    "not TOML": ("[wheel", "not valid TOML"),
    "unknown table": ("[whel]\nslope = 0.3", "did you mean 'wheel'"),
    "table as value": ("wheel = 3", "must be a table"),
    "unknown parameter": ("[wheel]\ndampin = 3.0", "did you mean 'damping'"),
    "text for a number": ('[wheel]\ndamping = "much"', "must be a finite number"),
    "true for a number": ("[wheel]\ndamping = true", "must be a finite number"),
    "not finite": ("[wheel]\ndamping = nan", "must be a finite number"),
    "out of its domain": ("[wheel]\ndamping = -1.0", "must lie in [0, 1e+60) N s/m"),
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
    "empty axis": ("[grid]\ndamping = []", "has no values"),
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
    "no number of samples": ("[sobol]\ndamping = [1.0, 2.0]", "has no number of samples"),
    "range of three": ("[sobol]\nn = 4\ndamping = [1.0, 2.0, 3.0]", "range of two numbers"),
    "range upside down": ("[uniform]\nn = 4\ndamping = [2.0, 1.0]", "holds nothing"),
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
    # name: text of the config, what the sentence holds
    "the paper's symbol": ("[wheel]\nc = 100.0", "c is called damping: write damping"),
    "the paper's symbol swept": ("[grid]\nL0 = [1.0, 1.1]", "L0 is called locked_length"),
    "a table twice": ("[wheel]\n[wheel]", "not valid TOML"),
    "a value without quotes": ("[options]\nsolver = Dopri8", "not valid TOML"),
    "a number with a comma": ("[wheel]\ndamping = 1,5", "not valid TOML"),
    "a table of tables": ("[[grid]]\ndamping = [1.0]", "must be a table"),
    "a table in capitals": ("[Wheel]\nslope = 0.3", "did you mean 'wheel'"),
    "infinite": ("[wheel]\nstiffness = inf", "must be a finite number"),
    "a list for a number": ("[wheel]\nslope = [0.3]", "must be a finite number"),
    "a slope too steep": ("[wheel]\nslope = 1.6", "must lie in"),
    "less than no mass": ("[wheel]\nhub_mass = -1.0", "must lie in"),
    "a spring that pulls": ("[wheel]\nstiffness = -500.0", "must lie in"),
    "legs as text": ('[wheel]\nn_legs = "eight"', "whole number"),
    "legs yes": ("[wheel]\nn_legs = true", "whole number"),
    "a solver misspelt": ('[options]\nsolver = "Dopri9"', "solver is"),
    "a solver without an error": ('[options]\nsolver = "Euler"', "solver is"),
    "no time": ("[options]\nmax_phase_time = 0.0", "must be positive"),
    "part of a step": ("[options]\nmax_solver_steps = 2.5", "whole number"),
    "no events": ("[options]\nmax_event_iterations = 0", "at least 1"),
    "tolerance as text": ('[options]\nrtol = "1e-9"', "must be a finite number"),
    "tolerance true": ("[options]\natol = true", "must be a finite number"),
    "unknown model": ('[model]\nname = "unilaterl"', "did you mean 'unilateral'"),
    "model as number": ("[model]\nname = 2", "choose from viscoelastic"),
    "model as list": ('[model]\nname = ["rigid"]', "choose from viscoelastic"),
    "another model's setting": ('[model]\nname = "auto"\nstoppers = "one-sided"', "unknown key"),
    "a setting of unilateral contact": ("[model]\nmax_events = 5", "unknown key 'max_events'"),
    "stoppers of a third kind": (
        '[model]\nname = "unilateral"\nstoppers = "none"',
        "one of 'bilateral', 'one-sided'",
    ),
    "friction below zero": ('[model]\nname = "unilateral"\nfriction = -1.0', "must be positive"),
    "friction nan": ('[model]\nname = "auto"\nfriction = nan', "must be a finite number"),
    "friction as text": ('[model]\nfriction = "high"', "must be a finite number"),
    "no events on ground": ('[model]\nname = "unilateral"\nmax_events = 0', "at least 1"),
    "part of an event": ('[model]\nname = "unilateral"\nmax_events = 2.5', "whole number"),
    "a misspelt setting": ("[model]\nfricton = 0.5", "did you mean 'friction'"),
    "a switch as text": ('[model]\nstop_at_lift_off = "yes"', "true or false"),
    "friction swept, not used": ("[grid]\nfriction = [0.5, 0.7]", "does not affect this model"),
    "friction sampled, not used": (
        "[sobol]\nn = 4\nfriction = [0.5, 0.7]",
        "does not affect this model",
    ),
    "friction swept below zero": (
        '[model]\nname = "auto"\n[grid]\nfriction = [0.5, -0.7]',
        "must be positive",
    ),
    "a measure of another model": (
        '[model]\nname = "unilateral"\n[scan]\nmeasures = ["lambda_I4"]',
        "is no measure of a scan",
    ),
    "a measure of unilateral contact": ('[scan]\nmeasures = ["slip"]', "is no measure of a scan"),
    "a measure as number": ("[scan]\nmeasures = [3]", "list of names"),
    "a derivative by friction": (
        '[scan]\nmeasures = ["d speed / d friction"]',
        "must be by a parameter",
    ),
    "half a derivative": ('[scan]\nmeasures = ["d speed / damping"]', "is no measure of a scan"),
    "chunk as text": ('[scan]\nchunk = "large"', "whole number"),
    "a mesh as text": ('[scan]\nmesh_intervals = ["a", 8, 3]', 'mesh_intervals is "a"'),
    "a mesh of two phases": ("[scan]\nmesh_intervals = [10, 8]", "three whole numbers"),
    "part of a sample": ("[scan]\nchunk = 2.5", "whole number"),
    "n_legs swept": ("[grid]\nn_legs = [6, 8]", "unknown key 'n_legs'"),
    "an axis of text": ('[grid]\ndamping = ["much"]', "must be a finite number"),
    "an axis of lists": ("[grid]\ndamping = [[1.0]]", "must be a finite number"),
    "an axis too long": (
        "[grid]\ndamping = { from = 1.0, to = 2.0, count = 20000000000 }",
        "is the most",
    ),
    "half a value": ("[grid]\ndamping = { from = 1.0, to = 2.0, count = 2.5 }", "whole number"),
    "an axis that stands still": (
        "[grid]\ndamping = { from = 1.0, to = 1.0, count = 3 }",
        "holds a value twice",
    ),
    "an axis nowhere": ("[grid]\ndamping = { from = nan, to = 2.0, count = 3 }", "finite number"),
    "a sample out of its domain": ("[samples]\nslope = [0.3, 3.0]", "must lie in"),
    "no samples": ("[sobol]\nn = 0\ndamping = [1.0, 2.0]", "at least 1"),
    "too many samples": ("[sobol]\nn = 20000000000\ndamping = [1.0, 2.0]", "at most"),
    "rows that aren't balanced": ("[saltelli]\nn = 100\ndamping = [1.0, 2.0]", "powers of two"),
    "a range of one": ("[uniform]\nn = 4\ndamping = [1.0]", "range of two numbers"),
    "a range of none": ("[uniform]\nn = 4\ndamping = [2.0, 2.0]", "holds nothing"),
    "a seed as text": ('[sobol]\nn = 4\nseed = "x"\ndamping = [1.0, 2.0]', "at least 0"),
    "a box of nothing": ("[sobol]\nn = 4", "sweeps no parameter"),
    "steps as text": ('[gait]\nsteps = "ten"', "whole number"),
    "a start of text": ('[gait]\nstart = ["a", "b", "c"]', "must be a finite number"),
    "a start nowhere": ("[gait]\nstart = [nan, 1.0, 0.0]", "must be a finite number"),
    "unknown in gait": ("[gait]\nstep = 3", "did you mean 'steps'"),
    "nothing may move": ("[tune]", "has no free parameter"),
    "bounds as list": ("[tune]\nbounds = [1.0, 2.0]", "has no free parameter"),
    "bounds of what": ("[tune.bounds]\ndampin = [1.0, 2.0]", "did you mean 'damping'"),
    "bounds of one": ("[tune.bounds]\ndamping = [1.0]", "range of two numbers"),
    "bounds out of the domain": ("[tune.bounds]\nslope = [0.1, 2.0]", "must lie in"),
    "objective as number": ("[tune]\nobjective = 3\n[tune.bounds]\nslope = [0.2, 0.4]", "weights"),
    "weight as text": (
        '[tune]\nobjective = { speed = "much" }\n[tune.bounds]\nslope = [0.2, 0.4]',
        "finite number",
    ),
    "constraints as list": (
        '[tune]\nconstraints = ["speed"]\n[tune.bounds]\nslope = [0.2, 0.4]',
        "must be a table",
    ),
    "a limit as text": (
        '[tune.constraints]\nspeed = "high"\n[tune.bounds]\nslope = [0.2, 0.4]',
        "finite number",
    ),
    "no gaits to try": ("[tune]\nevaluations = 0\n[tune.bounds]\nslope = [0.2, 0.4]", "at least 1"),
    "unknown in tune": ("[tune]\nbound = 3", "did you mean 'bounds'"),
    "a branch along nothing": ("[branch]\nbounds = [1.0, 2.0]", "None is no parameter"),
    "a branch along what": ('[branch]\nparameter = "dampin"', "did you mean 'damping'"),
    "a branch along friction": (
        '[branch]\nparameter = "friction"\nbounds = [0.5, 1.0]',
        "a branch of this model runs along",
    ),
    "a branch without bounds": ('[branch]\nparameter = "damping"', "has no bounds"),
    "a branch upside down": (
        '[branch]\nparameter = "damping"\nbounds = [200.0, 100.0]',
        "holds nothing",
    ),
    "a branch of one bound": ('[branch]\nparameter = "damping"\nbounds = 200.0', "two numbers"),
    "a branch out of the domain": (
        '[branch]\nparameter = "slope"\nbounds = [0.1, 2.0]',
        "must lie in",
    ),
    "no period": ('[branch]\nparameter = "damping"\nbounds = [1.0, 2.0]\nperiod = 0', "at least 1"),
    "no step": (
        '[branch]\nparameter = "damping"\nbounds = [1.0, 2.0]\nmax_ds = 0.0',
        "be positive",
    ),
}

DIGITS = "9" * 400
WRONG_CONFIGS |= {
    f"400 digits for {key.replace(chr(10), ' ')}": (text, "must be")
    for key, text in {
        "damping": f"[wheel]\ndamping = {DIGITS}",
        "slope": f"[wheel]\nslope = -{DIGITS}",
        "n_legs": f"[wheel]\nn_legs = {DIGITS}",
        "friction": f'[model]\nname = "unilateral"\nfriction = {DIGITS}',
        "max_events": f'[model]\nname = "unilateral"\nmax_events = {DIGITS}',
        "rtol": f"[options]\nrtol = {DIGITS}",
        "max_solver_steps": f"[options]\nmax_solver_steps = {DIGITS}",
        "solver": f"[options]\nsolver = {DIGITS}",
        "steps": f"[gait]\nsteps = {DIGITS}",
        "start": f"[gait]\nstart = [{DIGITS}, 0, 0]",
        "chunk": f"[scan]\nchunk = {DIGITS}",
        "tol": f"[scan]\ntol = {DIGITS}",
        "an axis": f"[grid]\ndamping = [{DIGITS}]",
        "from": f"[grid]\ndamping = {{ from = {DIGITS}, to = 2.0, count = 3 }}",
        "count": f"[grid]\ndamping = {{ from = 1.0, to = 2.0, count = {DIGITS} }}",
        "n": f"[sobol]\nn = {DIGITS}\ndamping = [1.0, 2.0]",
        "seed": f"[sobol]\nn = 4\nseed = {DIGITS}\ndamping = [1.0, 2.0]",
        "a range": f"[uniform]\nn = 4\ndamping = [1.0, {DIGITS}]",
        "objective": f"[tune]\nobjective = {DIGITS}\n[tune.bounds]\nslope = [0.2, 0.4]",
        "a weight": f"[tune.objective]\nspeed = {DIGITS}\n[tune.bounds]\nslope = [0.2, 0.4]",
        "evaluations": f"[tune]\nevaluations = {DIGITS}\n[tune.bounds]\nslope = [0.2, 0.4]",
        "period": f'[branch]\nparameter = "slope"\nbounds = [0.2, 0.3]\nperiod = {DIGITS}',
        "max_ds": f'[branch]\nparameter = "slope"\nbounds = [0.2, 0.3]\nmax_ds = {DIGITS}',
        "9,000 hexadecimal": f"[wheel]\ndamping = 0x{'f' * 9000}",
    }.items()
}
WRONG_CONFIGS |= {
    "400 digits for parameter": (f"[branch]\nparameter = {DIGITS}", "is no parameter"),
    "more digits than Python reads": (f"[wheel]\ndamping = {DIGITS * 20}", "more digits"),
    "deeply nested": (f"[wheel]\ndamping = {'[' * 3000}{']' * 3000}", "too deeply"),
    "nested": (f"[wheel]\ndamping = {'[' * 90}{']' * 90}", "must be a finite number"),
    "as many legs as there are numbers": ("[wheel]\nn_legs = 1000000000", "at most 1,000"),
}

GRID_TABLE = "[grid]\ndamping = [100.0, 150.0]\n"
TUNE_TABLE = '[tune]\nobjective = "{}"\n[tune.bounds]\n{}\n'
BRANCH_TABLE = '[branch]\nparameter = "damping"\nbounds = [{}]\n'
BOUNDS_LINE = "damping = [20.0, 215.0]"

WRONG_COMMANDS: dict[str, tuple[tuple[str, ...], str, str]] = {
    # name: arguments, text of my.toml, what the sentence holds
    "missing config": (("scan", "nowhere.toml"), "", "no config file nowhere.toml"),
    "misspelt config": (("scan", "mi.toml"), "", "did you mean 'my.toml'"),
    "a folder as config": (("scan", "."), "", "is a folder"),
    "a picture as config": (("gait", "letter.bin"), "", "can't be read"),
    "a missing folder": (("tune", "nowhere/my.toml"), "", "no config file"),
    "no design": (("scan", "my.toml"), "[wheel]\nslope = 0.3", "a scan needs a design"),
    "an empty config to scan": (("scan", "my.toml"), "", "a scan needs a design"),
    "nothing to tune": (("tune", "my.toml"), GRID_TABLE, "tuning needs an objective"),
    "nothing to follow": (("continue", "my.toml"), GRID_TABLE, "continuation needs a parameter"),
    "no assignment": (("gait", "--set", "damping"), "", "has no '='"),
    "an empty assignment": (("gait", "--set", "damping="), "", "must be a finite number"),
    "a nameless assignment": (("gait", "--set", "=3"), "", "unknown key ''"),
    "the paper's symbol": (("gait", "--set", "c=100"), "", "c is called damping: write damping"),
    "unknown parameter": (("gait", "--set", "dampin=3"), "", "did you mean 'damping'"),
    "text for a parameter": (("gait", "--set", "damping=much"), "", "must be a finite number"),
    "a complex parameter": (("gait", "--set", "damping=1+2j"), "", "must be a finite number"),
    "a parameter nan": (("gait", "--set", "damping=nan"), "", "must be a finite number"),
    "out of its domain": (("gait", "--set", "damping=-3"), "", "must lie in"),
    "mass beyond the hub": (("gait", "--set", "leg_com=1.5"), "", "leg_com < locked_length"),
    "half a leg": (("gait", "--set", "n_legs=8.5"), "", "whole number"),
    "three legs": (("gait", "--set", "n_legs=3"), "", "at least 5"),
    "a file as folder": (("scan", "my.toml", "--out", "letter.txt"), GRID_TABLE, "letter.txt"),
    "a place of the system": (("scan", "my.toml", "--out", "/proc/x"), GRID_TABLE, "/proc/x"),
    "a place below a file": (
        ("scan", "my.toml", "--out", "letter.txt/x"),
        GRID_TABLE,
        "letter.txt/x",
    ),
    "no place to tune": (
        ("tune", "my.toml", "--out", "/proc/x"),
        TUNE_TABLE.format("speed", BOUNDS_LINE),
        "/proc/x",
    ),
    "no place to follow": (
        ("continue", "my.toml", "--out", "/proc/x"),
        BRANCH_TABLE.format("100.0, 200.0"),
        "/proc/x",
    ),
    "no place to reproduce": (("reproduce", "--out", "/proc/x"), "", "/proc/x"),
    "no place for examples": (("init", "/proc/x"), "", "/proc/x"),
    "examples that differ": (("init", "mine"), "", "is there already and differs"),
    "no scan there": (("scan", "my.toml", "--out", "occupied"), GRID_TABLE, "no scan's store"),
    "another's store": (("scan", "my.toml", "--out", "other"), GRID_TABLE, "but not a scan's"),
    "a torn store": (("scan", "my.toml", "--out", "torn"), GRID_TABLE, "no scan's store"),
    "no store to verify": (("scan", "my.toml", "--verify"), GRID_TABLE, "no store"),
    "no scheduler": (
        ("scan", "my.toml", "--dask", "nowhere://"),
        GRID_TABLE,
        "no dask scheduler answers",
    ),
    "a solver misspelt": (
        ("scan", "my.toml"),
        GRID_TABLE + '[options]\nsolver = "Dopri9"',
        "solver is",
    ),
    "too large a grid": (
        ("scan", "my.toml"),
        "[grid]\n"
        + "".join(
            f"{name} = {{ from = 0.3, to = 0.4, count = 1000000 }}\n"
            for name in ("slope", "leg_com")
        ),
        "but a scan takes",
    ),
    "too large a grid to explain": (
        ("scan", "my.toml", "--explain"),
        "[grid]\n"
        + "".join(
            f"{name} = {{ from = 0.3, to = 0.4, count = 1000000 }}\n"
            for name in ("slope", "leg_com")
        ),
        "but a scan takes",
    ),
    "rigid legs scanned": (
        ("scan", "my.toml"),
        GRID_TABLE + '[model]\nname = "rigid"',
        "this command takes viscoelastic",
    ),
    "a map of unilateral contact": (
        ("map", "my.toml"),
        GRID_TABLE + '[model]\nname = "unilateral"',
        "this command takes viscoelastic: write that",
    ),
    "a map over one parameter": (
        ("map", "my.toml"),
        "[grid]\ndamping = [150.0, 200.0]",
        "a map is a grid over two parameters",
    ),
    "a map of samples": (
        ("map", "my.toml"),
        "[uniform]\nn = 4\ndamping = [150.0, 200.0]\nslope = [0.28, 0.3]",
        "a map is a grid over two parameters",
    ),
    "rigid legs tuned": (
        ("tune", "my.toml"),
        TUNE_TABLE.format("speed", BOUNDS_LINE) + '[model]\nname = "rigid"',
        "takes viscoelastic",
    ),
    "the ladder tuned": (
        ("tune", "my.toml"),
        TUNE_TABLE.format("speed", BOUNDS_LINE) + '[model]\nname = "auto"',
        "takes viscoelastic",
    ),
    "the ladder followed": (
        ("continue", "my.toml"),
        BRANCH_TABLE.format("100.0, 300.0") + '[model]\nname = "auto"',
        "takes viscoelastic",
    ),
    "an objective of nothing": (
        ("tune", "my.toml"),
        TUNE_TABLE.format("sped", BOUNDS_LINE),
        "did you mean 'speed'",
    ),
    "an objective with legs": (
        ("tune", "my.toml"),
        TUNE_TABLE.format("locked_stopper_force", BOUNDS_LINE),
        "one value for each locked leg",
    ),
    "an objective of another model": (
        ("tune", "my.toml"),
        TUNE_TABLE.format("slip", BOUNDS_LINE),
        "is no measure for objective",
    ),
    "bounds that hold nothing": (
        ("tune", "my.toml"),
        TUNE_TABLE.format("speed", "damping = [215.0, 20.0]"),
        "holds nothing",
    ),
    "a start outside its bounds": (
        ("tune", "my.toml"),
        TUNE_TABLE.format("speed", "damping = [20.0, 100.0]"),
        "outside its bounds",
    ),
    "a constraint on nothing": (
        ("tune", "my.toml"),
        TUNE_TABLE.format("speed", BOUNDS_LINE) + "[tune.constraints]\nclearence = 0.0",
        "no measure for a constraint",
    ),
    "results at a URL": (("scan", "my.toml", "--out", "s3://wheels"), GRID_TABLE, "a URL"),
    "figures at a URL": (("reproduce", "--out", "gs://wheels"), GRID_TABLE, "a URL"),
    "examples at a URL": (("init", Path("/wheels").as_uri()), GRID_TABLE, "a URL"),
    "a config at a URL": (("gait", "https://wheels.org/my.toml"), GRID_TABLE, "a URL"),
    "results in nobody's home": (
        ("tune", "my.toml", "--out", "~nobody_of_this_name/x"),
        TUNE_TABLE.format("speed", BOUNDS_LINE),
        "there is no such user",
    ),
    "the sensitivity of legs in turn": (
        ("robustness", "my.toml"),
        '[scan]\nslope_sd = 0.01\n[model]\nleg_force = "legs.py:legs"',
        "the legs alternate, but gait sensitivity norms are those of gaits of one step",
    ),
    "the simplest model of legs in turn": (
        ("gait", "my.toml"),
        '[model]\nname = "auto"\nleg_force = "legs.py:legs"',
        'the legs alternate, but model "auto"',
    ),
    "a step beyond the range": (
        ("continue", "my.toml"),
        BRANCH_TABLE.format("4.0, 230.0") + "max_ds = 5.0",
        "max_ds",
    ),
}


LEGS_IN_TURN = """
import vrw_jax as vrw
legs = vrw.AlternatingLegs(vrw.SpringDamper(damping=150.0), vrw.SpringDamper(damping=170.0))
"""


@pytest.fixture
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place with a letter, and with what is no store; a second is enough for a scheduler."""
    monkeypatch.setattr(ScanPlan, "build_scan_engine", lambda _: evaluate_arithmetically)
    monkeypatch.setattr("vrw_jax.studies.scan_execution.DASK_SCHEDULER_TIMEOUT", "1s")
    monkeypatch.chdir(tmp_path)
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", cache)
    (tmp_path / "letter.txt").write_text("dear reader")
    (tmp_path / "legs.py").write_text(LEGS_IN_TURN)
    (tmp_path / "letter.bin").write_bytes(b"\xff\xfe\x00")
    for place in ("occupied", "other", "torn"):
        (tmp_path / place / "scan.zarr").mkdir(parents=True)
        (tmp_path / place / "scan.zarr" / "letter.txt").write_text("dear reader")
    group = '{"attributes": {}, "zarr_format": 3, "node_type": "group"}'
    (tmp_path / "other" / "scan.zarr" / "zarr.json").write_text(group)
    (tmp_path / "torn" / "scan.zarr" / "zarr.json").write_text(group[:20])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "quickstart.toml").write_text("# mine")
    return tmp_path


def list_files(working_folder: Path) -> dict[Path, bytes]:
    return {
        path: path.read_bytes() if path.is_file() else b"" for path in working_folder.rglob("*")
    }


def assert_refused(arguments: tuple[str, ...], expected: str, working_folder: Path) -> str:
    """Require that a command prints the sentence and writes nothing; return the sentence."""
    before = list_files(working_folder)
    error_text = CliRunner().invoke(app, list(arguments))
    assert error_text.exit_code == 2, error_text.output
    assert expected in error_text.stderr
    assert error_text.stdout == ""
    assert error_text.stderr.startswith("vrw: ")
    sentence = error_text.stderr.strip()
    assert sentence.endswith(".")
    assert "\n" not in sentence
    assert "Traceback" not in sentence
    assert "Errno" not in sentence
    assert list_files(working_folder) == before
    return sentence


@pytest.mark.parametrize("mistake", WRONG_CONFIGS)
def test_a_mistake_in_a_config_gets_one_sentence_that_helps(
    mistake: str, working_folder: Path
) -> None:
    text, expected = WRONG_CONFIGS[mistake]
    (working_folder / "my.toml").write_text(text)
    sentence = assert_refused(("gait", "my.toml"), expected, working_folder)
    assert sentence.startswith("vrw: my.toml: ")


@pytest.mark.parametrize("mistake", WRONG_COMMANDS)
def test_a_mistake_in_a_command_gets_one_sentence_that_helps(
    mistake: str, working_folder: Path
) -> None:
    arguments, text, expected = WRONG_COMMANDS[mistake]
    (working_folder / "my.toml").write_text(text)
    assert_refused(arguments, expected, working_folder)


USAGE_ERRORS = {
    "no such command": ("scann",),
    "no config": ("scan",),
    "no such option": ("scan", "my.toml", "--chunks", "3"),
    "no samples in a chunk": ("scan", "my.toml", "--chunk", "0"),
    "steps of 400 digits": ("gait", "--steps", DIGITS),
    "a chunk of 400 digits": ("scan", "my.toml", "--chunk", DIGITS),
    "a chunk as text": ("scan", "my.toml", "--chunk", "large"),
    "no steps": ("gait", "--steps", "0"),
    "a word too many": ("gait", "my.toml", "again"),
    "an option without its value": ("scan", "my.toml", "--out"),
}


@pytest.mark.parametrize("mistake", USAGE_ERRORS)
def test_a_misspelled_command_points_to_the_help(mistake: str, working_folder: Path) -> None:
    (working_folder / "my.toml").write_text(GRID_TABLE)
    before = list_files(working_folder)
    result = CliRunner().invoke(app, list(USAGE_ERRORS[mistake]))
    assert result.exit_code == 2
    assert "Error" in result.stderr
    assert "Traceback" not in result.stderr
    assert list_files(working_folder) == before


@pytest.mark.parametrize("command", ["gait", "scan"])
def test_a_missing_device_is_reported_in_one_sentence(command: str, tmp_path: Path) -> None:
    path = Path(__file__).parents[2] / "configs" / "quickstart.toml"
    process = subprocess.run(
        [sys.executable, "-m", "vrw_jax", command, str(path)],
        cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"JAX_PLATFORMS": "cuda"},
    )  # fmt: skip
    assert process.returncode == 2
    assert process.stderr.startswith("vrw: JAX_PLATFORMS is 'cuda', but JAX finds no device")
    assert process.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


ADDRESSES = ["tls://127.0.0.1:9", "tcp://127.0.0.1:99999", "tcp://", "", "inproc://x", "silent"]


@pytest.mark.parametrize("address", ADDRESSES)
def test_a_cluster_that_does_not_answer_gets_one_sentence(
    address: str, working_folder: Path
) -> None:
    (working_folder / "my.toml").write_text(GRID_TABLE)
    with socket.create_server(("127.0.0.1", 0)) as server:  # takes a call, and says nothing
        if address == "silent":
            address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        assert_refused(
            ("scan", "my.toml", "--dask", address), "no dask scheduler answers at", working_folder
        )


PROCESSES = {
    "uncompiled": (("gait",), {"JAX_DISABLE_JIT": "1"}, "JAX_DISABLE_JIT is set"),
    "backend": (("scan", "my.toml"), {"MPLBACKEND": "nonsense"}, "MPLBACKEND is 'nonsense'"),
}


def process(
    working_folder: Path, arguments: tuple[str, ...], environment: dict, **more: object
) -> object:
    root = str(Path(__file__).parents[2])
    return subprocess.run(
        [sys.executable, "-m", "vrw_jax", *arguments],
        cwd=working_folder, text=True, env=os.environ | {"PYTHONPATH": root} | environment, **more,
    )  # fmt: skip


@pytest.mark.parametrize("name", PROCESSES)
def test_an_environment_that_can_t_be_meant_gets_one_sentence(
    name: str, working_folder: Path
) -> None:
    (working_folder / "my.toml").write_text(GRID_TABLE)
    arguments, environment, expected = PROCESSES[name]
    before = list_files(working_folder)
    completed = process(working_folder, arguments, environment, capture_output=True)
    assert completed.returncode == 2, completed.stderr
    assert completed.stderr.startswith(f"vrw: {expected}")
    assert len(completed.stderr.splitlines()) == 1
    assert list_files(working_folder) == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device")
@pytest.mark.parametrize("arguments", [("--version",), ("init", "new")])
def test_a_full_device_gets_one_sentence(arguments: tuple[str, ...], working_folder: Path) -> None:
    with open("/dev/full", "w") as full:
        completed = process(working_folder, arguments, {}, stdout=full, stderr=subprocess.PIPE)
    assert completed.returncode == 2
    assert len(completed.stderr.splitlines()) == 1
    assert "No space left on device." in completed.stderr
