"""Random calls of the public functions with values that nobody means, by a seed.

Each call takes a sound one and puts a hostile value in the place of one or two of its arguments. It
ends as "answered", as "one sentence" (a TypeError, ValueError or OSError of this library, of one
line), or as a fault: "foreign error", "NaN without a code", "too slow". A crash ends the process,
and the last line of the log names the call.

    python -m experiments.hardening.random_calls results 20000 --seed 1
"""

import dataclasses
import functools
import inspect
import json
import math
import os
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import write_table

MAX_CALL_SECONDS = 60.0
"""Longest time of a call, compiling included, chosen because a user would stop it then."""
FAULTS = ("foreign error", "NaN without a code", "too slow")


class Call(NamedTuple):
    """A public function and arguments that it takes."""

    function: Callable[..., Any]
    arguments: dict[str, Any]


class Ending(NamedTuple):
    """What came of a call."""

    kind: str
    error: str
    seconds: float


class Obstinate:
    """An object that refuses whatever it is asked for."""

    def __repr__(self) -> str:
        raise RuntimeError("no text")

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("no array")

    def __eq__(self, other: object) -> bool:
        raise RuntimeError("no comparison")

    __hash__ = object.__hash__


@functools.cache
def hostile_values() -> dict[str, Any]:
    """Return values that can be given for any argument, by a name."""
    integers = {
        name: np.dtype(name).type(3) for name in ("int8", "uint8", "int16", "uint16", "uint64")
    }
    floats = {name: np.dtype(name).type(0.3) for name in ("float16", "float32", "longdouble")}
    return integers | floats | {
        "nothing": None, "true": True, "false": False, "zero": 0, "one": 1, "minus one": -1,
        "half": 0.5, "minus half": -0.5, "nan": math.nan, "inf": math.inf, "minus inf": -math.inf,
        "huge": 1e300, "tiny": 5e-324, "minus zero": -0.0, "400 digits": 10**400,
        "minus 400 digits": -(10**400), "9000 digits": 1 << 30000, "complex": 1 + 2j,
        "text": "fast", "empty text": "", "null character": "a\0b", "long text": "x" * 5000,
        "surrogate": "\ud800", "bytes": b"speed", "list": [1.0, 2.0], "empty list": [],
        "nested list": [[1.0], [2.0, 3.0]], "list of text": ["a", "b"],
        "list with nan": [1.0, math.nan],
        "tuple": (1, 2), "empty tuple": (), "set": {1.0, 2.0}, "set of text": {"speed"},
        "table": {"a": 1}, "empty table": {}, "range": range(3), "slice": slice(None),
        "object": object(), "obstinate": Obstinate(), "class": int, "function": math.sin,
        "module": math, "dtype": np.dtype(float), "float type": np.float32,
        "array": np.array([0.1, 0.2]), "empty array": np.array([]), "matrix": np.eye(3),
        "0-d array": np.array(0.3), "jax array": jnp.array([0.1, 0.2, 0.3]),
        "jax 0-d": jnp.asarray(0.3),
        "array with nan": np.array([0.1, np.nan]), "array of text": np.array(["a", "b"]),
        "array of objects": np.array([None, 1], object), "array of truths": np.array([True, False]),
        "complex array": np.array([1j, 2.0]), "int8 array": np.array([1, 2, 3], np.int8),
        "dates": np.array(["2020-01-01"], "M8[D]"), "record": np.zeros(2, [("a", float)]),
        "masked": np.ma.masked_array([1.0, 2.0], [True, False]), "key": jax.random.key(0),
        "ellipsis": ..., "not implemented": NotImplemented, "error": ValueError("x"),
        "path": Path("nowhere"), "wheel": vrw.WheelParams(), "options": vrw.StepOptions(),
        "wheels": vrw.WheelParams(damping=np.array([100.0, 150.0])),
        "rung": vrw.RigidWheel(), "shape": jax.ShapeDtypeStruct((3,), np.float64),
    }  # fmt: skip


LEFT_OUT = ("dask", "report")
"""Arguments that are not drawn: each call would wait for a cluster, and a user's function may raise
what it likes. The tests of the command line give hostile addresses."""


def make_sound(function: Callable[..., Any], *given: Any, **named: Any) -> Call:
    """Return a sound call: what has no default is given in order, the rest as usual."""
    parameters = inspect.signature(function).parameters.values()
    usual = {p.name: p.default for p in parameters if p.default is not p.empty}
    required = [p.name for p in parameters if p.default is p.empty and p.kind != p.VAR_KEYWORD]
    arguments = usual | dict(zip(required, given, strict=False)) | named
    return Call(function, {name: x for name, x in arguments.items() if name not in LEFT_OUT})


def make_sound_settings(kind: type) -> Call:
    """Return a sound call of a class whose fields all have defaults."""
    made = kind()
    return Call(kind, {field.name: getattr(made, field.name) for field in dataclasses.fields(kind)})


@functools.cache
def sound_calls() -> dict[str, Call]:
    """Return sound calls of the public functions that take less than a second once compiled."""
    wheel, start = vrw.WheelParams(), vrw.paper_start()
    two, states = vrw.WheelParams(damping=np.array([120.0, 150.0])), np.tile(start, (2, 1))
    box = {"damping": (100.0, 200.0)}
    post = {"theta_post_impact": [-0.6], "dtheta_post_impact": [1.0]}
    settings = (
        vrw.WheelParams, vrw.StepOptions, vrw.CycleOptions, vrw.ArclengthOptions,
        vrw.ViscoelasticWheel, vrw.RigidWheel, vrw.UnilateralWheel, vrw.LadderWheel,
    )  # fmt: skip
    functions = {
        "step": make_sound(vrw.step, wheel, start),
        "return_map": make_sound(vrw.return_map, wheel, start),
        "walk": make_sound(vrw.walk, wheel, start, 2),
        "simulate": make_sound(vrw.simulate, wheel, start),
        "step_batch": make_sound(vrw.step_batch, wheel, states),
        "limit_cycle": make_sound(vrw.limit_cycle, wheel),
        "limit_cycles": make_sound(vrw.limit_cycles, two),
        "choose_model": make_sound(vrw.choose_model, wheel, start),
        "basin": make_sound(vrw.basin, wheel, post),
        "grid": make_sound(vrw.grid, damping=[100.0], slope=[0.3]),
        "samples": make_sound(vrw.samples, {"damping": [100.0], "slope": [0.3]}),
        "sobol": make_sound(vrw.sobol, box, 4),
        "uniform": make_sound(vrw.uniform, box, 4),
        "saltelli": make_sound(vrw.saltelli, box, 4),
        "scan": make_sound(vrw.scan, vrw.grid(damping=[150.0]), ["speed"]),
        "open_scan": make_sound(vrw.open_scan, "nowhere"),
        "sobol_indices": make_sound(vrw.sobol_indices, None),
        "solve_fixed_point": make_sound(
            functools.partial(vrw.solve_fixed_point, lambda x: 0.5 * x), np.array([0.5])
        ),
    }
    return {kind.__name__: make_sound_settings(kind) for kind in settings} | functions


def make_call(name: str, changes: dict[str, Any]) -> Ending:
    """Call a public function with some of its sound arguments replaced; return what came of it."""
    function, arguments = sound_calls()[name]
    began = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = function(**arguments | changes)
            lost = find_uncoded_nan(result)
    except Exception as error:
        return classify(error, time.perf_counter() - began)
    seconds = time.perf_counter() - began
    if seconds > MAX_CALL_SECONDS:
        return Ending("too slow", "", seconds)
    return Ending("NaN without a code" if lost else "answered", lost, seconds)


def classify(error: Exception, seconds: float) -> Ending:
    """Return whether an error is a sentence of this library, or somebody else's."""
    text, where = str(error), traceback.extract_tb(error.__traceback__)[-1].filename
    description = f"{type(error).__name__}: {text[:300]} [{where.rpartition('/')[2]}]"
    ours = "vrw_jax" in where and isinstance(error, TypeError | ValueError | OSError)
    sentence = ours and text.endswith(".") and "\n" not in text
    return Ending("one sentence" if sentence else "foreign error", description, seconds)


def find_uncoded_nan(result: Any) -> str:
    """Return what of a step or gait is not finite although its outcome says that it went well."""
    outcome = getattr(result, "outcome", None)
    if outcome is None or not hasattr(result, "measures"):
        return ""
    good = np.asarray(outcome) == vrw.Outcome.STEPPED
    for name in ("section_state", "period", "speed"):
        values = np.asarray(getattr(result, name, 0.0), float)
        finite = np.isfinite(values).reshape(*np.shape(good), -1).all(-1) if values.size else True
        if np.any(good & ~finite):
            return name
    return ""


def draw_changes(generator: np.random.Generator) -> tuple[str, dict[str, str]]:
    """Return a call by name, and names of hostile values for one or two of its arguments."""
    calls, values = list(sound_calls()), list(hostile_values())
    name = calls[generator.integers(len(calls))]
    arguments = list(sound_calls()[name].arguments)
    some = generator.permutation(arguments)[: generator.integers(1, 3)]
    return name, {str(x): values[generator.integers(len(values))] for x in some}


def main() -> None:
    """Make so many calls, log each before it is made, and write a table of the endings."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("results"))
    parser.add_argument("calls", type=int, nargs="?", default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parse_and_start_jax(parser)
    chosen.folder.mkdir(parents=True, exist_ok=True)
    chosen.folder = chosen.folder.resolve()
    os.chdir(chosen.folder)  # a hostile value may name a store, which a scan then writes
    generator, rows = np.random.default_rng(chosen.seed), []
    with (chosen.folder / "random_calls.log").open("w") as log:
        for number in range(chosen.calls):
            name, drawn = draw_changes(generator)
            log.write(f"{number} {name} {json.dumps(drawn)}\n")
            log.flush()
            ending = make_call(name, {x: hostile_values()[value] for x, value in drawn.items()})
            rows.append((number, name, json.dumps(drawn), *ending))
    faults = [row for row in rows if row[3] in FAULTS]
    header = ("number", "call", "hostile", "ending", "error", "seconds")
    write_table(chosen.folder / "random_calls.csv", header, rows)
    for row in faults:
        print(*row[:5], sep=" | ")
    print(dict(Counter(row[3] for row in rows)), f"longest {max(row[5] for row in rows):.1f} s")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
