"""Float64, a persistent compilation cache, and shapes checked against signatures."""

import os
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
_CACHE = os.environ.get("VRW_TEST_CACHE", str(Path(__file__).parent.parent / ".jax_cache"))
jax.config.update("jax_compilation_cache_dir", _CACHE)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)

with install_import_hook("vrw_jax", "beartype.beartype"):
    import vrw_jax  # noqa: F401  imported here so that its annotations are checked

COMPILE_LONGEST = (
    "test_continuation", "test_limit_cycle", "test_derivatives", "test_tune", "test_unilateral",
    "test_ground_gaits", "test_scan", "test_reproduction", "test_outcomes", "test_model_choice",
    "test_basin",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first, so that two workers end together."""
    place = {name: index for index, name in enumerate(COMPILE_LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))
