"""A key changes with everything on which a function depends; without one nothing is reused."""

import functools
import operator
import re
import subprocess
import sys
import types
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.machine_code import CodeRegistrySpy, use_cache_folder
from support.walkers import BALL_SYSTEM

import vrw_jax as vrw
from vrw_jax import lanes
from vrw_jax.base.walker import compile_step
from vrw_jax.branches.continuation_problems import make_trial_linearizer
from vrw_jax.flow.hybrid_simulation import simulate_modes
from vrw_jax.flow.hybrid_system import (
    _compile_mode_measures,
    _compile_sampling,
    compile_finish,
    compile_simulation,
)
from vrw_jax.flow.orbits import (
    _estimate_time_errors,
    _integrate_flow_segments,
    _multiply_event_determinants,
)
from vrw_jax.gaits.collocation_search import run_search_attempts
from vrw_jax.gaits.derivatives import _compute_collocation_tangents
from vrw_jax.gaits.fixed_points import _find_fixed_point_of_iterate
from vrw_jax.gaits.force_peaks import _compute_peak_derivatives, _locate_force_peaks
from vrw_jax.gaits.limit_cycle_result import solve_limit_cycle
from vrw_jax.gaits.phase_sequence import CollocationSystem
from vrw_jax.gaits.walker_finder import _find_gaits
from vrw_jax.lanes.keys import UnresolvableFunctionError, make_key
from vrw_jax.models.contact_kernel import run_walks
from vrw_jax.models.contact_record import embed_section_state
from vrw_jax.models.contact_walks import (
    _compile_section_function,
    _make_static_walk_settings,
    _run_lane_walks,
    prepare_walk,
)
from vrw_jax.models.phase_sequence import make_step_result
from vrw_jax.models.step_batch import _compile_lane_step
from vrw_jax.models.unilateral_wheel import sample_contact_interval
from vrw_jax.models.viscoelastic import (
    _finish_steps,
    _sample_lane_parts,
    _sample_lane_steps,
    take_steps_of_lanes,
)
from vrw_jax.wheel.params import NO_LAWS

GRAVITY = 9.81
moon = types.ModuleType("moon")
moon.gravity, moon.inner = 1.62, types.ModuleType("inner")
moon.inner.scale = 1.0


class Ground:
    """A mutable object of a user, with constants in its class, its instance and a method."""

    restitution = 0.8

    def __init__(self, slope):
        self.slope = slope

    def bounce(self, x):
        return self.restitution * x

    def __getattr__(self, name):
        return {"depth": 2.0}[name]


class Law(eqx.Module):
    stiffness: float = 500.0
    name: str = eqx.field(static=True, default="linear")

    def __call__(self, x):
        return self.stiffness * x if self.name == "linear" else x**3


def scale_by(value):
    return lambda x: value * x


def change_default(x, factor=(2.0,)):
    return factor[0] * x


ground, table, nested = Ground(0.1), np.array([1.0, 2.0]), {"a": [1.0, {2.0}]}
helper = scale_by(3.0)


def call_helper(x):
    return helper(x) + GRAVITY


READERS = {
    "a global name": (lambda x: GRAVITY * x, lambda: globals().update(GRAVITY=1.62)),
    "an attribute of a module": (lambda x: moon.gravity * x, lambda: setattr(moon, "gravity", 3.0)),
    "a module inside a module": (
        lambda x: moon.inner.scale * x,
        lambda: setattr(moon.inner, "scale", 3.0),
    ),
    "an attribute of an object": (
        lambda x: ground.slope * x,
        lambda: setattr(ground, "slope", 1.0),
    ),
    "an attribute of a class": (
        lambda x: Ground.restitution * x,
        lambda: setattr(Ground, "restitution", 0.5),
    ),
    "a constant read by a method": (ground.bounce, lambda: setattr(Ground, "restitution", 0.4)),
    "an entry of an array": (lambda x: table[1] * x, lambda: operator.setitem(table, 1, 5.0)),
    "a number deep in a container": (
        lambda x: x + nested["a"][0],
        lambda: operator.setitem(nested["a"], 0, 7.0),
    ),
    "a function that a function calls": (
        call_helper,
        lambda: globals().update(helper=scale_by(4.0)),
    ),
    "the code of a method": (
        ground.bounce,
        lambda: setattr(Ground, "bounce", lambda self, x: x + self.slope),
    ),
    "a default value": (
        change_default,
        lambda: setattr(change_default, "__defaults__", ((3.0,),)),
    ),
    "an attribute of a function": (
        lambda x: x * getattr_free(x),
        lambda: setattr(getattr_free, "factor", 4.0),
    ),
}


def getattr_free(x):
    return getattr_free.factor


getattr_free.factor = 2.0


@pytest.mark.parametrize("what", READERS)
def test_a_change_of_what_a_function_reads_changes_its_key(what):
    function, change = READERS[what]
    before = make_key(function)
    assert make_key(function) == before
    change()
    assert make_key(function) != before


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (scale_by(2.0), scale_by(3.0)),
        (scale_by(2.0), scale_by(2)),
        (scale_by(0.0), scale_by(-0.0)),
        (scale_by("2"), scale_by(2)),
        (scale_by(True), scale_by(1)),
        (scale_by(np.float32(2)), scale_by(np.float64(2))),
        (scale_by(np.ones(2)), scale_by(np.ones((2, 1)))),
        (scale_by(jnp.ones(2)), scale_by(np.ones(2))),
        (scale_by((1, 2)), scale_by([1, 2])),
        (scale_by({"a": 1, "b": 2}), scale_by({"b": 2, "a": 1})),
        (scale_by(math_by_name := jnp.sin), scale_by(jnp.cos)),
        (scale_by(Law(1.0)), scale_by(Law(2.0))),
        (scale_by(Law(1.0)), scale_by(Law(1.0, name="cubic"))),
        (scale_by(vrw.ViscoelasticWheel()), scale_by(vrw.ViscoelasticWheel(friction=0.5))),
        (scale_by(vrw.ViscoelasticWheel()), scale_by(vrw.RigidWheel())),
        (functools.partial(operator.add, 1), functools.partial(operator.add, 2)),
        (functools.partial(operator.add, 1), functools.partial(operator.mul, 1)),
        (lambda x: x + 1.0, lambda x: x - 1.0),
        (lambda x: x + 1.0, lambda x: x + 2.0),
        (lambda x, y: x / y, lambda y, x: x / y),
        (jax.jit(scale_by(2.0)), jax.jit(scale_by(3.0))),
        (jax.vmap(scale_by(2.0)), jax.vmap(scale_by(2.0), 1)),
        (jax.grad(scale_by(2.0)), jax.jacfwd(scale_by(2.0))),
    ],
)
def test_different_values_have_different_keys(first, second):
    assert make_key(first) != make_key(second)


@pytest.mark.parametrize(
    "make",
    [
        lambda: scale_by(2.0),
        lambda: scale_by({"b": (1, None), "a": {3, 4}}),
        lambda: scale_by(Law(3.0)),
        lambda: Law(3.0).__call__,
        lambda: jax.jit(scale_by(np.arange(3.0))),
        lambda: scale_by(jax.tree.structure(vrw.WheelParams())),
        lambda: functools.partial(scale_by(2.0), x=1.0),
    ],
)
def test_equal_functions_that_are_made_again_have_equal_keys(make):
    assert make_key(make()) == make_key(make())


@functools.wraps(jnp.sin)
def disguised(x):
    return GRAVITY * x


def test_a_function_disguised_as_one_of_a_library_is_read_like_others():
    before = make_key(disguised)
    globals().update(GRAVITY=GRAVITY + 1.0)
    assert disguised.__module__ == jnp.sin.__module__
    assert make_key(disguised) != before


def test_a_class_of_a_module_whose_name_begins_like_a_library_is_read_by_content():
    names = {"__module__": "jaxmodel", "g": 9.81}
    law = type("Law", (), names)()
    function = scale_by(law)
    before = make_key(function)
    law.g = 1.62
    assert make_key(function) != before


def read_by_name(x):
    return getattr(moon, "gravity") * x  # noqa: B009


def read_scope(x):
    return globals()["GRAVITY"] * x


def read_module_later(x):
    other = moon
    return other.gravity * x


def import_later(x):
    import support.hostile as hostile

    return len(hostile.__name__) * x


def set_global(x):
    global GRAVITY
    GRAVITY = 1.0
    return x


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (read_by_name, "it calls getattr"),
        (read_scope, "it calls globals"),
        (read_module_later, "the module moon as a value"),
        (import_later, "it imports support.hostile"),
        (set_global, "it sets the global name GRAVITY"),
        (lambda x: np.random.standard_normal() * x, "random"),  # noqa: NPY002
        (lambda x: np.loadtxt("gravity.txt") * x, "numpy.loadtxt"),
        (scale_by(operator.attrgetter("gravity")), "attrgetter"),
        (scale_by(moon), "the module moon as a value"),
        (scale_by(iter([1])), "list_iterator"),
        (scale_by(np.array([None, 1], object)), "an array of objects"),
    ],
)
def test_what_cannot_be_found_without_running_has_no_key(function, sentence):
    with pytest.raises(UnresolvableFunctionError, match=sentence):
        make_key(function)


def test_a_function_without_a_key_is_traced_at_each_call_and_never_saved(tmp_path, monkeypatch):
    spy = CodeRegistrySpy(monkeypatch)
    with use_cache_folder(tmp_path):
        for gravity in (9.81, 1.62):
            monkeypatch.setattr(moon, "gravity", gravity)
            result = lanes.compile_batch_function(read_by_name).run(np.ones(3))
            np.testing.assert_array_equal(result, np.full(3, gravity))
            np.testing.assert_array_equal(lanes.jit(read_by_name).batch(np.ones(3)), result)
        assert spy.n_traces == 4
        # JAX keeps its own operations there.
        assert not [*tmp_path.glob("lanes_*"), *tmp_path.glob("vrw_*")]


def test_keys_are_the_same_in_every_process():
    lines = """
        import jax, jax.numpy as jnp, numpy as np
        import vrw_jax as vrw
        from vrw_jax.lanes.keys import make_key
        law = lambda x, c={"b": {1, 2}, "a": np.arange(2.0)}: jnp.sin(x) + len(c)
        model = vrw.UnilateralWheel(friction=0.5)
        structure = jax.tree.structure(vrw.WheelParams())
        print(make_key(law, model.__class__, vrw.StepOptions, structure))
    """
    code = "\n".join(line[8:] for line in lines.splitlines())
    outputs = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)},
            capture_output=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(outputs) == 1


def change_settings(value):
    """Yield copies of settings in which one number, flag, text or function is another one, at any
    depth.
    """
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, int | float):
        yield value + 1
    elif isinstance(value, str):
        yield f"{value}x"
    elif value is None:
        yield 0
    elif isinstance(value, tuple):
        make = getattr(type(value), "_make", tuple)
        for i, entry in enumerate(value):
            for changed in change_settings(entry):
                yield make([*value[:i], changed, *value[i + 1 :]])
    elif isinstance(value, dict):
        for name, entry in value.items():
            for changed in change_settings(entry):
                yield value | {name: changed}
            yield {f"{other}x" if other == name else other: x for other, x in value.items()}
    elif isinstance(value, np.ndarray | jax.Array):
        yield value + 1
    elif isinstance(value, jax.tree_util.PyTreeDef):
        yield jax.tree.structure([0.0] * (value.num_leaves + 1))
    elif isinstance(value, functools.partial):
        for changed in change_settings(value.args):
            yield functools.partial(value.func, *changed)
        yield functools.partial(lambda *_: 5.0, *value.args)
    elif isinstance(value, types.FunctionType):
        yield lambda *_: 5.0
    else:
        for name in vars(value):
            for changed in change_settings(vars(value)[name]):
                copied = object.__new__(type(value))
                vars(copied).update(vars(value) | {name: changed})
                yield copied


def hold(settings):
    return lambda: settings


SYSTEM = CollocationSystem(8, 1, vrw.CycleOptions())
ACTION = vrw.measure("action", phase="flight", reduction="integral")(lambda y, p: y[1] ** 2)
MODES = (
    vrw.hybrid.Mode(
        lambda y: -y, (vrw.hybrid.Guard(lambda y: y[0] - 1.0, lambda y: 2.0 * y, None, None),)
    ),
)
WALK_SETTINGS = _make_static_walk_settings(vrw.UnilateralWheel(), vrw.StepOptions(), 8, True, 12)


@pytest.mark.parametrize(
    ("compiled", "settings"),
    [
        (run_search_attempts, SYSTEM),
        (_compute_collocation_tangents, SYSTEM),
        (_locate_force_peaks, SYSTEM),
        (_compute_peak_derivatives, SYSTEM),
        (make_trial_linearizer, (SYSTEM, (0, 1))),
        (lanes.make_leaf_function, (jax.tree.structure(vrw.StepOptions()), True, 0.7)),
        (take_steps_of_lanes, (True, 0.7)),
        (_finish_steps, (True, 1, True)),
        (_sample_lane_steps, (True, 40)),
        (_sample_lane_parts, (True, 40)),
        (run_walks, WALK_SETTINGS),
        (_run_lane_walks, WALK_SETTINGS),
        (prepare_walk, (True, "lanes", False, False)),
        (sample_contact_interval, (vrw.UnilateralWheel(restitution=0.5), 40)),
        (make_step_result, (vrw.ViscoelasticWheel(friction=0.4), 40)),
        (solve_limit_cycle, (vrw.LadderWheel(), vrw.RigidWheel(), "cycle")),
        (_find_gaits, (BALL_SYSTEM, 1)),
        (simulate_modes, (MODES, 3)),
        (_estimate_time_errors, MODES),
        (_multiply_event_determinants, MODES),
        (_integrate_flow_segments, (MODES[0].field, 4, 2)),
        (_find_fixed_point_of_iterate, (MODES[0].field, 1, (MODES[0].field,), 30, False)),
    ],
)
def test_each_setting_of_a_compiled_function_is_part_of_its_key(compiled, settings):
    keys = [make_key(functools.partial(compiled, settings))]
    if isinstance(settings, tuple) and isinstance(settings[0], jax.tree_util.PyTreeDef):
        structure, *others = settings
        changed = [(structure, *x) for x in change_settings(tuple(others))]
        changed.append((jax.tree.structure(vrw.StepOptions(solver="Kvaerno5")), *others))
    else:
        changed = list(change_settings(settings))
    keys += [make_key(functools.partial(compiled, x)) for x in changed]
    assert len(set(keys)) == len(keys) > 2
    # A function without arguments may hold the settings.
    keys = [make_key(hold(x)) for x in (settings, *changed)]
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize(
    ("compile_function", "settings"),
    [
        (compile_step, (BALL_SYSTEM,)),
        (compile_finish, (BALL_SYSTEM,)),
        (_compile_sampling, (BALL_SYSTEM, 9)),
        (compile_simulation, (BALL_SYSTEM, 3, 0)),
        (_compile_mode_measures, (BALL_SYSTEM, (ACTION,))),
        (_compile_lane_step, (True, jax.tree.structure(NO_LAWS), 8, (0, 1), 0)),
        (_compile_section_function, (embed_section_state, 8)),
    ],
)
def test_each_setting_of_a_function_that_is_compiled_from_it_is_part_of_its_key(
    compile_function, settings
):
    compile_anew = compile_function.__wrapped__
    settings_and_changes = [settings]
    for i, setting in enumerate(settings):
        for changed in change_settings(setting):
            settings_and_changes.append((*settings[:i], changed, *settings[i + 1 :]))
    keys = []
    for arguments in settings_and_changes:
        try:
            compiled = compile_anew(*arguments)
        except (TypeError, ValueError, KeyError, AttributeError, IndexError):
            continue  # settings without meaning, which compile nothing
        # Programs are also kept by the largest array that is unrolled.
        unrolled = getattr(compiled, "_max_unrolled_entries", 0)
        keys.append((make_key(compiled._function), unrolled))
    assert len(set(keys)) == len(keys) > 2


COMPILERS = re.compile(
    r"@lanes\.jit\b|(?<!def )(?<!@)\b(?:lanes\.jit|jit_batch|compile_batch_function"
    r"|call_compiled_program|get_compiled_program)\("
)


def test_no_other_function_is_compiled():
    """A new place that compiles a function belongs into the two tests above."""
    package = Path(vrw.__file__).parent
    counts = {
        str(file.relative_to(package)): len(COMPILERS.findall(file.read_text()))
        for file in package.rglob("*.py")
        if "lanes" not in file.parts
    }
    assert {name: count for name, count in counts.items() if count} == {
        "base/walker.py": 1,
        "branches/continuation_problems.py": 1,
        "flow/hybrid_simulation.py": 2,
        "flow/hybrid_system.py": 4,
        "flow/orbits.py": 4,
        "gaits/derivatives.py": 1,
        "gaits/fixed_points.py": 1,
        "gaits/force_peaks.py": 1,
        "gaits/walker_finder.py": 1,
        "models/contact_walks.py": 3,
        "models/step_batch.py": 1,
        "models/unilateral_wheel.py": 2,
        "models/viscoelastic.py": 3,
    }
