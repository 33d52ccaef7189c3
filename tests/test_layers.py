"""Imports obey their rules, each rule finds its violations, and imports have no side effects."""

import re
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
    folders = (ROOT / name for name in ("tests", "experiments", "website"))
    outside = [path.read_text() for folder in folders for path in folder.rglob("*.py")]
    for page in [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]:
        outside += re.findall(r"```python\n(.*?)```", page.read_text(), re.S)
    idle = rules.find_unused_exports(IMPORT_GRAPH, outside)
    assert not idle, "\n" + "\n".join(idle)


WALKER_IMPORTS_FILE = ROOT / "tests" / "support" / "walker_imports.txt"


def test_packages_for_any_walker_import_no_more_of_the_wheel():
    """The list of these imports may only shrink: `flow` to `studies` shall serve any walker."""
    listed_imports = WALKER_IMPORTS_FILE.read_text().splitlines()
    imports = rules.list_walker_imports(IMPORT_GRAPH)
    assert imports == listed_imports, (
        f"new: {sorted(set(imports) - set(listed_imports))}; "
        f"delete from {WALKER_IMPORTS_FILE.name}: {sorted(set(listed_imports) - set(imports))}"
    )


# A small package for the tests of the rules: {file: source}. In `sample`, `gaits` imports
# `models` and `wheel`. It keeps every rule until a case adds or replaces files.
VALID_PACKAGE = {
    "__init__.py": "from sample.gaits.stepping import step\n",
    "base/__init__.py": "from sample.base.start import start\n",
    "base/start.py": "def start(): ...\n",
    "wheel/__init__.py": "from sample.wheel.params import Params\n",
    "wheel/params.py": "class Params: ...\n",
    "models/__init__.py": "from sample.models.base import AbstractWheel\n"
    "from sample.models.stiff import Stiff\n",
    "models/base.py": "class AbstractWheel: ...\n",
    "models/stiff.py": "from sample.models.base import AbstractWheel\n\n\n"
    "class Stiff(AbstractWheel): ...\n",
    "gaits/__init__.py": "from sample.gaits.stepping import step\n",
    "gaits/stepping.py": "from sample import wheel\nfrom sample.models.base import AbstractWheel\n"
    "from sample.models.stiff import Stiff\nParams = wheel.Params\n\n\n"
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
    "at the top": "from sample.gaits import step",
    "plain": "import sample.gaits",
    "under a name": "import sample.gaits.stepping as w",
    "of a module": "from sample.gaits import stepping",
    "inside a function": "def f():\n    from sample.gaits import step",
    "for types only": "from typing import TYPE_CHECKING\n"
    "if TYPE_CHECKING:\n    import sample.gaits",
    "of the package from the top package": "from sample import gaits",
    "relative": "from ..gaits import step",
    "relative to the package": "from .. import gaits",
    "by name": "import importlib\nimportlib.import_module('sample.gaits')",
    "by a name of its own": "from importlib import import_module as m\nm('sample.gaits.stepping')",
    "by a string that is passed on": "NAMES = ('sample.gaits',)",
    "of a name from its module": "from sample.gaits.stepping import step",
    "through the top package": "import sample as h\n\n\ndef f():\n    return h.step()",
}


@pytest.mark.parametrize("text", UPWARD_IMPORTS.values(), ids=UPWARD_IMPORTS)
def test_an_upward_import_is_found_in_every_form(text, tmp_path):
    broken = make_import_graph(tmp_path, {"wheel/params.py": f"{text}\n\n\nclass Params: ...\n"})
    assert any("sample.wheel.params" in line for line in rules.find_upward_imports(broken)), (
        broken.edges
    )


def test_a_package_outside_the_order_is_found(tmp_path):
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
    targets = {edge.target for edge in read.edges if edge.source == "sample.gaits.stepping"}
    assert targets == {
        "sample.wheel", "sample.wheel.params", "sample.models.base", "sample.models.stiff",
    }  # fmt: skip


INDIRECT_IMPORTS = {
    "from a package": "from sample.wheel import Params",
    "from the top package": "from sample import step",
    "relative": "from ..wheel import Params",
    "from a public module": "from sample.plot import draw",
    "from another module": "from sample.wheel.phase import Params",
    "by attribute of another module": "from sample.wheel import phase\nPARAMS = phase.Params",
}


@pytest.mark.parametrize("text", INDIRECT_IMPORTS.values(), ids=INDIRECT_IMPORTS)
def test_an_import_from_another_module_than_the_defining_one_is_found(text, tmp_path):
    files = {
        "wheel/phase.py": "from sample.wheel.params import Params\n",
        "app/__init__.py": "", "app/pictures.py": "def draw(): ...\n",
        "plot.py": "from sample.app.pictures import draw\n",
    }  # fmt: skip
    assert not rules.find_indirect_imports(make_import_graph(tmp_path, files))
    broken = make_import_graph(tmp_path, files | {"studies/deep.py": f"{text}\n"})
    violations = rules.find_indirect_imports(broken)
    assert violations
    assert all(line.startswith("sample.studies.deep:") for line in violations)


DIRECT_IMPORTS = {
    "of a name": "from sample.wheel.params import Params",
    "of a module": "from sample.wheel import params\nPARAMS = params.Params",
    "of a package": "from sample import wheel\nPARAMS = wheel.Params",
    "of a public module": "from sample import plot\nDRAW = plot.draw",
}


@pytest.mark.parametrize("text", DIRECT_IMPORTS.values(), ids=DIRECT_IMPORTS)
def test_a_direct_import_and_an_attribute_of_a_package_are_allowed(text, tmp_path):
    files = {
        "app/__init__.py": "", "app/pictures.py": "def draw(): ...\n",
        "plot.py": "from sample.app.pictures import draw\n", "app/deep.py": f"{text}\n",
    }  # fmt: skip
    assert not rules.find_indirect_imports(make_import_graph(tmp_path, files))


def test_an_import_of_a_package_of_the_wheel_is_listed(tmp_path):
    files = {"studies/means.py": "def f():\n    from sample.wheel.params import Params\n"}
    assert rules.list_walker_imports(make_import_graph(tmp_path, files)) == [
        "gaits.stepping: models.base models.stiff wheel wheel.params",
        "studies.means: wheel.params",
    ]


EXTERNAL_IMPORTS = {
    "plain": "import diffrax",
    "a part": "from matplotlib.figure import Figure",
    "inside a function": "def f():\n    import llvmlite.binding as llvm",
    "by name": "import importlib\nimportlib.import_module('typer')",
    "by a name of its own": "from importlib import import_module as load\nOPEN = load('zarr').open",
    "through another module": "from sample.flow import phase_integration\n"
    "SOLVER = phase_integration.diffrax.Tsit5",
    "a computed name": "import importlib\nimportlib.import_module('mat' + 'plotlib')",
    "pictures": "from PIL import Image",
    "a new library": "import pandas",
}


@pytest.mark.parametrize("text", EXTERNAL_IMPORTS.values(), ids=EXTERNAL_IMPORTS)
def test_an_external_import_outside_its_package_is_found(text, tmp_path):
    files = {
        "flow/__init__.py": "from sample.flow import phase_integration\n",
        "flow/phase_integration.py": "import diffrax\n",
    }
    assert not rules.find_misplaced_external_imports(make_import_graph(tmp_path, files))
    assert rules.find_misplaced_external_imports(
        make_import_graph(tmp_path, {"gaits/other.py": f"{text}\n"})
    )


def test_an_import_in_lanes_of_another_package_is_found(tmp_path):
    files = {"lanes/__init__.py": "", "lanes/program.py": "from sample import base\n"}
    assert rules.find_upward_imports(make_import_graph(tmp_path, files))


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
        "from sample import models\nfrom sample.models.base import AbstractWheel\n"
        "from sample.models.stiff import Stiff\n\n"
        f"MODELS = (int, Stiff)\n\n\ndef check(x):\n    return {text}\n"
    )
    assert rules.find_model_type_tests(make_import_graph(tmp_path, {"gaits/check.py": source}))
    assert not rules.find_model_type_tests(
        make_import_graph(tmp_path, {"gaits/check.py": "", "models/check.py": source})
    )


def test_a_type_test_by_pattern_matching_is_found(tmp_path):
    source = (
        "from sample.models.stiff import Stiff\n\n\n"
        "def check(x):\n    match x:\n        case Stiff():\n            return 1\n"
    )
    assert rules.find_model_type_tests(make_import_graph(tmp_path, {"gaits/check.py": source}))


def test_an_unused_or_private_export_is_found(tmp_path):
    files = {
        "wheel/__init__.py": "from sample.wheel.params import Params, _table, idle, tested\n",
        "wheel/params.py": "class Params: ...\n\n\n_table = idle = tested = 0\n",
    }
    read, outside = make_import_graph(tmp_path, files), ["code = 'from sample.wheel import tested'"]
    assert rules.find_unused_exports(
        read, [*outside, "from sample.models import Stiff, AbstractWheel"]
    ) == [
        "sample.base exports start, which nothing imports from there",
        "sample.gaits exports step, which nothing imports from there",
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
