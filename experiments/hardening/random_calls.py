"""Call public functions with random invalid arguments, and classify how each call ends.

Each call replaces one or two arguments of a valid call by values that are meant for nothing. It
ends as "answered", as "one sentence" (a TypeError, ValueError or OSError of this library, of one
line), or as a fault: "foreign error", "NaN without a code", "too slow". If the process crashes,
the last line of the log names the call. A seed makes the calls reproducible.

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
"""Longest time of a call, including compilation, chosen because a user would stop it then."""
FAULTS = ("foreign error", "NaN without a code", "too slow")
"""Endings that are faults of the library."""


class Call(NamedTuple):
    """A public function and valid arguments of it."""

    function: Callable[..., Any]
    arguments: dict[str, Any]


class Ending(NamedTuple):
    """Kind of ending of a call, its error message and its duration."""

    kind: str
    error: str
    seconds: float


class RaisingObject:
    """Object whose conversion to text, array or comparison raises an error."""

    def __repr__(self) -> str:
        raise RuntimeError("no text")

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("no array")

    def __eq__(self, other: object) -> bool:
        raise RuntimeError("no comparison")

    __hash__ = object.__hash__


@functools.cache
def hostile_values() -> dict[str, Any]:
    """Return the values that replace arguments, by a name."""
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
        "object": object(), "obstinate": RaisingObject(), "class": int, "function": math.sin,
        "module": math, "dtype": np.dtype(float), "float type": np.float32,
        "array": np.array([0.1, 0.2]), "empty array": np.array([]), "matrix": np.eye(3),
        "0-d array": np.array(0.3), "jax array": jnp.array([0.1, 0.2, 0.3]),
        "jax 0-d": jnp.asarray(0.3),
        "array with nan": np.array([0.1, np.nan]), "array of text": np.array(["a", "b"]),
        "array of objects": np.array([None, 1], object), "array of truth values": np.array([True,
        False]),
        "complex array": np.array([1j, 2.0]), "int8 array": np.array([1, 2, 3], np.int8),
        "dates": np.array(["2020-01-01"], "M8[D]"), "record": np.zeros(2, [("a", float)]),
        "masked": np.ma.masked_array([1.0, 2.0], [True, False]), "key": jax.random.key(0),
        "ellipsis": ..., "not implemented": NotImplemented, "error": ValueError("x"),
        "path": Path("nowhere"), "wheel": vrw.WheelParams(), "options": vrw.StepOptions(),
        "wheels": vrw.WheelParams(damping=np.array([100.0, 150.0])),
        "rung": vrw.RigidWheel(), "shape": jax.ShapeDtypeStruct((3,), np.float64),
    }  # fmt: skip


UNCHANGED_ARGUMENTS = ("dask", "report")
"""Arguments that keep their values. A random `dask` would wait for a cluster, and a user's `report`
may raise any error. The tests of the command line give invalid addresses."""


def make_valid_call(function: Callable[..., Any], *given: Any, **named: Any) -> Call:
    """Return a valid call: `given` fills required arguments, and `named` replaces others."""
    parameters = inspect.signature(function).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.default is not p.empty}
    required = [p.name for p in parameters if p.default is p.empty and p.kind != p.VAR_KEYWORD]
    arguments = defaults | dict(zip(required, given, strict=False)) | named
    return Call(
        function, {name: x for name, x in arguments.items() if name not in UNCHANGED_ARGUMENTS}
    )


def make_valid_construction(kind: type) -> Call:
    """Return a valid construction of a class whose fields all have defaults."""
    instance = kind()
    return Call(
        kind, {field.name: getattr(instance, field.name) for field in dataclasses.fields(kind)}
    )


@functools.cache
def valid_calls() -> dict[str, Call]:
    """Return valid calls of the public functions, each shorter than a second after compilation."""
    wheel, start = vrw.WheelParams(), vrw.paper_start()
    two, states = vrw.WheelParams(damping=np.array([120.0, 150.0])), np.tile(start, (2, 1))
    box = {"damping": (100.0, 200.0)}
    post = {"theta_post_impact": [-0.6], "dtheta_post_impact": [1.0]}
    settings = (
        vrw.WheelParams, vrw.StepOptions, vrw.CycleOptions, vrw.ArclengthOptions,
        vrw.ViscoelasticWheel, vrw.RigidWheel, vrw.UnilateralWheel, vrw.LadderWheel,
    )  # fmt: skip
    functions = {
        "step": make_valid_call(vrw.step, wheel, start),
        "return_map": make_valid_call(vrw.return_map, wheel, start),
        "walk": make_valid_call(vrw.walk, wheel, start, 2),
        "simulate": make_valid_call(vrw.simulate, wheel, start),
        "step_batch": make_valid_call(vrw.step_batch, wheel, states),
        "limit_cycle": make_valid_call(vrw.limit_cycle, wheel),
        "limit_cycles": make_valid_call(vrw.limit_cycles, two),
        "choose_model": make_valid_call(vrw.choose_model, wheel, start),
        "basin": make_valid_call(vrw.basin, wheel, post),
        "grid": make_valid_call(vrw.grid, damping=[100.0], slope=[0.3]),
        "samples": make_valid_call(vrw.samples, {"damping": [100.0], "slope": [0.3]}),
        "sobol": make_valid_call(vrw.sobol, box, 4),
        "uniform": make_valid_call(vrw.uniform, box, 4),
        "saltelli": make_valid_call(vrw.saltelli, box, 4),
        "scan": make_valid_call(vrw.scan, vrw.grid(damping=[150.0]), ["speed"]),
        "open_scan": make_valid_call(vrw.open_scan, "nowhere"),
        "sobol_indices": make_valid_call(vrw.sobol_indices, None),
        "solve_fixed_point": make_valid_call(
            functools.partial(vrw.solve_fixed_point, lambda x: 0.5 * x), np.array([0.5])
        ),
    }
    return {kind.__name__: make_valid_construction(kind) for kind in settings} | functions


def make_call(name: str, changes: dict[str, Any]) -> Ending:
    """Call a public function with some arguments replaced, and return how the call ended."""
    function, arguments = valid_calls()[name]
    if callable(changes.get("on_progress")):  # a callback's own error belongs to the caller
        changes = changes | {"on_progress": None}
    start_time = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = function(**arguments | changes)
            nan_field = find_uncoded_nan(result)
    except Exception as error:
        return classify(error, time.perf_counter() - start_time)
    seconds = time.perf_counter() - start_time
    if seconds > MAX_CALL_SECONDS:
        return Ending("too slow", "", seconds)
    return Ending("NaN without a code" if nan_field else "answered", nan_field, seconds)


def classify(error: Exception, seconds: float) -> Ending:
    """Return whether an error is one sentence of this library or an error of other code."""
    text, file_name = str(error), traceback.extract_tb(error.__traceback__)[-1].filename
    description = f"{type(error).__name__}: {text[:300]} [{file_name.rpartition('/')[2]}]"
    is_of_library = "vrw_jax" in file_name and isinstance(error, TypeError | ValueError | OSError)
    is_sentence = is_of_library and text.endswith(".") and "\n" not in text
    return Ending("one sentence" if is_sentence else "foreign error", description, seconds)


def find_uncoded_nan(result: Any) -> str:
    """Return the name of a field of a step or gait that is NaN despite a good outcome, or an empty
    text."""
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
    """Return the name of a random call, and for one or two of its arguments names of invalid
    values."""
    calls, values = list(valid_calls()), list(hostile_values())
    name = calls[generator.integers(len(calls))]
    arguments = list(valid_calls()[name].arguments)
    arguments_to_replace = generator.permutation(arguments)[: generator.integers(1, 3)]
    return name, {str(x): values[generator.integers(len(values))] for x in arguments_to_replace}


def main() -> None:
    """Log and make the given number of calls, and write a table of the endings."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("results"))
    parser.add_argument("calls", type=int, nargs="?", default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parse_and_start_jax(parser)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    arguments.folder = arguments.folder.resolve()
    os.chdir(arguments.folder)  # An invalid value may be the name of a store.
    generator, rows = np.random.default_rng(arguments.seed), []
    with (arguments.folder / "random_calls.log").open("w") as log:
        for number in range(arguments.calls):
            name, changes = draw_changes(generator)
            log.write(f"{number} {name} {json.dumps(changes)}\n")
            log.flush()
            ending = make_call(name, {x: hostile_values()[value] for x, value in changes.items()})
            rows.append((number, name, json.dumps(changes), *ending))
    faults = [row for row in rows if row[3] in FAULTS]
    header = ("number", "call", "hostile", "ending", "error", "seconds")
    write_table(arguments.folder / "random_calls.csv", header, rows)
    for row in faults:
        print(*row[:5], sep=" | ")
    print(dict(Counter(row[3] for row in rows)), f"longest {max(row[5] for row in rows):.1f} s")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
