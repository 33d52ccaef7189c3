"""The house keeps its rules, each rule sees what breaks it, and importing anything does nothing."""

import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest
from support import rules
from support.rooms import ImportGraph

import vrw_jax

ROOT = Path(__file__).parent.parent
IMPORT_GRAPH = ImportGraph(Path(vrw_jax.__file__).parent)


@pytest.mark.parametrize("rule", rules.IMPORT_RULES, ids=lambda rule: rule.__name__)
def test_the_package_keeps_the_import_rule(rule):
    assert not rule(IMPORT_GRAPH), "\n" + "\n".join(rule(IMPORT_GRAPH))


def test_exported_names_are_imported_elsewhere():
    folders = (ROOT / "tests", ROOT / "experiments")
    outside = [path.read_text() for folder in folders for path in folder.rglob("*.py")]
    idle = rules.find_unused_exports(IMPORT_GRAPH, outside)
    assert not idle, "\n" + "\n".join(idle)


# Small packages made up for the rules: {file: source}. `house` has two rooms, wheel below walks,
# and keeps every rule until a case adds or replaces files.
VALID_PACKAGE = {
    "__init__.py": "from house.walks import step\n",
    "runtime/__init__.py": "from house.runtime.lazy_import import library\n",
    "runtime/lazy_import.py": "import importlib\n\nlibrary = lambda name: importlib.import_module(name)\n",
    "wheel/__init__.py": "from house.wheel.params import Params\n",
    "wheel/params.py": "class Params: ...\n",
    "models/__init__.py": "from house.models.base import AbstractRung\n"
    "from house.models.stiff import Stiff\n",
    "models/base.py": "class AbstractRung: ...\n",
    "models/stiff.py": "from house.models.base import AbstractRung\n\n\n"
    "class Stiff(AbstractRung): ...\n",
    "walks/__init__.py": "from house.walks.stepping import step\n",
    "walks/stepping.py": "from house.models import AbstractRung, Stiff\n"
    "from house.wheel import Params\n\n\n"
    "def step():\n    return isinstance(Stiff(Params), AbstractRung)\n",
}


def make_import_graph(folder, changes):
    """The made-up package, read."""
    for name, text in {**VALID_PACKAGE, **changes}.items():
        path = folder / "house" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return ImportGraph(folder / "house")


def test_every_rule_accepts_a_valid_package(tmp_path):
    sound = make_import_graph(tmp_path, {})
    assert [rule(sound) for rule in rules.IMPORT_RULES] == [[]] * len(rules.IMPORT_RULES)


UPWARD_IMPORTS = {
    "at the top": "from house.walks import step",
    "plain": "import house.walks",
    "under a name": "import house.walks.stepping as w",
    "of a module": "from house.walks import stepping",
    "inside a function": "def f():\n    from house.walks import step",
    "for types only": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import house.walks",
    "of the room from the package": "from house import walks",
    "relative": "from ..walks import step",
    "relative to the package": "from .. import walks",
    "by name": "import importlib\nimportlib.import_module('house.walks')",
    "by a name of its own": "from importlib import import_module as m\nm('house.walks.stepping')",
    "by a string handed on": "NAMES = ('house.walks',)",
    "of a name below": "from house.walks.stepping import step",
    "of the package's face": "import house as h\n\n\ndef f():\n    return h.step()",
}


@pytest.mark.parametrize("text", UPWARD_IMPORTS.values(), ids=UPWARD_IMPORTS)
def test_an_upward_import_is_found_in_every_form(text, tmp_path):
    broken = make_import_graph(tmp_path, {"wheel/params.py": f"{text}\n\n\nclass Params: ...\n"})
    assert any("house.wheel.params" in line for line in rules.find_upward_imports(broken)), (
        broken.edges
    )


def test_packages_of_one_layer_do_not_import_each_other(tmp_path):
    files = {
        "batches/__init__.py": "", "batches/batch.py": "from house.cycles import find\n",
        "cycles/__init__.py": "from house.cycles.cycle import find\n",
        "cycles/cycle.py": "def find(): ...\n",
    }  # fmt: skip
    assert rules.find_upward_imports(make_import_graph(tmp_path, files))


def test_a_package_outside_the_layers_is_found(tmp_path):
    files = {"attic/__init__.py": "", "loose.py": ""}
    solution = rules.find_upward_imports(make_import_graph(tmp_path, files))
    assert [line.split()[0] for line in solution] == ["attic", "loose"]


def test_an_import_cycle_through_an_init_file_is_found(tmp_path):
    inner = "def f():\n    from house.wheel import Params\n    return Params\n\n\n"
    files = {
        "wheel/__init__.py": "from house.wheel.params import Params\n"
        "from house.wheel.phase import g\n",
        "wheel/phase.py": inner + "def g(): ...\n",
    }
    assert rules.find_import_cycles(make_import_graph(tmp_path, files)) == [
        "house.wheel -> house.wheel.phase -> house.wheel"
    ]


def test_an_import_cycle_of_two_modules_is_found(tmp_path):
    files = {
        "wheel/params.py": "def f():\n    from house.wheel import phase\n\n\nclass Params: ...\n",
        "wheel/phase.py": "from house.wheel.params import Params\n",
    }
    assert rules.find_import_cycles(make_import_graph(tmp_path, files)) == [
        "house.wheel.params -> house.wheel.phase -> house.wheel.params"
    ]


def test_an_import_leads_to_the_module_that_defines_the_name(tmp_path):
    read = make_import_graph(tmp_path, {})
    targets = {arrow.target for arrow in read.edges if arrow.source == "house.walks.stepping"}
    assert targets == {
        "house.wheel", "house.wheel.params", "house.models", "house.models.base",
        "house.models.stiff",
    }  # fmt: skip


BYPASSED_INIT_FILES = {
    "deep": "from house.wheel.params import Params",
    "plain": "import house.wheel.params",
    "module not handed out": "from house.wheel import params",
    "by attribute": "import house.wheel as w\n\n\ndef f():\n    return w.params.Params()",
    "by attributes of the package": "import house.wheel\nPARAMS = house.wheel.params.Params",
    "relative": "from ..wheel.params import Params",
    "by name": "import importlib\nimportlib.import_module('house.wheel.params')",
}


@pytest.mark.parametrize("text", BYPASSED_INIT_FILES.values(), ids=BYPASSED_INIT_FILES)
def test_an_import_that_bypasses_an_init_file_is_found(text, tmp_path):
    assert rules.find_bypassed_init_files(
        make_import_graph(tmp_path, {"walks/deep.py": f"{text}\n"})
    )


def test_an_init_file_may_export_a_module(tmp_path):
    files = {
        "wheel/__init__.py": "from house.wheel import params\n",
        "walks/stepping.py": "from house.wheel import params\nPARAMS = params.Params\n",
        "walks/__init__.py": "", "__init__.py": "",
    }  # fmt: skip
    assert not rules.find_bypassed_init_files(make_import_graph(tmp_path, files))


EXTERNAL_IMPORTS = {
    "plain": "import diffrax",
    "a part": "from matplotlib.figure import Figure",
    "inside a function": "def f():\n    import llvmlite.binding as llvm",
    "by name": "import importlib\nimportlib.import_module('typer')",
    "through the lazy ones": "from house.runtime import library\nOPEN = library('zarr').open",
    "by a name of its own": "from house.runtime import library as lazily\nOPEN = lazily('zarr')",
    "through another module": "from house.numerics import events\nSOLVER = events.diffrax.Tsit5",
    "a name made up": "import importlib\nimportlib.import_module('mat' + 'plotlib')",
    "pictures": "from PIL import Image",
}


@pytest.mark.parametrize("text", EXTERNAL_IMPORTS.values(), ids=EXTERNAL_IMPORTS)
def test_an_external_import_outside_its_package_is_found(text, tmp_path):
    files = {
        "numerics/__init__.py": "from house.numerics import events\n",
        "numerics/events.py": "import diffrax\n",
    }
    assert not rules.find_misplaced_external_imports(make_import_graph(tmp_path, files))
    assert rules.find_misplaced_external_imports(
        make_import_graph(tmp_path, {"walks/stranger.py": f"{text}\n"})
    )


def test_an_import_in_simd_of_another_package_is_found(tmp_path):
    files = {"simd/__init__.py": "", "simd/program.py": "from house import wheel\n"}
    assert rules.find_misplaced_external_imports(make_import_graph(tmp_path, files))


MODEL_TYPE_TESTS = {
    "isinstance": "isinstance(x, Stiff)",
    "one of two": "isinstance(x, AbstractRung | Stiff)",
    "one of a tuple": "isinstance(x, (int, Stiff))",
    "by attribute": "isinstance(x, models.Stiff)",
    "a constant": "isinstance(x, RUNGS)",
    "issubclass": "issubclass(type(x), Stiff)",
    "its type": "type(x) is Stiff",
    "its class": "x.__class__ == Stiff",
    "its type in a list": "type(x) in (Stiff, int)",
    "a table": "{Stiff: 1}[type(x)]",
    "its name": "x.rung == 'stiff'",
    "its name among others": "x.rung in ('stiff', 'other')",
}


@pytest.mark.parametrize("text", MODEL_TYPE_TESTS.values(), ids=MODEL_TYPE_TESTS)
def test_a_type_test_of_a_model_is_found(text, tmp_path):
    source = (
        "from house import models\nfrom house.models import AbstractRung, Stiff\n\n"
        f"RUNGS = (int, Stiff)\n\n\ndef ask(x):\n    return {text}\n"
    )
    assert rules.find_model_type_tests(make_import_graph(tmp_path, {"walks/ask.py": source}))
    assert not rules.find_model_type_tests(
        make_import_graph(tmp_path, {"walks/ask.py": "", "models/ask.py": source})
    )


def test_a_type_test_by_pattern_matching_is_found(tmp_path):
    source = (
        "from house.models import Stiff\n\n\n"
        "def ask(x):\n    match x:\n        case Stiff():\n            return 1\n"
    )
    assert rules.find_model_type_tests(make_import_graph(tmp_path, {"walks/ask.py": source}))


HIDING_NAMES = {
    "a function": {"wheel/params.py": "def params(): ...\n\n\nclass Params: ...\n"},
    "a class": {"wheel/axle.py": "class axle: ...\n"},
    "in a face": {"wheel/__init__.py": "from house.wheel.hub import params\n", "wheel/hub.py": ""},
    "in the package's face": {"__init__.py": "from house.walks import step as walks\n"},
    "defined in a face": {"wheel/__init__.py": "def params(): ...\n"},
}


@pytest.mark.parametrize("files", HIDING_NAMES.values(), ids=HIDING_NAMES)
def test_a_name_that_hides_a_module_is_found(files, tmp_path):
    assert rules.find_hidden_modules(make_import_graph(tmp_path, files))


@pytest.mark.parametrize(("lines", "seen"), [(500, False), (501, True)])
def test_a_long_module_is_found(lines, seen, tmp_path):
    files = {"wheel/long.py": "x = 1\n" * lines}
    assert bool(rules.find_long_code(make_import_graph(tmp_path, files))) == seen


@pytest.mark.parametrize(("lines", "seen"), [(60, False), (61, True)])
def test_a_long_function_is_found_at_any_depth(lines, seen, tmp_path):
    body = "        def f(self):\n" + "            x = 1\n" * (lines - 1)
    files = {"wheel/long.py": f"def outer():\n    class A:\n{body}\n    return A\n"}
    solution = rules.find_long_code(make_import_graph(tmp_path, files))
    assert any(" f has " in line for line in solution) == seen


def test_a_docstring_does_not_make_a_function_long(tmp_path):
    result = '    """Told.\n' + "\n" * 50 + '    """\n'
    body = result + "    x = 1\n" * 30
    assert not rules.find_long_code(
        make_import_graph(tmp_path, {"wheel/told.py": "def f():\n" + body})
    )


def test_an_unused_or_private_export_is_found(tmp_path):
    files = {
        "wheel/__init__.py": "from house.wheel.params import Params, _table, idle, tested\n",
        "wheel/params.py": "class Params: ...\n\n\n_table = idle = tested = 0\n",
    }
    read, outside = make_import_graph(tmp_path, files), ["code = 'from house.wheel import tested'"]
    assert rules.find_unused_exports(
        read, [*outside, "from house.models import Stiff, AbstractRung"]
    ) == [
        "house.runtime hands out library, which nobody fetches there",
        "house.wheel hands out _table, which nobody fetches there",
        "house.wheel hands out _table, which is private",
        "house.wheel hands out idle, which nobody fetches there",
    ]


def test_no_module_is_hidden_by_a_name():
    for module in pkgutil.walk_packages(vrw_jax.__path__, "vrw_jax."):
        if module.name != "vrw_jax.__main__":
            importlib.import_module(module.name)
            reached = vrw_jax
            for name in module.name.split(".")[1:]:
                reached = getattr(reached, name)
            assert reached is sys.modules[module.name], module.name


HEAVY_LIBRARIES = {
    "diffrax", "distributed", "matplotlib", "optax", "rich", "scipy.optimize", "scipy.stats",
    "typer", "xarray", "zarr",
}  # fmt: skip


def run_code(code):
    """A fresh process; an assertion that fails there fails here."""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_import_loads_no_optional_library():
    run_code(
        f"import vrw_jax, sys; loaded = {HEAVY_LIBRARIES} & set(sys.modules); assert not loaded, loaded"
    )


def test_import_of_any_module_changes_no_setting_and_starts_no_plotting():
    run_code(
        "import importlib, pkgutil, sys, jax, matplotlib as mpl\n"
        "jax_before, mpl_before = jax.config.values.copy(), mpl.rcParams.copy()\n"
        "import vrw_jax\n"
        "for module in pkgutil.walk_packages(vrw_jax.__path__, 'vrw_jax.'):\n"
        "    if module.name != 'vrw_jax.__main__':\n"
        "        importlib.import_module(module.name)\n"
        "assert jax_before == jax.config.values\n"
        "assert mpl_before == mpl.rcParams.copy()\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )


def test_the_architecture_figure_is_drawn_from_the_imports(tmp_path):
    command = [sys.executable, "-m", "experiments.shared.draw_rooms", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True)
    assert sum(path.stat().st_size > 10_000 for path in tmp_path.iterdir()) == 2
