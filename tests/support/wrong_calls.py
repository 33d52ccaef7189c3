"""Wrong calls of the library, each with the type of its error and words of its message.

As a program the module makes all calls in a process without the annotation checks of the tests. It
prints {name: [error type, message, file that raised it]}.
"""

import dataclasses
import functools
import json
import math
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple


class WrongCall(NamedTuple):
    call: Callable[[], Any]
    error_type: str
    expected_words: str


WRONG_CALLS: dict[str, WrongCall] = {}


def add_wrong_call(
    name: str, call: Callable[[], Any], error_type: str, expected_words: str
) -> None:
    assert name not in WRONG_CALLS, name
    WRONG_CALLS[name] = WrongCall(call, error_type, expected_words)


def add_wrong_calls(
    name: str, call: Callable[[Any], Any], cases: dict[str, tuple[Any, str]], expected_words: str
):
    for label, (value, kind) in cases.items():
        add_wrong_call(f"{name}: {label}", lambda value=value: call(value), kind, expected_words)


def register_wrong_calls() -> None:
    import diffrax
    import jax
    import jax.numpy as jnp
    import numpy as np
    import xarray as xr

    import vrw_jax as vrw
    from vrw_jax import hybrid, lanes

    table_1, start = vrw.WheelParams(), vrw.paper_start()
    several = vrw.WheelParams(damping=np.linspace(100.0, 200.0, 3))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), table_1)
    not_numbers = {
        "text": ("fast", "TypeError"),
        "digits": ("150", "TypeError"),
        "nothing": (None, "TypeError"),
        "complex": (1.0 + 2.0j, "TypeError"),
        "reference": (True, "TypeError"),
        "table": ({}, "TypeError"),
        "object": (object(), "TypeError"),
    }
    full_values = not_numbers | {
        "fraction": (2.5, "ValueError"),
        "float": (2.0, "ValueError"),
        "zero": (0, "ValueError"),
        "negative": (-3, "ValueError"),
        "several": (np.array([1, 2]), "TypeError"),
    }
    positive = not_numbers | {
        "zero": (0.0, "ValueError"),
        "negative": (-1.0, "ValueError"),
        "nan": (float("nan"), "ValueError"),
        "infinite": (float("inf"), "ValueError"),
    }

    add_wrong_call(
        "a number as the folder of compiled code", lambda: vrw.start_jax(3), "TypeError", "cache"
    )
    add_wrong_call(
        "a file as the folder of compiled code",
        lambda: vrw.start_jax(__file__), "NotADirectoryError", "a file",
    )  # fmt: skip

    # Parameters
    for name in ("damping", "slope", "leg_mass"):
        bad = not_numbers | {
            "nan": (float("nan"), "ValueError"), "negative": (-9.0, "ValueError"),
            "huge": (1e70, "ValueError"), "a list with text": ([1.0, "a"], "TypeError"),
            "masked": (np.ma.array([0.1, 0.2], mask=[0, 1]), "TypeError"),
        }  # fmt: skip
        add_wrong_calls(
            f"WheelParams {name}", lambda v, n=name: vrw.WheelParams(**{n: v}), bad, name
        )
    add_wrong_calls(
        "WheelParams n_legs", lambda v: vrw.WheelParams(n_legs=v), full_values, "n_legs"
    )
    add_wrong_call(
        "a leg's mass above the hub", lambda: vrw.WheelParams(leg_com=1.5), "ValueError", "leg_com"
    )
    add_wrong_call(
        "batches of two lengths",
        lambda: vrw.WheelParams(damping=np.ones(3), slope=np.ones(4) / 9),
        "ValueError",
        "shapes",
    )

    # Options
    for name in ("rtol", "atol", "max_phase_time", "dt0"):
        add_wrong_calls(
            f"StepOptions {name}", lambda v, n=name: vrw.StepOptions(**{n: v}), positive, name
        )
    for name in ("max_solver_steps", "max_event_iterations"):
        add_wrong_calls(
            f"StepOptions {name}", lambda v, n=name: vrw.StepOptions(**{n: v}), full_values, name
        )
    solvers = not_numbers | {
        "an object of diffrax": (diffrax.Tsit5(), "TypeError"), "typo": ("Tsit6", "ValueError"),
        "for noise": ("ShARK", "ValueError"),
    }  # fmt: skip
    del solvers["text"], solvers["digits"]
    add_wrong_calls("StepOptions solver", lambda v: vrw.StepOptions(solver=v), solvers, "solver")
    for name in ("max_newton_iterations", "batch_size"):
        add_wrong_calls(
            f"CycleOptions {name}", lambda v, n=name: vrw.CycleOptions(**{n: v}), full_values, name
        )
    add_wrong_calls(
        "CycleOptions tolerance", lambda v: vrw.CycleOptions(tolerance=v), positive, "tolerance"
    )
    for label, value in {
        "two": (1, 2), "fractions": (1.5, 2, 3), "text": "abcd", "one": 5, "zeros": (0, 1, 1)
    }.items():  # fmt: skip
        add_wrong_call(
            f"CycleOptions mesh_intervals: {label}",
            lambda v=value: vrw.CycleOptions(mesh_intervals=v),
            "ValueError",
            "mesh_intervals",
        )
    add_wrong_calls(
        "ArclengthOptions max_points",
        lambda v: vrw.ArclengthOptions(max_points=v),
        full_values,
        "max_points",
    )
    add_wrong_calls(
        "ArclengthOptions max_turn_angle",
        lambda v: vrw.ArclengthOptions(max_turn_angle=v),
        positive,
        "max_turn_angle",
    )
    add_wrong_call(
        "step_batch of a branch out of order",
        lambda: vrw.ArclengthOptions(initial_ds=1.0),
        "ValueError",
        "order",
    )

    for name in ("rtol", "max_phase_time"):
        add_wrong_call(
            f"Options of several {name}, one not a number",
            lambda n=name: vrw.StepOptions(**{n: [1.0, float("nan")]}),
            "ValueError",
            name,
        )
        add_wrong_call(
            f"a step by several {name}",
            lambda n=name: vrw.step(table_1, start, options=vrw.StepOptions(**{n: [1e-6, 1e-7]})),
            "ValueError", f"{name} has shape (2,)",
        )  # fmt: skip
    add_wrong_call(
        "uneven as a number", lambda: vrw.UnilateralWheel(uneven=math.inf), "TypeError", "uneven"
    )
    for label, value in {
        "a number": 3, "a dtype": np.dtype(float), "a reference": True, "an array": np.eye(2)
    }.items():  # fmt: skip
        add_wrong_call(
            f"derivatives as {label}",
            lambda v=value: vrw.step_batch(table_1, np.asarray(start)[None], derivatives=v),
            "TypeError",
            "derivatives",
        )
    add_wrong_call(
        "a rung that is an array",
        lambda: vrw.step(table_1, start, model=np.eye(2)), "TypeError", "an array of shape (2, 2)",
    )  # fmt: skip
    add_wrong_call("a store that is a number", lambda: vrw.scan(vrw.grid(damping=[1.0]), store=3),
        "TypeError", "store")  # fmt: skip

    # Rungs
    frictions = not_numbers | {
        "negative": (-1.0, "ValueError"), "nan": (float("nan"), "ValueError")
    }  # fmt: skip
    for model in (vrw.UnilateralWheel, vrw.ViscoelasticWheel, vrw.RigidWheel, vrw.LadderWheel):
        add_wrong_calls(
            f"{model.__name__} friction", lambda v, m=model: m(friction=v), frictions, "friction"
        )
    add_wrong_calls(
        "UnilateralWheel max_events",
        lambda v: vrw.UnilateralWheel(max_events=v),
        full_values,
        "max_events",
    )
    add_wrong_call(
        "stoppers misspelt",
        lambda: vrw.UnilateralWheel(stoppers="one sided"),
        "ValueError",
        "did you mean 'one-sided'",
    )
    add_wrong_call(
        "a choice that is no choice",
        lambda: vrw.ViscoelasticWheel(stop_at_lift_off="no"),
        "TypeError",
        "stop_at_lift_off",
    )
    add_wrong_calls(
        "choose_model friction",
        lambda v: vrw.choose_model(table_1, start, friction=v),
        frictions,
        "friction",
    )

    # Several grounds where one is meant
    frictions = np.linspace(0.5, 0.9, 5)
    grounds = vrw.UnilateralWheel(friction=frictions)
    for name, call in {
        "step": lambda: vrw.step(table_1, start, model=grounds),
        "return_map": lambda: vrw.return_map(table_1, start, model=grounds),
        "walk of three steps": lambda: vrw.walk(table_1, start, 3, model=grounds),
        "simulate": lambda: vrw.simulate(table_1, start, model=grounds),
        "step_batch of three wheels": lambda: vrw.step_batch(
            several, np.tile(start, (3, 1)), model=grounds
        ),
        "limit_cycle": lambda: vrw.limit_cycle(table_1, model=grounds),
        "limit_cycles": lambda: vrw.limit_cycles(several, model=grounds),
        "sensitivities": lambda: vrw.sensitivities(table_1, model=grounds),
        "continue_branch": lambda: vrw.continue_branch(
            table_1, "damping", (150.0, 230.0), model=grounds
        ),
        "tune": lambda: vrw.tune(
            table_1, "speed", ["damping"], {"damping": (100.0, 300.0)}, model=grounds
        ),
        "basin": lambda: vrw.basin(
            table_1, {"theta_post_impact": [-0.6], "dtheta_post_impact": [1.0]}, model=grounds
        ),
        "scan": lambda: vrw.scan(vrw.grid(damping=[100.0, 150.0]), ["speed"], model=grounds),
        "ladder": lambda: vrw.step(table_1, start, model=vrw.LadderWheel(friction=frictions)),
    }.items():  # fmt: skip
        add_wrong_call(f"{name} on five grounds", call, "ValueError", "friction has shape (5,)")
    add_wrong_call(
        "step with two restitutions",
        lambda: vrw.step(
            table_1, start, model=vrw.UnilateralWheel(restitution=np.array([0.1, 0.2]))
        ),
        "ValueError",
        "restitution has shape (2,)",
    )
    add_wrong_call(
        "explore on two grounds",
        lambda: vrw.explore(table_1, friction=np.array([0.5, 0.7])),
        "TypeError",
        "one known number",
    )

    # States
    states = {
        "text": ("abc", "TypeError"),
        "texts": (["0.1", "1.6", "-0.1"], "TypeError"),
        "nothing": (None, "TypeError"),
        "complex": ([0.1, 1.6, 1j], "TypeError"),
        "a row": (np.ones((1, 3)), "ValueError"),
        "two numbers": ([0.1, 1.6], "ValueError"),
        "a wheel": (table_1, "TypeError"),
        "one number": (0.1, "ValueError"),
    }
    for name, call in {
        "step": vrw.step, "return_map": vrw.return_map, "choose_model": vrw.choose_model,
        "walk": lambda p, x: vrw.walk(p, x, 2),
    }.items():  # fmt: skip
        add_wrong_calls(f"{name} state", lambda v, c=call: c(table_1, v), states, "section state")
        add_wrong_call(
            f"{name} of a table",
            lambda c=call: c({"damping": 200.0}, start),
            "TypeError",
            "WheelParams",
        )
        add_wrong_call(
            f"{name} of a batch", lambda c=call: c(several, start), "ValueError", "jax.vmap"
        )
        add_wrong_call(
            f"{name} of single numbers",
            lambda c=call: c(single, start),
            "ValueError",
            "vrw.start_jax()",
        )
    given = {k: v for k, v in states.items() if k != "nothing"}
    add_wrong_calls("simulate state", lambda v: vrw.simulate(table_1, v), given, "section state")
    rows = given | {"three numbers": (np.ones(3), "ValueError"),
                    "four columns": (np.ones((2, 4)), "ValueError"),
                    "a masked row": (np.ma.array(np.ones((2, 3)), mask=[[0], [1]] * np.ones(3)),
                                     "TypeError")}  # fmt: skip
    rows.pop("a row")
    add_wrong_calls("step_batch states", lambda v: vrw.step_batch(table_1, v), rows, "states")
    add_wrong_call(
        "step by options of a cycle",
        lambda: vrw.step(table_1, start, options=vrw.CycleOptions()),
        "TypeError",
        "must be a StepOptions: give vrw.StepOptions",
    )
    add_wrong_call(
        "a model that is a class",
        lambda: vrw.step(table_1, start, model=vrw.RigidWheel),
        "TypeError",
        "model",
    )
    add_wrong_call(
        "a model by another name",
        lambda: vrw.step(table_1, start, model="rigid"),
        "TypeError",
        "auto",
    )
    add_wrong_call(
        "a tolerance below rounding",
        lambda: vrw.step(table_1, start, options=vrw.StepOptions(rtol=1e-17)),
        "ValueError",
        "resolve",
    )
    add_wrong_call("walk on 2.5", lambda: vrw.walk(table_1, start, 2.5), "ValueError", "n_steps")
    add_wrong_calls("walk n_steps", lambda v: vrw.walk(table_1, start, v), full_values, "n_steps")
    add_wrong_calls(
        "simulate n_steps", lambda v: vrw.simulate(table_1, start, v), full_values, "n_steps"
    )
    add_wrong_calls(
        "simulate n_samples",
        lambda v: vrw.simulate(table_1, n_samples=v),
        full_values | {"one": (1, "ValueError")},
        "n_samples",
    )
    add_wrong_call("simulate a batch", lambda: vrw.simulate(several), "ValueError", "one wheel")

    # Batches
    ones = np.asarray(start)[None]
    add_wrong_calls(
        "step_batch n_steps", lambda v: vrw.step_batch(table_1, ones, v), full_values, "n_steps"
    )
    add_wrong_call(
        "step_batch engine",
        lambda: vrw.step_batch(table_1, ones, engine="lane"),
        "ValueError",
        "did you mean 'lanes'",
    )

    class RestingWalker(vrw.AbstractWalker):
        def advance(self, params, x, options):
            return vrw.AdvanceResult(x, np.ones(1))

    for name, call in {
        "step": functools.partial(vrw.step, {}, [1.0]),
        "walk": functools.partial(vrw.walk, {}, [1.0], 2),
        "simulate": functools.partial(vrw.simulate, {}, [1.0], 2),
        "step_batch": functools.partial(vrw.step_batch, {}, np.ones((2, 1))),
    }.items():
        add_wrong_call(
            f"{name} of an own walker by an engine",
            functools.partial(call, model=RestingWalker(), engine="lane"),
            "ValueError",
            "did you mean 'lanes'",
        )
    add_wrong_call(
        "step_batch engine none",
        lambda: vrw.step_batch(table_1, ones, engine=None),
        "TypeError",
        "engine",
    )
    add_wrong_call(
        "step_batch of another number of wheels",
        lambda: vrw.step_batch(several, ones),
        "ValueError",
        "one for each",
    )
    add_wrong_call(
        "step_batch of a table", lambda: vrw.step_batch({}, ones), "TypeError", "WheelParams"
    )
    add_wrong_call(
        "step_batch by options of a cycle",
        lambda: vrw.step_batch(table_1, ones, options=vrw.CycleOptions()),
        "TypeError",
        "vrw.StepOptions",
    )
    add_wrong_call(
        "step_batch by the engine of an earlier version",
        lambda: vrw.step_batch(table_1, ones, engine="collocation"),
        "ValueError",
        "one of 'auto', 'lanes', 'diffrax'",
    )
    add_wrong_call(
        "step_batch of single numbers",
        lambda: vrw.step_batch(single, ones),
        "ValueError",
        "vrw.start_jax()",
    )

    # Inside transformations
    for name, call in {
        "step_batch": lambda p: vrw.step_batch(p, ones),
        "simulate": lambda p: vrw.simulate(p, start),
        "tune": lambda p: vrw.tune(p, "speed", ["damping"], {"damping": (100.0, 300.0)}),
        "sensitivities": lambda p: vrw.sensitivities(p),
        "continue_branch": lambda p: vrw.continue_branch(p, "damping", (100.0, 300.0)),
        "basin": lambda p: vrw.basin(p, {}),
        "smallest_disturbance": lambda p: vrw.smallest_disturbance(p),
    }.items():  # fmt: skip
        add_wrong_call(
            f"{name} under jit", lambda c=call: jax.jit(c)(table_1), "TypeError", "outside"
        )
        add_wrong_call(
            f"{name} under grad", lambda c=call: jax.grad(c)(table_1), "TypeError", "outside"
        )
        add_wrong_call(
            f"{name} under vmap",
            lambda c=call: jax.vmap(c, in_axes=(several.in_axes,))(several),
            "TypeError",
            "outside",
        )

    for label, make in {
        "torque": lambda v: {"model": vrw.ViscoelasticWheel(hub_torque=v)},
        "friction": lambda v: {"model": vrw.UnilateralWheel(friction=v)},
        "tolerance": lambda v: {"options": vrw.StepOptions(rtol=v)},
    }.items():
        for name, call in {"step_batch": vrw.step_batch, "simulate": vrw.simulate}.items():
            x = ones if name == "step_batch" else start
            add_wrong_call(
                f"{name} under jit by a traced {label}",
                lambda c=call, x=x, m=make: jax.jit(lambda v: c(table_1, x, **m(v)))(1e-3),
                "TypeError",
                "outside",
            )

    # Cycles
    guesses = given | {"nan": ([0.1, float("nan"), 0.0], "ValueError")}
    add_wrong_calls("limit_cycle guess", lambda v: vrw.limit_cycle(table_1, guess=v), guesses, "")
    add_wrong_calls(
        "limit_cycle period_n",
        lambda v: vrw.limit_cycle(table_1, period_n=v),
        full_values,
        "period_n",
    )
    add_wrong_call(
        "two steps without a guess",
        lambda: vrw.limit_cycle(table_1, period_n=2),
        "ValueError",
        "guess",
    )
    add_wrong_call(
        "on_failure as a number",
        lambda: vrw.limit_cycle(table_1, on_failure=0.0),
        "TypeError",
        "on_failure",
    )
    add_wrong_call(
        "on_failure misspelt",
        lambda: vrw.limit_cycle(table_1, on_failure="NaN"),
        "ValueError",
        "on_failure",
    )
    asks = lambda **given: vrw.measure_to_tolerance(
        **{"measures": "speed", "params": table_1, "tol": 1e-3, "friction": 20.0} | given
    )
    add_wrong_calls("measure_to_tolerance tol", lambda v: asks(tol=v), positive, "tol")
    wrong = (
        ("measure misspelt", {"measures": "spead"}, "ValueError", "did you mean 'speed'"),
        ("measure of a step alone", {"measures": "slip"}, "ValueError", "every model has"),
        ("no measure", {"measures": []}, "ValueError", "measures is empty"),
        ("measures as numbers", {"measures": [1.0]}, "TypeError", "measures"),
        ("a number as the wheel", {"params": 150.0}, "TypeError", "WheelParams"),
        ("frictions of other lanes", {"friction": [1.0, 2.0], "params": several}, "ValueError",
         "a batch has one axis"),
        ("negative friction", {"friction": -1.0}, "ValueError", "friction"),
        ("relative as text", {"relative": "yes"}, "TypeError", "relative"),
        ("stoppers misspelt", {"stoppers": "onesided"}, "ValueError", "stoppers"),
        ("which misspelt", {"which": "quickest"}, "ValueError", "which is 'quickest'"),
        ("which between places", {"which": 0.5}, "ValueError", "which is 0.5"),
        ("which a set", {"which": {0, 1}}, "TypeError", "which is {0, 1}"),
        ("which an array", {"which": np.array([0, 1])}, "TypeError", "which is an array"),
        ("which a reference", {"which": True}, "TypeError", "which is True"),
    )  # fmt: skip
    for label, given, kind, words in wrong:
        add_wrong_call(
            f"measure_to_tolerance: {label}", lambda given=given: asks(**given), kind, words
        )
    mean = lambda params=several, **given: vrw.multifidelity_mean(
        given.pop("measure", "speed"), params, given.pop("tol", 1e-3), friction=20.0, **given
    )
    add_wrong_call(
        "multifidelity_mean of one wheel",
        lambda: mean(table_1),
        "ValueError",
        "more wheels than its pilot",
    )
    add_wrong_call("multifidelity_mean of few wheels", mean, "ValueError", "there are 3 wheels")
    add_wrong_call(
        "multifidelity_mean: a small pilot", lambda: mean(pilot=2), "ValueError", "pilot"
    )
    add_wrong_call("multifidelity_mean: tol negative", lambda: mean(tol=-1.0), "ValueError", "tol")
    add_wrong_call(
        "multifidelity_mean: unknown measure",
        lambda: mean(measure="sped"),
        "ValueError",
        "every model has",
    )
    add_wrong_call(
        "multifidelity_mean: several", lambda: mean(measure=["speed"]), "TypeError", "measure"
    )
    add_wrong_call("multifidelity_mean: a state", lambda: mean(start), "TypeError", "WheelParams")
    add_wrong_call(
        "multifidelity_mean: stoppers", lambda: mean(stoppers="none"), "ValueError", "stoppers"
    )
    add_wrong_call("multifidelity_mean: seed", lambda: mean(seed="one"), "TypeError", "seed")

    add_wrong_call(
        "limit_cycle of a batch", lambda: vrw.limit_cycle(several), "ValueError", "jax.vmap"
    )
    add_wrong_call(
        "limit_cycle of a state", lambda: vrw.limit_cycle(start), "TypeError", "WheelParams"
    )
    add_wrong_call(
        "limit_cycle of single numbers",
        lambda: vrw.limit_cycle(single),
        "ValueError",
        "vrw.start_jax()",
    )
    add_wrong_call(
        "limit_cycle by options of a step",
        lambda: vrw.limit_cycle(table_1, options=vrw.StepOptions()),
        "TypeError",
        "CycleOptions",
    )
    add_wrong_call(
        "limit_cycle by a table of options",
        lambda: vrw.limit_cycle(table_1, options={}),
        "TypeError",
        "CycleOptions",
    )
    add_wrong_call(
        "a rigid cycle by options of a mesh",
        lambda: vrw.limit_cycle(table_1, model=vrw.RigidWheel(), options=vrw.CycleOptions()),
        "TypeError",
        "return map",
    )
    add_wrong_call(
        "sensitivities of nothing",
        lambda: vrw.sensitivities(table_1, measures=[]),
        "ValueError",
        "nothing",
    )
    add_wrong_call(
        "sensitivities misspelt",
        lambda: vrw.sensitivities(table_1, measures="spead"),
        "ValueError",
        "did you mean 'speed'",
    )
    add_wrong_call(
        "sensitivities of a number",
        lambda: vrw.sensitivities(table_1, measures=3),
        "TypeError",
        "measures",
    )
    add_wrong_call(
        "sensitivities of a batch", lambda: vrw.sensitivities(several), "ValueError", "one wheel"
    )
    add_wrong_call(
        "sensitivities of single numbers",
        lambda: vrw.sensitivities(single),
        "ValueError",
        "vrw.start_jax()",
    )
    add_wrong_call(
        "limit_cycle of a gait by another name",
        lambda: vrw.limit_cycle(table_1, which="slow"),
        "ValueError",
        "slowest",
    )
    add_wrong_call(
        "sensitivities of no gait",
        lambda: vrw.sensitivities(vrw.WheelParams(slope=0.02)),
        "NoGaitError",
        "no gait",
    )
    add_wrong_call(
        "solve_fixed_point of no function",
        lambda: vrw.solve_fixed_point(3.0, start),
        "TypeError",
        "function",
    )
    add_wrong_calls(
        "solve_fixed_point period_n",
        lambda v: vrw.solve_fixed_point(lambda x: x, start, period_n=v),
        full_values,
        "period_n",
    )
    add_wrong_call(
        "solve_fixed_point in negative units",
        lambda: vrw.solve_fixed_point(lambda x: x, start, units=-1.0),
        "ValueError",
        "units are",
    )
    add_wrong_call(
        "solve_fixed_point from text",
        lambda: vrw.solve_fixed_point(lambda x: x, "abc"),
        "TypeError",
        "start",
    )

    # Any field, guards and resets
    fall = lambda y: jnp.stack([y[1], -9.81 + 0.0 * y[1]])
    floor = hybrid.Guard(lambda y: y[0], lambda y: jnp.stack([0.0 * y[0], -0.8 * y[1]]))
    ball = hybrid.Mode(fall, (floor,))
    run_hybrid = lambda modes, **other: hybrid.simulate_hybrid(
        modes, [1.0, 0.0], **{"events": 2} | other
    )
    add_wrong_calls(
        "simulate_hybrid events", lambda v: run_hybrid([ball], events=v), full_values, "events is"
    )
    for name, call, kind, words in (
        ("more events than fit", lambda: run_hybrid([ball], events=10**12), "ValueError", "fewer"),
        ("options of a cycle", lambda: run_hybrid([ball], options=vrw.CycleOptions()), "TypeError",
         "vrw.StepOptions()"),
        ("a mode that there isn't", lambda: run_hybrid([ball], mode=3), "ValueError", "mode is 3"),
        ("a field as mode", lambda: run_hybrid([fall]), "TypeError", "give Mode(field, guards)"),
        ("no field", lambda: run_hybrid([ball._replace(field=None)]), "TypeError", "a function"),
        ("a function as guard", lambda: run_hybrid([ball._replace(guards=(fall,))]), "TypeError",
         "give Guard("),
        ("a field of one row less", lambda: run_hybrid([ball._replace(field=lambda y: y[:1])]),
         "ValueError", "the field of mode 0"),
        ("a mode by name", lambda: run_hybrid([ball], mode="fall"), "TypeError", "mode is 'fall'"),
        ("a next mode by name", lambda: run_hybrid([ball._replace(guards=floor._replace(
            target_mode="fall"))]), "TypeError", "target_mode is 'fall'"),
    ):  # fmt: skip
        add_wrong_call(f"simulate_hybrid with {name}", call, kind, words)

    def make_drop(**changes):
        guard = hybrid.Guard(lambda y, p: y[0])._replace(**changes)
        modes = {"fall": hybrid.Mode(lambda y, p: fall(y), {"floor": guard})}
        return vrw.HybridSystem(modes=modes, section="floor", state=("height", "rate"))

    for name, changes, words in (
        ("a guard that is a bool", {"value": lambda y, p: y[0] > 0.0}, "'fall' gives bool"),
        ("a guard that is an integer", {"value": lambda y, p: jnp.int32(1)}, "'fall' gives int32"),
        ("an arming bool", {"armed": lambda y, p: y[1] < 0.0}, "armed of guard 'floor'"),
    ):
        add_wrong_call(
            f"a step of a HybridSystem with {name}",
            lambda c=changes: make_drop(**c).step({}, [1.0, 0.0]), "ValueError", words,
        )  # fmt: skip
    add_wrong_call(
        "invariants of a HybridSystem by name",
        lambda: dataclasses.replace(make_drop(), invariants={"energy": lambda y, p: y[0]}),
        "TypeError", "give a tuple of functions",
    )  # fmt: skip
    add_wrong_call(
        "a domain without an upper bound",
        lambda: vrw.parameter(1.0, domain=(0.0, None)), "TypeError", "math.inf",
    )  # fmt: skip
    add_wrong_call(
        "laws of the legs of an own walker",
        lambda: vrw.compare_laws({"period": [1.0], "period_error": [0.1]}, {"gravity": 9.81}),
        "TypeError", "vrw.WheelParams",
    )  # fmt: skip
    for name, keywords, words in (
        ("a prior without its width", {"priors": {"damping": 12.0}}, "(mean, standard deviation)"),
        ("text as extra unknown", {"extra": {"delay": "long"}}, "one real number"),
        ("a number as observe", {"observe": 3}, "observe is 3"),
    ):
        add_wrong_call(
            f"fit with {name}",
            lambda keywords=keywords: vrw.fit(
                {"period": [0.7], "period_error": [0.1]}, vrw.WheelParams(), ["damping"], **keywords
            ),
            "TypeError",
            words,
        )
    add_wrong_call(
        "a step of a HybridSystem from single numbers",
        lambda: make_drop().step({}, np.ones(2, np.float32)), "ValueError", "np.asarray(x, float)",
    )  # fmt: skip
    add_wrong_call(
        "simulate a HybridSystem with text",
        lambda: vrw.simulate({"g": "a"}, [1.0, 0.0], model=make_drop()), "TypeError", "parameter",
    )  # fmt: skip
    for label, law in {"a number": 5.0, "a class": vrw.SpringDamper}.items():
        add_wrong_call(
            f"legs in turn of {label}",
            lambda law=law: vrw.AlternatingLegs(law, vrw.SpringDamper()),
            "TypeError",
            "a law of AlternatingLegs",
        )

    # Functions compiled for batches
    scale = lanes.jit(lambda x, factor: x * factor)
    for label, arguments, in_axes in (
        ("a number without in_axes", (np.ones(2), 2.0), 0),
        ("a list", ([1.0, 2.0], np.ones(2)), 0),
        ("a tuple of axes that is too short", (np.ones(2), 2.0), (0,)),
    ):
        add_wrong_call(
            f"batch of {label}",
            functools.partial(scale.batch, *arguments, in_axes=in_axes),
            "ValueError",
            "give 0 or None for each argument",
        )
    add_wrong_call(
        "solve_fixed_point of a map elsewhere",
        lambda: vrw.solve_fixed_point(lambda x: x[:1], start),
        "ValueError",
        "an array of that shape",
    )
    add_wrong_call(
        "contacts that are no number",
        lambda: hybrid.enumerate_lcp_solutions([[np.nan]], [1.0]),
        "ValueError",
        "not finite",
    )

    # Branches
    bounds = {
        "one number": (200.0, "TypeError"), "three": ((1.0, 2.0, 3.0), "TypeError"),
        "turned": ((300.0, 100.0), "ValueError"), "equal": ((100.0, 100.0), "ValueError"),
        "text": (("a", "b"), "TypeError"), "nan": ((100.0, float("nan")), "ValueError"),
        "infinite": ((100.0, float("inf")), "ValueError"), "nothing": (None, "TypeError"),
    }  # fmt: skip
    evaluate_along = lambda **changes: vrw.continue_branch(
        **({"params": table_1, "name": "damping", "bounds": (100.0, 300.0)} | changes)
    )
    add_wrong_calls("continue_branch bounds", lambda v: evaluate_along(bounds=v), bounds, "bounds")
    add_wrong_calls(
        "continue_branch period_n", lambda v: evaluate_along(period_n=v), full_values, "period_n"
    )
    add_wrong_call(
        "continue_branch misspelt",
        lambda: evaluate_along(name="dampin"),
        "ValueError",
        "did you mean 'damping'",
    )
    add_wrong_call(
        "continue_branch along a number",
        lambda: evaluate_along(name=3),
        "ValueError",
        "no parameter",
    )
    add_wrong_call(
        "continue_branch along friction without effect",
        lambda: evaluate_along(name="friction"),
        "ValueError",
        "no parameter",
    )
    add_wrong_call(
        "continue_branch of a batch",
        lambda: evaluate_along(params=several),
        "ValueError",
        "continue_branches",
    )
    add_wrong_call(
        "continue_branch of a table", lambda: evaluate_along(params={}), "TypeError", "WheelParams"
    )
    add_wrong_call(
        "continue_branch of single numbers",
        lambda: evaluate_along(params=single),
        "ValueError",
        "vrw.start_jax()",
    )
    add_wrong_call(
        "continue_branch of two steps from nothing",
        lambda: evaluate_along(period_n=2),
        "ValueError",
        "cycle=",
    )
    add_wrong_call(
        "continue_branch from a state", lambda: evaluate_along(cycle=start), "TypeError", "cycle"
    )
    add_wrong_call(
        "continue_branch by options of a step",
        lambda: evaluate_along(options=vrw.StepOptions()),
        "TypeError",
        "ArclengthOptions",
    )
    add_wrong_call(
        "continue_branch by options of a mesh in the step's place",
        lambda: evaluate_along(step_options=vrw.CycleOptions()),
        "TypeError",
        "vrw.StepOptions",
    )
    add_wrong_call(
        "continue_branch by options of a step in the mesh's place",
        lambda: evaluate_along(cycle_options=vrw.StepOptions()),
        "TypeError",
        "CycleOptions",
    )
    a_map = lambda constants, x, p: p * x
    add_wrong_calls(
        "continue_map bounds", lambda v: vrw.continue_map(a_map, [0.1], 150.0, v), bounds, "bounds"
    )
    add_wrong_call(
        "continue_map from outside",
        lambda: vrw.continue_map(a_map, [0.1], 5.0, (0.0, 1.0)),
        "ValueError",
        "within",
    )
    add_wrong_call(
        "continue_map from text",
        lambda: vrw.continue_map(a_map, "a", 0.5, (0.0, 1.0)),
        "TypeError",
        "x is",
    )
    add_wrong_call(
        "continue_map of a number",
        lambda: vrw.continue_map(a_map, 0.1, 0.5, (0.0, 1.0)),
        "ValueError",
        "x has shape",
    )
    add_wrong_call(
        "continue_map in other units",
        lambda: vrw.continue_map(a_map, [0.1], 0.5, (0.0, 1.0), units=[1.0, 1.0]),
        "ValueError",
        "units are",
    )
    add_wrong_call(
        "continue_map of no map",
        lambda: vrw.continue_map(2.0, [0.1], 0.5, (0.0, 1.0)),
        "TypeError",
        "function",
    )

    # Basins
    grid = {"theta_touchdown": 0.09, "dtheta_touchdown": [1.0, 2.0], "dL1_touchdown": 0.0}
    add_wrong_call(
        "basin over a scan's grid",
        lambda: vrw.basin(table_1, vrw.grid(damping=[1.0, 2.0])),
        "TypeError",
        "theta_touchdown",
    )
    add_wrong_call(
        "basin over half a grid",
        lambda: vrw.basin(table_1, {"theta_touchdown": 0.1}),
        "ValueError",
        "must contain all",
    )
    for label, (value, kind) in {
        "text": ("a", "TypeError"), "nothing": (None, "TypeError"),
        "a table": (np.ones((2, 2)), "ValueError"), "no values": ([], "ValueError"),
    }.items():  # fmt: skip
        add_wrong_call(
            f"basin: {label}",
            lambda v=value: vrw.basin(table_1, grid | {"dtheta_touchdown": v}),
            kind,
            "dtheta_touchdown",
        )
    add_wrong_calls(
        "basin max_steps",
        lambda v: vrw.basin(table_1, grid, max_steps=v),
        full_values,
        "max_steps",
    )
    add_wrong_call("basin of a batch", lambda: vrw.basin(several, grid), "ValueError", "one wheel")
    add_wrong_call(
        "basin by options of a cycle",
        lambda: vrw.basin(table_1, grid, options=vrw.CycleOptions()),
        "TypeError",
        "vrw.StepOptions",
    )
    add_wrong_call(
        "basin of single numbers", lambda: vrw.basin(single, grid), "ValueError", "start_jax"
    )
    box = {"theta_touchdown": 0.1, "dtheta_touchdown": (1.0, 2.0), "dL1_touchdown": 0.0}
    add_wrong_call(
        "basin_share of half a box",
        lambda: vrw.basin_share(table_1, {"theta_touchdown": 0.1}),
        "ValueError",
        "must contain all",
    )
    add_wrong_call(
        "basin_share of unknown sampling",
        lambda: vrw.basin_share(table_1, box, sampling="sobel"),
        "ValueError",
        "did you mean 'sobol'",
    )
    add_wrong_call(
        "basin_share of a batch", lambda: vrw.basin_share(several, box), "ValueError", "one wheel"
    )
    add_wrong_calls(
        "basin_share max_steps",
        lambda v: vrw.basin_share(table_1, box, max_steps=v),
        full_values,
        "max_steps",
    )
    add_wrong_call(
        "smallest_disturbance from a state",
        lambda: vrw.smallest_disturbance(table_1, cycle=start),
        "TypeError",
        "cycle is",
    )
    add_wrong_call(
        "smallest_disturbance with contact",
        lambda: vrw.smallest_disturbance(table_1, model=vrw.UnilateralWheel()),
        "ValueError",
        "cannot begin within a step",
    )
    add_wrong_call(
        "basins along no branch",
        lambda: vrw.measure_basins(table_1),
        "TypeError",
        "continue_branch",
    )
    add_wrong_call(
        "gait sensitivity along no branch",
        lambda: vrw.measure_gait_sensitivity(table_1, "period"),
        "TypeError",
        "continue_branch",
    )

    # Tuning
    tune = lambda **changes: vrw.tune(
        **({"params": table_1, "objective": "speed", "free": ["damping"],
            "bounds": {"damping": (100.0, 300.0)}} | changes)
    )  # fmt: skip
    for name in ("max_evaluations", "n_starts"):
        add_wrong_calls(f"tune {name}", lambda v, n=name: tune(**{n: v}), full_values, name)
    add_wrong_calls("tune tolerance", lambda v: tune(tolerance=v), positive, "tolerance")
    add_wrong_calls(
        "tune bounds of damping", lambda v: tune(bounds={"damping": v}), bounds, "damping"
    )
    add_wrong_call(
        "tune bounds of no table", lambda: tune(bounds=(100.0, 300.0)), "TypeError", "bounds"
    )
    add_wrong_call(
        "tune bounds out of the domain",
        lambda: tune(bounds={"damping": (-5.0, 300.0)}),
        "ValueError",
        "inside",
    )
    add_wrong_call(
        "tune free misspelt", lambda: tune(free=["dampin"]), "ValueError", "did you mean"
    )
    add_wrong_call(
        "tune free twice", lambda: tune(free=["damping", "damping"]), "ValueError", "twice"
    )
    add_wrong_call("tune along a name", lambda: tune(along=("slope",)), "ValueError", "along has 1")
    add_wrong_call("tune nothing", lambda: tune(free=[]), "ValueError", "no parameter")
    add_wrong_call("tune a number", lambda: tune(free=3), "TypeError", "free")
    add_wrong_call(
        "tune for a typo", lambda: tune(objective="spead"), "ValueError", "did you mean 'speed'"
    )
    add_wrong_call("tune for a number", lambda: tune(objective=3.0), "TypeError", "objective")
    add_wrong_call("tune for nothing", lambda: tune(objective={}), "ValueError", "empty")
    add_wrong_call(
        "tune for a weight of text", lambda: tune(objective={"speed": "1"}), "TypeError", "weight"
    )
    add_wrong_call(
        "tune for several numbers",
        lambda: tune(objective=lambda cycle: cycle.durations),
        "ValueError",
        "one number",
    )
    add_wrong_call(
        "tune for a word", lambda: tune(objective=lambda cycle: "fast"), "TypeError", "objective"
    )
    add_wrong_call(
        "tune under nan",
        lambda: tune(constraints={"contraction": float("nan")}),
        "ValueError",
        "finite",
    )
    add_wrong_call(
        "tune under a typo", lambda: tune(constraints=["contractio"]), "ValueError", "did you mean"
    )
    add_wrong_call("tune under a number", lambda: tune(constraints=3), "TypeError", "constraints")
    add_wrong_call("tune a batch", lambda: tune(params=several), "ValueError", "one wheel")
    add_wrong_call(
        "tune a table", lambda: tune(params={"damping": 200.0}), "TypeError", "WheelParams"
    )
    add_wrong_call(
        "tune single numbers", lambda: tune(params=single), "ValueError", "vrw.start_jax()"
    )
    add_wrong_call(
        "tune a rigid wheel", lambda: tune(model=vrw.RigidWheel()), "TypeError", "compliant"
    )
    add_wrong_call(
        "tune from where nothing walks",
        lambda: tune(params=vrw.WheelParams(slope=0.02)),
        "NoGaitError",
        "no gait",
    )
    add_wrong_call(
        "tune by options of a mesh",
        lambda: tune(options=vrw.CycleOptions()),
        "TypeError",
        "vrw.StepOptions",
    )

    # Designs and scans
    columns = {
        "text": ("fast", "TypeError"), "texts": (["1", "2"], "TypeError"),
        "complex": ([1.0, 2j], "TypeError"), "references": ([True, False], "TypeError"),
        "nothing": (None, "TypeError"), "no values": ([], "ValueError"),
        "a table": (np.ones((2, 2)), "ValueError"),
        "masked": (np.ma.array([150.0, 1e9], mask=[0, 1]), "TypeError"),
        "a masked entry in a list": ([150.0, np.ma.masked], "TypeError"),
    }  # fmt: skip
    add_wrong_calls("grid", lambda v: vrw.grid(damping=v), columns, "damping")
    add_wrong_calls("samples", lambda v: vrw.samples({"damping": v}), columns, "damping")
    for name in ("sobol", "uniform", "saltelli"):
        draw = getattr(vrw, name)
        add_wrong_calls(
            f"{name} n", lambda v, d=draw: d({"damping": (100.0, 200.0)}, v), full_values, "n is"
        )
        add_wrong_call(
            f"{name} seed",
            lambda d=draw: d({"damping": (1.0, 2.0)}, 4, seed=0.5),
            "ValueError",
            "seed",
        )
        add_wrong_call(
            f"{name} of too many",
            lambda d=draw: d({"damping": (1.0, 2.0)}, 2 * 10**10),
            "ValueError",
            "fewer",
        )
    add_wrong_calls("sobol range", lambda v: vrw.sobol({"damping": v}, 4), bounds, "damping")
    add_wrong_call(
        "a design of no table", lambda: vrw.sobol(["damping"], 4), "TypeError", "the design"
    )
    add_wrong_call("a design of nothing", lambda: vrw.grid(), "ValueError", "at least one")
    add_wrong_call(
        "a design misspelt",
        lambda: vrw.scan(vrw.grid(dampin=[1.0])),
        "ValueError",
        "did you mean",
    )
    add_wrong_call(
        "a grid with a value twice", lambda: vrw.grid(damping=[1.0, 1.0]), "ValueError", "twice"
    )
    add_wrong_call(
        "columns of two lengths",
        lambda: vrw.samples({"damping": [1.0], "slope": [0.1, 0.2]}),
        "ValueError",
        "one length",
    )
    small = vrw.grid(damping=[150.0, 200.0])
    scan = lambda **changes: vrw.scan(**({"design": small} | changes))
    add_wrong_calls(
        "scan chunk",
        lambda v: scan(chunk=v),
        {k: v for k, v in full_values.items() if k != "nothing"},
        "chunk",
    )
    add_wrong_call(
        "scan over a table", lambda: scan(design={"damping": [1.0]}), "TypeError", "vrw.grid"
    )
    add_wrong_call(
        "scan for a typo", lambda: scan(measures="spead"), "ValueError", "did you mean 'speed'"
    )
    add_wrong_call("scan for a number", lambda: scan(measures=3), "TypeError", "measures")
    add_wrong_call("scan for numbers", lambda: scan(measures=[3]), "TypeError", "measures")
    add_wrong_call(
        "scan with contact and options of collocation",
        lambda: scan(model=vrw.UnilateralWheel(), cycle_options=vrw.CycleOptions()),
        "ValueError",
        "cycle_options",
    )
    add_wrong_call("scan of a batch", lambda: scan(base=several), "ValueError", "one wheel")
    add_wrong_call("scan of a table", lambda: scan(base={"slope": 0.3}), "TypeError", "WheelParams")
    add_wrong_call(
        "scan of single numbers", lambda: scan(base=single), "ValueError", "vrw.start_jax()"
    )
    add_wrong_call(
        "scan of rigid wheels", lambda: scan(model=vrw.RigidWheel()), "TypeError", "compliant"
    )
    add_wrong_call(
        "scan by options of a mesh",
        lambda: scan(options=vrw.CycleOptions()),
        "TypeError",
        "vrw.StepOptions",
    )
    add_wrong_call(
        "scan by options of a step in the mesh's place",
        lambda: scan(cycle_options=vrw.StepOptions()),
        "TypeError",
        "CycleOptions",
    )
    add_wrong_call(
        "scan over friction without effect",
        lambda: scan(design=vrw.grid(friction=[0.5, 0.7])),
        "ValueError",
        "friction",
    )
    masked = np.ma.array([1.0, 2.0], mask=[0, 1])
    add_wrong_call(
        "constants of a map that are masked",
        lambda: vrw.continue_map(lambda c, x, p: x, [0.0], 0.5, (0.0, 1.0), constants=[masked]),
        "TypeError", "constants has masked entries",
    )  # fmt: skip
    add_wrong_call(
        "a masked gap",
        lambda: hybrid.enumerate_lcp_solutions(np.eye(2), masked), "TypeError", "masked entries",
    )  # fmt: skip
    add_wrong_call(
        "indices of what is no saltelli scan",
        lambda: vrw.sobol_indices(vrw.simulate(table_1, n_steps=1)),
        "ValueError",
        "saltelli",
    )
    many = {"table": ({}, "TypeError"), "nothing": (None, "TypeError")}
    add_wrong_calls("default_margins", lambda v: vrw.default_margins(v), many, "params")
    add_wrong_call(
        "default_margins of a batch",
        lambda: vrw.default_margins(several),
        "ValueError",
        "one wheel",
    )
    add_wrong_calls(
        "open_scan", lambda v: vrw.open_scan(v), many | {"number": (3, "TypeError")}, "path"
    )
    urls = {
        url: (url, "ValueError")
        for url in ("s3://wheels/scan.zarr", "gs://wheels", "memory://wheels",
                    Path("/wheels").as_uri(), "simplecache::s3://wheels", Path("s3://wheels/scan.zarr"))
    }  # fmt: skip
    for name, call in {
        "scan into": lambda v: scan(store=v), "open_scan of": vrw.open_scan,
        "map into": lambda v: vrw.map_special_points(
            vrw.grid(damping=[100.0, 150.0], slope=[0.28, 0.3]), store=v
        ),
        "a figure into": lambda v: vrw.plot.save(None, v, "figure"), "a cache in": vrw.start_jax,
    }.items():  # fmt: skip
        add_wrong_calls(name, call, urls, "a URL")
        nobody = {"nobody's home": ("~nobody_of_this_name/x", "ValueError")}
        add_wrong_calls(name, call, nobody, "no such user: write './~nobody")
    unencodable = "wheels\ud800"  # half of a surrogate pair, which no file name contains
    add_wrong_calls(
        "open_scan verify",
        lambda v: vrw.open_scan("nowhere", verify=v),
        {"array": (np.array([1, 0]), "TypeError"), "key": (jax.random.key(0), "TypeError")},
        "verify",
    )
    add_wrong_call(
        "open_scan of a name without an encoding",
        lambda: vrw.open_scan(unencodable),
        "ValueError",
        "cannot encode",
    )
    add_wrong_call(
        "scan into a name without an encoding",
        lambda: scan(store=unencodable),
        "ValueError",
        "cannot encode",
    )
    add_wrong_call(
        "scan into a store without a name", lambda: scan(store=""), "ValueError", "store is ''"
    )
    add_wrong_call(
        "scan into a name with a null character",
        lambda: scan(store="a\0b.zarr"),
        "ValueError",
        "cannot have this name",
    )
    add_wrong_call(
        "solve_fixed_point with one invariant outside a list",
        lambda: vrw.solve_fixed_point(lambda x: x, start, invariants=jnp.sum),
        "TypeError",
        "give a list of functions",
    )
    add_wrong_call(
        "solve_fixed_point tolerance of a random key",
        lambda: vrw.solve_fixed_point(lambda x: x, start, tolerance=jax.random.key(0)),
        "TypeError",
        "tolerance",
    )
    add_wrong_call("explore a table", lambda: vrw.explore(dataset={}), "TypeError", "dataset is {}")
    add_wrong_calls(
        "solve_fixed_point tolerance",
        lambda v: vrw.solve_fixed_point(lambda x: x, start, tolerance=v),
        positive,
        "tolerance",
    )

    # Borders in two parameters: all but the gait itself is looked at first
    def curve(name="lambda_4_plus", parameters=("damping", "slope"), cycle=table_1, **given):
        return vrw.continue_special_point(name, parameters, cycle, **given)

    pairs = {
        "one": ("damping", "ValueError"),
        "three": (("damping", "slope", "stiffness"), "ValueError"),
        "twice one": (("slope", "slope"), "ValueError"), "number": (3, "TypeError"),
        "misspelt": (("dampin", "slope"), "ValueError"),
        "friction": (("slope", "friction"), "ValueError"),
    }  # fmt: skip
    add_wrong_calls("continue_special_point of", lambda v: curve(parameters=v), pairs, "parameter")
    boxes = {
        "list": ([1.0, 2.0], "TypeError"), "one number": ({"slope": 0.3}, "TypeError"),
        "misspelt": ({"slop": (0.1, 0.2)}, "ValueError"),
        "empty": ({"slope": (0.3, 0.3)}, "ValueError"),
    }  # fmt: skip
    add_wrong_calls("continue_special_point bounds", lambda v: curve(bounds=v), boxes, "")
    add_wrong_call("continue_special_point of a wheel", curve, "TypeError", "cycle is")

    # Pictures
    plot = vrw.plot
    nothing = many | {"another's dataset": (xr.Dataset(), "ValueError")}
    pictures = {
        "gait_panels": plot.gait_panels, "sticks": plot.sticks, "indicators": plot.indicators,
        "walk_frames": plot.walk_frames, "scan_figures": plot.scan_figures,
        "map_figure": lambda v: plot.map_figure(v, "speed", []),
    }  # fmt: skip
    for name, draw in pictures.items():
        add_wrong_calls(f"plot {name}", draw, nothing, "")
    lists = many | {
        "one alone": (xr.Dataset(), "TypeError"),
        "none": ([], "ValueError"),
    }
    for name, draw in {
        "foot_height": plot.foot_height, "rear_force": plot.rear_force,
        "basin_figure": lambda v: plot.basin_figure(v, ["any"]),
    }.items():  # fmt: skip
        add_wrong_calls(f"plot {name}", draw, lists, "")
    for name, draw in {
        "branch_figure": plot.branch_figure,
        "tuning_figure": plot.tuning_figure,
    }.items():
        add_wrong_calls(f"plot {name}", draw, many, "")

    walks = [vrw.simulate(table_1, n_steps=1)]
    for name in ("foot_height", "rear_force"):
        add_wrong_call(
            f"plot {name} over a misspelt parameter",
            lambda name=name: getattr(plot, name)(walks, "dampin"), "ValueError", "'damping'",
        )  # fmt: skip
    add_wrong_call(
        "an animation that is no GIF file",
        lambda: plot.save_animation([], 40, "walk.xyz"), "ValueError", ".gif",
    )  # fmt: skip
    add_wrong_call(
        "measures of a gait without names",
        lambda: vrw.limit_cycle(table_1).measures(), "TypeError", "give names",
    )  # fmt: skip

    add_wrong_call(
        "a name that is not there", lambda: vrw.limit_cycel, "AttributeError", "limit_cycle"
    )
    add_wrong_call("indices of a table", lambda: vrw.sobol_indices({}), "TypeError", "scan")


def run_wrong_calls() -> dict[str, tuple[str, str, str]]:
    register_wrong_calls()
    messages = {}
    for name, wrong_call in WRONG_CALLS.items():
        try:
            wrong_call.call()
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1].filename
            messages[name] = (type(error).__name__, str(error), last)
        else:
            messages[name] = ("nothing", "", "")
    return messages


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent.parent))
    import vrw_jax

    vrw_jax.start_jax(sys.argv[1])
    print(json.dumps(run_wrong_calls()))
