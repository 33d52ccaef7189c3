"""The built package contains what it needs, and the links of its page on the package index work."""

import importlib.util
import re
import sys
import tomllib
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture
def build_hook(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """Return the build hook with a substitute for hatchling, which only a build needs."""
    interface = types.ModuleType("hatchling.metadata.plugin.interface")
    interface.MetadataHookInterface = object  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, interface.__name__, interface)
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_images_and_links_of_the_package_index_point_to_the_sources(
    build_hook: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VRW_SOURCE_URL", "https://example.org/one/two")
    readme, result = build_hook.Readme(), {}
    readme.root, readme.config = str(ROOT), {}
    readme.update(result)
    text = result["readme"]["text"]
    paths = re.findall(r"\]\(([^)]+)\)", text)
    assert "https://example.org/one/two/raw/HEAD/docs/figures/coordinates.png" in paths
    for path in paths:
        assert path.startswith(("https://", "#")), path
        if path.startswith("https://example.org"):
            assert (ROOT / path.split("/HEAD/")[1].split("#")[0]).exists(), path
    assert "](" not in build_hook.for_index("![a](b.png) [c](d.md)", "")


def test_the_build_hook_provides_the_readme_and_the_configs() -> None:
    assert "readme" in PROJECT["project"]["dynamic"]
    assert "readme" not in PROJECT["project"]
    targets = PROJECT["tool"]["hatch"]["build"]["targets"]
    assert "hatch_build.py" in targets["sdist"]["include"]
    assert "configs" in targets["wheel"]["force-include"]


def test_the_extra_installs_the_requirements_of_experiments() -> None:
    """But for torch, which is named with its own command."""
    result = " ".join(PROJECT["project"]["optional-dependencies"]["experiments"])
    for path in (ROOT / "experiments").rglob("*.py"):
        for name in re.findall(r'extra\("(\w+)"\)', path.read_text()):
            assert name.replace("_", "-") in result, (path, name)
