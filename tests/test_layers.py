"""Imports obey their rules, each rule finds its violations, and imports have no side effects."""

import subprocess
import sys
from pathlib import Path

import pytest
from support import rules
from support.package_graph import ImportGraph

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


# A small package for the tests of the rules: {file: source}. In `sample`, `simulation` imports
# `models` and `wheel`. It keeps every rule until a case adds or replaces files.
VALID_PACKAGE = {
    "__init__.py": "from sample.simulation import step\n",
    "runtime/__init__.py": "from sample.runtime.start import start\n",
    "runtime/start.py": "def start(): ...\n",
    "wheel/__init__.py": "from sample.wheel.params import Params\n",
    "wheel/params.py": "class Params: ...\n",
    "models/__init__.py": "from sample.models.base import AbstractWheel\n"
    "from sample.models.stiff import Stiff\n",
    "models/base.py": "class AbstractWheel: ...\n",
    "models/stiff.py": "from sample.models.base import AbstractWheel\n\n\n"
    "class Stiff(AbstractWheel): ...\n",
    "simulation/__init__.py": "from sample.simulation.stepping import step\n",
    "simulation/stepping.py": "from sample.models import AbstractWheel, Stiff\n"
    "from sample.wheel import Params\n\n\n"
    "def step():\n    return isinstance(Stiff(Params), AbstractWheel)\n",
}


def make_import_graph(folder, changes):
    """Return the import graph of the sample package with added or replaced files."""
    for name, text in {**VALID_PACKAGE, **changes}.items():
        path = folder / "sample" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return ImportGraph(folder / "sample")


def test_every_rule_accepts_a_valid_package(tmp_path):
    sound = make_import_graph(tmp_path, {})
    assert [rule(sound) for rule in rules.IMPORT_RULES] == [[]] * len(rules.IMPORT_RULES)


UPWARD_IMPORTS = {
    "at the top": "from sample.simulation import step",
    "plain": "import sample.simulation",
    "under a name": "import sample.simulation.stepping as w",
    "of a module": "from sample.simulation import stepping",
    "inside a function": "def f():\n    from sample.simulation import step",
    "for types only": "from typing import TYPE_CHECKING\n"
    "if TYPE_CHECKING:\n    import sample.simulation",
    "of the package from the top package": "from sample import simulation",
    "relative": "from ..simulation import step",
    "relative to the package": "from .. import simulation",
    "by name": "import importlib\nimportlib.import_module('sample.simulation')",
    "by a name of its own": "from importlib import import_module as m\n"
    "m('sample.simulation.stepping')",
    "by a string that is passed on": "NAMES = ('sample.simulation',)",
    "of a name from its module": "from sample.simulation.stepping import step",
    "through the top package": "import sample as h\n\n\ndef f():\n    return h.step()",
}


@pytest.mark.parametrize("text", UPWARD_IMPORTS.values(), ids=UPWARD_IMPORTS)
def test_an_upward_import_is_found_in_every_form(text, tmp_path):
    broken = make_import_graph(tmp_path, {"wheel/params.py": f"{text}\n\n\nclass Params: ...\n"})
    assert any("sample.wheel.params" in line for line in rules.find_upward_imports(broken)), (
        broken.edges
    )


def test_packages_of_one_layer_do_not_import_each_other(tmp_path):
    files = {
        "batches/__init__.py": "", "batches/batch.py": "from sample.cycles import find\n",
        "cycles/__init__.py": "from sample.cycles.cycle import find\n",
        "cycles/cycle.py": "def find(): ...\n",
    }  # fmt: skip
    assert rules.find_upward_imports(make_import_graph(tmp_path, files))


def test_a_package_outside_the_layers_is_found(tmp_path):
    files = {"attic/__init__.py": "", "loose.py": ""}
    import_errors = rules.find_upward_imports(make_import_graph(tmp_path, files))
    assert [line.split()[0] for line in import_errors] == ["attic", "loose"]


def test_an_import_cycle_through_an_init_file_is_found(tmp_path):
    inner = "def f():\n    from sample.wheel import Params\n    return Params\n\n\n"
    files = {
        "wheel/__init__.py": "from sample.wheel.params import Params\n"
        "from sample.wheel.phase import g\n",
        "wheel/phase.py": inner + "def g(): ...\n",
    }
    assert rules.find_import_cycles(make_import_graph(tmp_path, files)) == [
        "sample.wheel -> sample.wheel.phase -> sample.wheel"
    ]


def test_an_import_cycle_of_two_modules_is_found(tmp_path):
    files = {
        "wheel/params.py": "def f():\n    from sample.wheel import phase\n\n\nclass Params: ...\n",
        "wheel/phase.py": "from sample.wheel.params import Params\n",
    }
    assert rules.find_import_cycles(make_import_graph(tmp_path, files)) == [
        "sample.wheel.params -> sample.wheel.phase -> sample.wheel.params"
    ]


def test_an_import_leads_to_the_module_that_defines_the_name(tmp_path):
    read = make_import_graph(tmp_path, {})
    targets = {edge.target for edge in read.edges if edge.source == "sample.simulation.stepping"}
    assert targets == {
        "sample.wheel", "sample.wheel.params", "sample.models", "sample.models.base",
        "sample.models.stiff",
    }  # fmt: skip


BYPASSED_INIT_FILES = {
    "deep": "from sample.wheel.params import Params",
    "plain": "import sample.wheel.params",
    "module that is not exported": "from sample.wheel import params",
    "by attribute": "import sample.wheel as w\n\n\ndef f():\n    return w.params.Params()",
    "by attributes of the package": "import sample.wheel\nPARAMS = sample.wheel.params.Params",
    "relative": "from ..wheel.params import Params",
    "by name": "import importlib\nimportlib.import_module('sample.wheel.params')",
}


@pytest.mark.parametrize("text", BYPASSED_INIT_FILES.values(), ids=BYPASSED_INIT_FILES)
def test_an_import_that_bypasses_an_init_file_is_found(text, tmp_path):
    assert rules.find_bypassed_init_files(
        make_import_graph(tmp_path, {"simulation/deep.py": f"{text}\n"})
    )


def test_an_init_file_may_export_a_module(tmp_path):
    files = {
        "wheel/__init__.py": "from sample.wheel import params\n",
        "simulation/stepping.py": "from sample.wheel import params\nPARAMS = params.Params\n",
        "simulation/__init__.py": "", "__init__.py": "",
    }  # fmt: skip
    assert not rules.find_bypassed_init_files(make_import_graph(tmp_path, files))


EXTERNAL_IMPORTS = {
    "plain": "import diffrax",
    "a part": "from matplotlib.figure import Figure",
    "inside a function": "def f():\n    import llvmlite.binding as llvm",
    "by name": "import importlib\nimportlib.import_module('typer')",
    "by a name of its own": "from importlib import import_module as load\nOPEN = load('zarr').open",
    "through another module": "from sample.hybrid import phase_integration\n"
    "SOLVER = phase_integration.diffrax.Tsit5",
    "a computed name": "import importlib\nimportlib.import_module('mat' + 'plotlib')",
    "pictures": "from PIL import Image",
}


@pytest.mark.parametrize("text", EXTERNAL_IMPORTS.values(), ids=EXTERNAL_IMPORTS)
def test_an_external_import_outside_its_package_is_found(text, tmp_path):
    files = {
        "hybrid/__init__.py": "from sample.hybrid import phase_integration\n",
        "hybrid/phase_integration.py": "import diffrax\n",
    }
    assert not rules.find_misplaced_external_imports(make_import_graph(tmp_path, files))
    assert rules.find_misplaced_external_imports(
        make_import_graph(tmp_path, {"simulation/other.py": f"{text}\n"})
    )


def test_an_import_in_simd_of_another_package_is_found(tmp_path):
    files = {"simd/__init__.py": "", "simd/program.py": "from sample import wheel\n"}
    assert rules.find_misplaced_external_imports(make_import_graph(tmp_path, files))


MODEL_TYPE_TESTS = {
    "isinstance": "isinstance(x, Stiff)",
    "one of two": "isinstance(x, AbstractWheel | Stiff)",
    "one of a tuple": "isinstance(x, (int, Stiff))",
    "by attribute": "isinstance(x, models.Stiff)",
    "a constant": "isinstance(x, MODELS)",
    "issubclass": "issubclass(type(x), Stiff)",
    "its type": "type(x) is Stiff",
    "its class": "x.__class__ == Stiff",
    "its type in a list": "type(x) in (Stiff, int)",
    "a table": "{Stiff: 1}[type(x)]",
    "its name": "x.model_name == 'stiff'",
    "its name among others": "x.model_name in ('stiff', 'other')",
}


@pytest.mark.parametrize("text", MODEL_TYPE_TESTS.values(), ids=MODEL_TYPE_TESTS)
def test_a_type_test_of_a_model_is_found(text, tmp_path):
    source = (
        "from sample import models\nfrom sample.models import AbstractWheel, Stiff\n\n"
        f"MODELS = (int, Stiff)\n\n\ndef check(x):\n    return {text}\n"
    )
    assert rules.find_model_type_tests(make_import_graph(tmp_path, {"simulation/check.py": source}))
    assert not rules.find_model_type_tests(
        make_import_graph(tmp_path, {"simulation/check.py": "", "models/check.py": source})
    )


def test_a_type_test_by_pattern_matching_is_found(tmp_path):
    source = (
        "from sample.models import Stiff\n\n\n"
        "def check(x):\n    match x:\n        case Stiff():\n            return 1\n"
    )
    assert rules.find_model_type_tests(make_import_graph(tmp_path, {"simulation/check.py": source}))


def test_an_unused_or_private_export_is_found(tmp_path):
    files = {
        "wheel/__init__.py": "from sample.wheel.params import Params, _table, idle, tested\n",
        "wheel/params.py": "class Params: ...\n\n\n_table = idle = tested = 0\n",
    }
    read, outside = make_import_graph(tmp_path, files), ["code = 'from sample.wheel import tested'"]
    assert rules.find_unused_exports(
        read, [*outside, "from sample.models import Stiff, AbstractWheel"]
    ) == [
        "sample.runtime exports start, which nothing imports from there",
        "sample.wheel exports _table, which nothing imports from there",
        "sample.wheel exports _table, which is private",
        "sample.wheel exports idle, which nothing imports from there",
    ]


HEAVY_LIBRARIES = {
    "diffrax", "distributed", "matplotlib", "optax", "rich", "scipy.optimize", "scipy.stats",
    "typer", "xarray", "zarr",
}  # fmt: skip


def run_code(code):
    """Run code in a fresh process; an assertion that fails there fails here."""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_import_loads_no_optional_library():
    run_code(
        "import vrw_jax, sys\n"
        f"loaded = {HEAVY_LIBRARIES} & set(sys.modules)\n"
        "assert not loaded, loaded"
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


@pytest.mark.slow
def test_the_architecture_figure_is_drawn_from_the_imports(tmp_path):
    command = [sys.executable, "-m", "experiments.shared.draw_packages", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True)
    assert sum(path.stat().st_size > 10_000 for path in tmp_path.iterdir()) == 2
