"""Start JAX as `start_jax` does, with a compilation cache, and check shapes against signatures."""

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from support import shape_checks

ROOT = Path(__file__).parent.parent
UNCHECKED_PACKAGE = os.environ.get("VRW_TEST_UNCHECKED", "lanes")
"""Writes code call by call, which takes eight times as long where each is checked; has no shapes in
its signatures. `tests/lanes/test_checked.py` runs it checked."""
PACKAGE_POSITIONS = [
    f"vrw_jax.{place.name}"
    for place in (ROOT / "vrw_jax").iterdir()
    if place.is_dir() and place.name != UNCHECKED_PACKAGE
]

MAX_MEMORY_BYTES = psutil.virtual_memory().total // 4
"""Memory of a test process above which JAX's caches are cleared.

There are two test processes, and the caches of all tests need several gigabytes in each.
"""

LONGEST_COMPILATIONS = (
    "test_continuation", "test_limit_cycle", "test_unilateral", "test_any_system", "test_reaching",
    "test_web_digits", "test_measure_to_tolerance", "test_step_accuracy",
    "test_special_point_curves", "test_models_used",
    "test_rigid", "test_reference", "test_one_sided_stoppers", "test_scan", "test_engines",
    "test_atlas_failures", "test_events", "test_scales", "test_ground_derivatives", "test_margins",
    "test_lane_engine", "test_outcomes", "test_reproduction", "test_ground_batches",
    "test_snippets", "test_reference_code", "test_simd", "test_cli", "test_stores", "test_settling",
    "test_restitution", "test_layers", "test_phases", "test_robustness", "test_wrong_calls",
    "test_inputs", "test_checked",
)  # fmt: skip


def pytest_configure(config: pytest.Config) -> None:
    """Import the library with checked annotations, unless this process only distributes tests."""
    distributes_tests = config.getoption("numprocesses", None) and not hasattr(
        config, "workerinput"
    )
    if distributes_tests and not config.getoption("collectonly"):
        return
    os.environ["VRW_PROGRESS"] = "0"  # Tests compare standard error, also of other processes.
    # Tests compile thousands of single operations, each for 20 ms. JAX reads the setting when it
    # is imported, and `start_jax` keeps it.
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    if config.getoption("markexpr") == "not slow":
        # XLA compiles in two thirds of the time, as in JAX's own tests. The slow tests run the
        # code that users run, and the library's machine code is the same in both.
        os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"
        import jax

        if jax.__version_info__[:2] in ((0, 9), (0, 10)):  # XLA aborts at unknown flags.
            split = (
                "--xla_cpu_parallel_codegen_split_count=1"  # Splitting helps on many cores only.
            )
            os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {split}".strip()
    shape_checks.import_with_checks(PACKAGE_POSITIONS)
    import vrw_jax

    vrw_jax.start_jax(os.environ.get("VRW_TEST_CACHE", ROOT / ".jax_cache"))
    gc.freeze()  # Collections skip what the imports have made.
    gc.set_threshold(200_000, 10, 10)  # JAX keeps most objects that it makes.


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run long files first, so that two workers end together."""
    position = {name: index for index, name in enumerate(LONGEST_COMPILATIONS)}
    items.sort(key=lambda item: position.get(item.path.stem, len(position)))


@pytest.fixture(autouse=True)
def _keep_cache_folder() -> Iterator[None]:
    """Fail if a test leaves another folder for compiled code: later tests would compile again."""
    import jax

    cache_folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    yield
    assert jax.config.jax_compilation_cache_dir == cache_folder  # type: ignore[attr-defined]


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Clear JAX's caches after a test file if this process needs much memory."""
    import jax

    if nextitem is None or nextitem.path == item.path:
        return
    if psutil.Process().memory_info().rss > MAX_MEMORY_BYTES:
        jax.clear_caches()
        gc.collect()
        if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
            libc.malloc_trim(0)  # Otherwise glibc keeps the freed memory.


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> None:
    """Check the first call of each function in every test.

    LLVM compiles groups of one vector in 40 % of the time that groups of two take. The slow tests,
    and those of machine code, run the groups of users, which have the same bits.
    """
    from vrw_jax.lanes import program

    shape_checks.start_test()
    is_short = item.config.getoption("markexpr") == "not slow" and not (
        item.path.parent.name == "lanes" or item.path.stem == "test_lane_engine"
    )
    program.VECTORS_PER_GROUP = 1 if is_short else 2
