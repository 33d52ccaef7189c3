"""Only code that the user stored under the same name is executed from the cache."""

import functools
import os
import stat
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.machine_code import CodeRegistrySpy, use_cache_folder
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax import lanes
from vrw_jax.lanes import environment as store

X = np.arange(4.0)
FACTORS = (2.0, 3.0)


@pytest.fixture
def folder(tmp_path):
    """Return a cache folder of the test."""
    with use_cache_folder(tmp_path):
        yield tmp_path


@pytest.fixture
def process(monkeypatch):
    monkeypatch.setattr(store, "_issued_warning_kinds", set())
    return CodeRegistrySpy(monkeypatch)


def multiply(factor, x):
    return factor * x


def multiples():
    """Return the numbers of X times each factor, by machine code and by a trace that calls it."""
    results = []
    for factor in FACTORS:
        times = lanes.compile_batch_function(functools.partial(multiply, factor))
        results.append(times.run(X))
        call = lambda x, g=times: g(x) + 0.0
        results.append(
            lanes.compile_exported_function(call, (jnp.asarray(X),), jax.devices()[0])(X)
        )
    return results


def expected():
    return [factor * X for factor in FACTORS for _ in range(2)]


def check_recompiles(process, warns=True):
    """Require right numbers in a later process, with one warning at most, and then without a
    warning."""
    for again in range(2):
        process.reset_registry()
        store._issued_warning_kinds.clear()
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            np.testing.assert_array_equal(multiples(), expected())
        results = [str(w.message) for w in seen if "again" in str(w.message)]
        assert len(results) == (warns and not again), results


@pytest.mark.parametrize("kind", ["lanes_index", "lanes_code", "vrw_trace"])
def test_records_in_each_others_place_are_not_used(folder, process, kind):
    """Reference: the product, in closed form; each record is sound but for its place."""
    multiples()
    records = sorted(folder.glob(f"{kind}_*"))
    contents = [place.read_bytes() for place in records]
    for place, content in zip(records, [*contents[1:], contents[0]], strict=True):
        place.write_bytes(content)
    check_recompiles(process)


TEXTS = {
    "nonsense": lambda content: b"[]\n" + bytes(range(256)) * 9,
    "nothing": lambda content: b"",
    "half": lambda content: content[: len(content) // 2],
}
OBJECTS = TEXTS | {
    "its first line": lambda content: content.partition(b"\n")[0] + b"\n",
    "no symbols": lambda content: content.replace(b"lanes", b"sheep"),
    "a header before noise": lambda content: content[:120] + b"\0lanes\0" + b"\xa5" * 900,
}


GARBAGE = [
    *(("lanes_code", what) for what in OBJECTS),
    *((kind, what) for kind in ("lanes_index", "vrw_trace") for what in TEXTS),
]


@pytest.mark.parametrize(("kind", "what"), GARBAGE)
def test_garbage_with_a_valid_digest_is_compiled_anew(folder, process, kind, what):
    multiples()
    for place in folder.glob(f"{kind}_*"):
        store.save_cache_record(place.stem, OBJECTS[what](store.load_cache_record(place.stem)))
    process.reset_registry()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        np.testing.assert_array_equal(multiples(), expected())


def replace_by_folder(place):
    place.unlink()
    place.mkdir()


def replace_by_pipe(place):
    place.unlink()
    os.mkfifo(place)


DAMAGE = {
    "another byte": lambda place: place.write_bytes(place.read_bytes()[:-9] + b"damaged!?"),
    "truncated": lambda place: place.write_bytes(place.read_bytes()[:-9]),
    "empty": lambda place: place.write_bytes(b""),
    "writable by others": lambda place: place.chmod(0o666),
    "a pipe": replace_by_pipe,
}


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_record_is_compiled_anew_with_one_warning(folder, process, what):
    multiples()
    for place in [*folder.glob("lanes_*"), *folder.glob("vrw_*")]:
        DAMAGE[what](place)
    check_recompiles(process)


def test_what_can_t_be_read_is_compiled_anew_with_one_warning(folder, process):
    multiples()
    for place in [*folder.glob("lanes_*"), *folder.glob("vrw_*")]:
        replace_by_folder(place)
    process.reset_registry()
    with pytest.warns(UserWarning, match="it is compiled again") as seen:
        np.testing.assert_array_equal(multiples(), expected())
    assert len(seen) == 1


def test_another_users_records_are_not_used(folder, process, monkeypatch):
    multiples()
    owner = os.geteuid() + 1
    monkeypatch.setattr(os, "geteuid", lambda: owner)
    with pytest.warns(UserWarning, match="belongs to another user, but"):
        assert store.find_cache_folder() is None
    assert store.load_cache_record(next(folder.glob("lanes_code_*")).stem) is None
    monkeypatch.setenv(store.TRUST_SHARED_CACHE_VARIABLE, "1")
    assert store.load_cache_record(next(folder.glob("lanes_code_*")).stem)


def test_a_trace_of_other_versions_is_not_used(folder, monkeypatch):
    spy = CodeRegistrySpy(monkeypatch)
    run = lambda: lanes.compile_batch_function(lambda x: 2.0 * x).run(X)
    run(), run()
    assert spy.n_traces == 1
    monkeypatch.setattr(store, "find_library_version", lambda library_name: "0.0")
    run()
    assert spy.n_traces == 2


def test_a_record_that_can_t_be_written_whole_leaves_nothing(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    store.save_cache_record("lanes_code_x", b"content")
    assert not list(folder.iterdir())


# Folders


def started(code="", **environment):
    """Run a process under an umask of 0 that starts JAX."""
    lines = f"import os; os.umask(0); import vrw_jax as vrw; {code or 'vrw.start_jax()'}"
    outside = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    return subprocess.run(
        [sys.executable, "-c", lines], env=outside | environment, capture_output=True, text=True
    )


def test_folders_of_code_are_the_users_alone_whatever_the_umask(tmp_path):
    code = (
        "vrw.start_jax(); import numpy as np; "
        "from vrw_jax import lanes; lanes.compile_batch_function(lambda x: 2.0 * x).run(np.ones(4))"
    )
    made = started(code, XDG_CACHE_HOME=str(tmp_path / "a" / "b"))
    assert made.returncode == 0, made.stderr
    for place in (tmp_path / "a").rglob("*"):
        allowed = 0o700 if place.is_dir() else 0o600
        assert stat.S_IMODE(place.stat().st_mode) & ~allowed == 0, place
    assert list((tmp_path / "a").rglob("lanes_code_*"))


@pytest.mark.parametrize("mode", [*mark_slow(0o777, 0o702, 0o1777), 0o770])
def test_a_folder_that_others_can_write_is_refused_in_one_sentence(tmp_path, mode):
    place = tmp_path / "cache"
    place.mkdir()
    place.chmod(mode)
    results = started(JAX_COMPILATION_CACHE_DIR=str(place))
    line = results.stderr.splitlines()[-1]
    assert line.startswith(f"PermissionError: the cache {place} can be written by other users")
    assert line.endswith("VRW_TRUST_SHARED_CACHE=1.")
    for allowed in (
        started("vrw.start_jax(trust_shared=True)", JAX_COMPILATION_CACHE_DIR=str(place)),
        started(JAX_COMPILATION_CACHE_DIR=str(place), VRW_TRUST_SHARED_CACHE="1"),
    ):
        assert allowed.returncode == 0, allowed.stderr


def test_a_refused_folder_is_not_jaxs_either(tmp_path):
    before = jax.config.jax_compilation_cache_dir
    tmp_path.chmod(0o777)
    try:
        with pytest.raises(PermissionError, match="its files are executed: run `chmod 700`"):
            vrw.start_jax(tmp_path)
        assert jax.config.jax_compilation_cache_dir is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_the_command_line_refuses_such_a_folder_in_one_line(tmp_path):
    tmp_path.chmod(0o777)
    results = subprocess.run(
        [sys.executable, "-m", "vrw_jax", "gait", "--steps", "1"],
        env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert results.returncode == 2
    assert len(results.stderr.splitlines()) == 1
    assert results.stderr.startswith("vrw: the cache")
