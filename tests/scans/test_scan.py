"""Scans: they survive being killed, refuse to mix, and a sample's result is its own."""

import errno
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from support.scanning import GRID, MEASURES, Counted, arithmetic, planned, run

import vrw_jax as vrw
from vrw_jax.cycles import finder
from vrw_jax.scans import dask, planning
from vrw_jax.scans import design as designs
from vrw_jax.scans import store as scan_store
from vrw_jax.scans.dask import workers
from vrw_jax.scans.evaluate import LANES, Engine
from vrw_jax.scans.offer import ALWAYS
from vrw_jax.scans.planning import Chunk, Plan, plan
from vrw_jax.scans.running import Progress
from vrw_jax.scans.store import chunk_shape, first_difference, open_scan
from vrw_jax.wheel.outcomes import Outcome
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams


def files(store: Path) -> dict[str, bytes]:
    return {str(p.relative_to(store)): p.read_bytes() for p in store.rglob("*") if p.is_file()}


# What a store promises


def test_a_stored_scan_is_the_scan_in_memory(tmp_path: Path) -> None:
    here = run(planned(), evaluate=arithmetic)
    there = run(planned(), tmp_path / "s.zarr", evaluate=arithmetic)
    xr.testing.assert_identical(here.drop_attrs(), there.load().drop_attrs())
    assert here.attrs == there.attrs


def test_a_stored_scan_opens_with_xarray_alone(tmp_path: Path) -> None:
    run(planned(), tmp_path / "s.zarr", evaluate=arithmetic)
    alone = xr.open_zarr(tmp_path / "s.zarr", consolidated=False, chunks=None)
    assert alone.speed.dims == ("damping", "slope")
    assert alone.speed.attrs["units"] == "m/s"
    np.testing.assert_array_equal(alone.damping, GRID.values["damping"])


def test_a_stored_list_of_samples_keeps_its_coordinates(tmp_path: Path) -> None:
    design = designs.sobol({"damping": (100.0, 200.0), "slope": (0.28, 0.3)}, 16)
    here = run(plan(design, MEASURES), evaluate=arithmetic)
    there = run(plan(design, MEASURES), tmp_path / "s.zarr", evaluate=arithmetic)
    xr.testing.assert_identical(here.drop_attrs(), there.load().drop_attrs())
    assert set(there.coords) == {"sample", "damping", "slope", "leg"}


def test_a_scan_interrupted_at_any_chunk_ends_bitwise_the_same(tmp_path: Path) -> None:
    whole = tmp_path / "whole.zarr"
    run(planned(), whole, evaluate=arithmetic)
    n_chunks = planned().layout.n_chunks
    for stop in range(1, n_chunks + 1):
        store = tmp_path / f"stopped_{stop}.zarr"
        with pytest.raises(KeyboardInterrupt):
            run(planned(), store, evaluate=Counted(stop))
        rest = Counted()
        run(planned(), store, evaluate=rest)
        assert rest.calls == n_chunks - (stop - 1)
        assert files(store) == files(whole)


def test_a_finished_scan_computes_nothing(tmp_path: Path) -> None:
    first = run(planned(), tmp_path / "s.zarr", evaluate=arithmetic).load()
    again = Counted()
    second = run(planned(), tmp_path / "s.zarr", evaluate=again)
    assert again.calls == 0
    xr.testing.assert_identical(first, second.load())


def test_a_chunk_whose_writing_broke_off_is_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fills up at every possible write: metadata, coordinates, data, the mark itself."""
    import zarr.storage._local as local

    run(planned(10), tmp_path / "whole.zarr", evaluate=arithmetic)
    put, count = local._put, 0

    def counting(*args: object, **kwargs: object) -> int:
        nonlocal count
        count += 1
        if count == fails_at:
            raise OSError(errno.ENOSPC, "No space left on device")
        return put(*args, **kwargs)

    fails_at, broke_off = 1, 0
    while True:
        store, count = tmp_path / f"{fails_at}.zarr", 0
        monkeypatch.setattr(local, "_put", counting)
        try:
            run(planned(10), store, evaluate=arithmetic)
        except OSError:
            broke_off += 1
        else:
            break
        finally:
            monkeypatch.setattr(local, "_put", put)
        run(planned(10), store, evaluate=arithmetic)
        assert files(store) == files(tmp_path / "whole.zarr")
        fails_at += 7  # coprime to the writes per chunk, so that every kind of write has its turn
    assert broke_off > 10


@pytest.mark.parametrize("wheel", [vrw.UnilateralWheel(), vrw.LadderWheel(friction=0.7)])
def test_every_rungs_settings_can_be_written_down(wheel):
    attrs = plan(vrw.grid(friction=[0.5, 0.7]), model=wheel).attrs
    assert json.loads(attrs[scan_store.MANIFEST])["model"]["kind"] == type(wheel).__name__


@pytest.mark.parametrize("kind", ["ViscoelasticWheel", "UnilateralWheel", "LadderWheel"])
def test_a_store_of_version_0_1_tells_its_two_stability_margins_apart(
    tmp_path: Path, kind: str
) -> None:
    """There `stability_margin` was labelled 1 - rho, and was that on real ground alone."""
    radius, rung = np.array([0.5, 0.9]), np.array([1, 2], np.int8)
    held = np.where(rung == 1, 0.123, 1.0 - radius)
    label = {"symbol": "1 - ρ", "units": "1"}
    xr.Dataset(
        {
            "spectral_radius": ("damping", radius),
            "rung": ("damping", rung),
            "stability_margin": ("damping", held, label),
            "outcome": ("damping", np.zeros(2, np.int8)),
            scan_store.DONE: ("chunk", [1]),
        },
        {"damping": [100.0, 200.0]},
        {scan_store.MANIFEST: {"model": {"kind": kind}}, "coordinates": "damping"},
    ).to_zarr(tmp_path / "old", zarr_format=3, consolidated=False)
    found = open_scan(tmp_path / "old")
    if kind == "ViscoelasticWheel":
        np.testing.assert_array_equal(found.stability_margin, held)
        assert "spectral_margin" not in found
        assert found.stability_margin.attrs["symbol"] != "1 - ρ"
        return
    np.testing.assert_array_equal(found.spectral_margin, 1.0 - radius)
    assert found.spectral_margin.attrs["symbol"] == "1 - ρ"
    if kind == "UnilateralWheel":
        assert "stability_margin" not in found
    else:
        np.testing.assert_array_equal(found.stability_margin, [0.123, np.nan])


KILLED = """
import sys, time
sys.path.insert(0, {tests!r})
import jax
jax.config.update("jax_enable_x64", True)
from support import scanning
def slow(columns):
    time.sleep(0.15)
    return scanning.arithmetic(columns)
print("ready", flush=True)
scanning.run(scanning.planned(1), {store!r}, evaluate=slow)
"""


def test_a_store_whose_making_was_killed_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing that a killed process can leave behind is taken for a store."""
    fill, path = scan_store._fill, tmp_path / "s.zarr"

    def killed(place: Path, *rest: object) -> None:
        fill(place, *rest)
        raise KeyboardInterrupt

    monkeypatch.setattr(scan_store, "_fill", killed)
    monkeypatch.setattr(scan_store.shutil, "rmtree", lambda *_, **__: None)  # nothing cleans up
    with pytest.raises(KeyboardInterrupt):
        run(planned(), path, evaluate=arithmetic)
    assert not path.exists()
    monkeypatch.undo()
    run(planned(), tmp_path / "whole.zarr", evaluate=arithmetic)
    run(planned(), path, evaluate=arithmetic)
    assert files(path) == files(tmp_path / "whole.zarr")


def test_a_scan_killed_with_signal_9_ends_bitwise_the_same(tmp_path: Path) -> None:
    whole, store = tmp_path / "whole.zarr", tmp_path / "killed.zarr"
    run(planned(1), whole, evaluate=arithmetic)
    code = KILLED.format(tests=str(Path(__file__).parents[1]), store=str(store))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    while not store.exists() or not np.any(open_scan(store).outcome.values != -1):
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    done = int(np.sum(open_scan(store).outcome.values != -1))
    assert 0 < done < GRID.size
    rest = Counted()
    run(planned(1), store, evaluate=rest)
    assert 0 < rest.calls <= GRID.size - done + 1
    assert files(store) == files(whole)


DIFFERENCES = {
    "a parameter": ({"base": WheelParams(stiffness=450.0)}, "wheel.stiffness is 500.0"),
    "a tolerance": ({"options": vrw.Options(rtol=1e-8)}, "options.rtol"),
    "the ground": ({"model": vrw.ViscoelasticWheel(friction=0.7)}, "model.friction is 1.0"),
    "the chunks": ({"chunk": 2}, "chunk"),
}


@pytest.mark.parametrize("what", DIFFERENCES)
def test_a_store_made_with_other_settings_is_refused_by_naming_them(
    what: str, tmp_path: Path
) -> None:
    store = tmp_path / "s.zarr"
    run(planned(), store, evaluate=arithmetic)
    before = files(store)
    changes, expected = DIFFERENCES[what]
    with pytest.raises(ValueError, match="made with other settings") as caught:
        run(planned(**changes), store, evaluate=arithmetic)
    assert expected in str(caught.value)
    assert files(store) == before


def test_other_samples_or_measures_are_refused_by_naming_them(tmp_path: Path) -> None:
    store = tmp_path / "s.zarr"
    run(planned(), store, evaluate=arithmetic)
    moved = designs.grid(damping=GRID.values["damping"] + 1.0, slope=GRID.values["slope"])
    with pytest.raises(ValueError, match="values of the swept parameters differ"):
        run(plan(moved, MEASURES, chunk=4), store)
    with pytest.raises(ValueError, match="measures is"):
        run(plan(GRID, MEASURES[:2], chunk=4), store)
    with pytest.raises(ValueError, match=r"design\.shape"):
        run(plan(designs.grid(damping=[1.0, 2.0], slope=[0.3]), MEASURES, chunk=4), store)


def test_a_folder_that_holds_no_scan_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear reader")
    with pytest.raises(ValueError, match="no scan's store"):
        run(planned(), tmp_path, evaluate=arithmetic)
    assert files(tmp_path) == {"letter.txt": b"dear reader"}


def test_an_unfinished_scan_is_not_gone_on_with_by_other_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "s.zarr"
    with pytest.raises(KeyboardInterrupt):
        run(planned(), store, evaluate=Counted(2))
    monkeypatch.setattr(planning, "code_digest", lambda: "other")
    with pytest.raises(ValueError, match="the library's code differs"):
        run(planned(), store, evaluate=arithmetic)
    monkeypatch.undo()
    run(planned(), store, evaluate=arithmetic)
    monkeypatch.setattr(planning, "code_digest", lambda: "other")
    run(planned(), store, evaluate=Counted(1))  # finished: nothing is computed, all is there


# Layout and labels


def test_every_sample_is_in_exactly_one_chunk() -> None:
    design = designs.grid(damping=[1.0, 2.0, 3.0], slope=[0.1, 0.2], stiffness=np.arange(1.0, 8.0))
    for chunk in (1, 2, 5, 7, 8, 14, 40, 42, 100):
        layout = plan(design, MEASURES, chunk=chunk).layout
        assert np.prod(layout.chunk) <= chunk
        seen = np.zeros(design.shape, int)
        for index in range(layout.n_chunks):
            seen[layout.region(index)] += 1
        assert np.all(seen == 1)


def test_chunks_are_slabs() -> None:
    assert chunk_shape((16, 8, 4, 8), 1024) == (4, 8, 4, 8)
    assert chunk_shape((10_000,), 4096) == (4096,)
    assert chunk_shape((3, 5), 4096) == (3, 5)


def test_values_stand_at_their_coordinates() -> None:
    told = run(planned(), evaluate=arithmetic)
    for damping in GRID.values["damping"]:
        for slope in GRID.values["slope"]:
            at = told.sel(damping=damping, slope=slope)
            assert at.dls_fraction == pytest.approx(np.sin(damping) + np.sin(slope), abs=1e-15)


def test_every_variable_says_what_it_is() -> None:
    told = run(planned(), evaluate=arithmetic)
    for name in (*ALWAYS, "dls_fraction", "d dls_fraction / d damping", "damping", "slope"):
        assert told[name].attrs["units"]
        assert told[name].attrs["long_name"]
    assert len(told.outcome.attrs["flag_values"]) == len(Outcome)
    assert told.outcome.attrs["flag_meanings"].split()[0] == "STEPPED"
    assert json.loads(told.attrs["scan"])["wheel"]["stiffness"] == 500.0
    assert "jax" in json.loads(told.attrs["provenance"])["versions"]


def test_progress_counts_samples_failures_and_what_was_kept(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(planned(), tmp_path / "s.zarr", evaluate=Counted(2))
    told: list[Progress] = []
    result = run(planned(), tmp_path / "s.zarr", evaluate=arithmetic, report=told.append)
    assert (told[0].done, told[0].samples, told[0].kept) == (0, 16, 4)
    assert (told[-1].done, told[-1].samples) == (16, 16)
    assert told[-1].failed == int(np.sum(result.outcome.values[1:] != Outcome.STEPPED))


def test_the_first_difference_is_named_by_its_path() -> None:
    assert first_difference({"a": {"b": 1}}, {"a": {"b": 2}}) == ("a.b", 1, 2)
    assert first_difference({"a": 1}, {"a": 1, "c": 3}) == ("c", None, 3)
    assert first_difference({"a": 1}, {"a": 1})[0] == ""


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: designs.grid(), "sweeps no parameter"),
        (lambda: designs.grid(dampin=[1.0]), "did you mean 'damping'"),
        (lambda: designs.grid(damping=[]), "has no values"),
        (lambda: designs.samples({"damping": [1.0], "slope": [0.1, 0.2]}), "one length"),
        (lambda: designs.sobol({"damping": (2.0, 1.0)}, 4), "holds nothing"),
        (lambda: designs.uniform({"damping": (1.0, 2.0)}, 0), "at least 1"),
        (lambda: plan(GRID, ["sped"]), "did you mean 'speed'"),
        (lambda: plan(GRID, chunk=0), "at least 1"),
    ],
)
def test_a_wrong_design_gets_one_sentence(make, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        make()


# The engine


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(planned().for_engine, threads=2)


@pytest.fixture(scope="module")
def told(engine: Engine) -> Mapping[str, np.ndarray]:
    return engine(GRID.block((slice(None), slice(None))))


def test_table_1_gives_the_paper_s_gait(engine: Engine) -> None:
    told = engine({"damping": np.array([200.0])})
    assert told["outcome"] == Outcome.STEPPED
    assert told["dls_fraction"] == pytest.approx(0.5315, abs=1e-4)
    assert told["speed"] == pytest.approx(0.8700, abs=1e-4)
    assert told["fore_foot_force"] == pytest.approx(103.9, abs=0.05)


def test_a_sample_s_result_is_bitwise_its_own(
    engine: Engine, told: Mapping[str, np.ndarray]
) -> None:
    """Alone, in another order, in another company, at another place of a batch."""
    columns = GRID.block((slice(None), slice(None)))
    order = np.random.default_rng(0).permutation(GRID.size)
    shuffled = engine({name: column[order] for name, column in columns.items()})
    alone = engine({name: column[7:8] for name, column in columns.items()})
    strangers = {"damping": np.full(40, 60.0), "slope": np.full(40, 0.5)}
    mixed = engine({n: np.concatenate([strangers[n], columns[n]]) for n in columns})
    for name, value in told.items():
        np.testing.assert_array_equal(shuffled[name], value[order], name)
        np.testing.assert_array_equal(alone[name], value[7:8], name)
        np.testing.assert_array_equal(mixed[name][40:], value, name)


def test_a_scan_does_not_depend_on_its_chunks(engine: Engine) -> None:
    by_chunk = [run(planned(chunk), evaluate=engine).drop_attrs() for chunk in (12, GRID.size)]
    for other in by_chunk[1:]:
        xr.testing.assert_identical(by_chunk[0], other)


def test_bad_samples_get_codes_and_leave_their_neighbours_alone(engine: Engine) -> None:
    good = {"damping": np.array([150.0, 200.0]), "slope": np.array([0.3, 0.3])}
    bad = {
        "damping": np.array([np.nan, -5.0, np.inf, 200.0]),
        "slope": np.array([0.3, 0.3, 0.3, 2]),
    }
    mixed = engine({name: np.concatenate([bad[name], good[name]]) for name in good})
    np.testing.assert_array_equal(mixed["outcome"][:4], Outcome.BAD_INPUT)
    for name, value in engine(good).items():
        np.testing.assert_array_equal(mixed[name][4:], value, name)
        assert np.all(np.isfinite(value)), name
    for name in ("dls_fraction", "fore_foot_force"):
        assert np.all(np.isnan(mixed[name][:4]))


def test_a_derivative_by_name_is_the_difference_quotient(engine: Engine) -> None:
    h = 1e-3
    near = engine({"damping": np.array([180.0 - h, 180.0, 180.0 + h])})
    quotient = (near["dls_fraction"][2] - near["dls_fraction"][0]) / (2 * h)
    assert near["d_dls_fraction_d_damping"][1] == pytest.approx(quotient, rel=1e-5)


def test_every_parameter_can_be_swept_at_once(engine: Engine) -> None:
    base = WheelParams()
    rng = np.random.default_rng(1)
    columns = {
        name: float(getattr(base, name)) * (1.0 + 0.01 * rng.uniform(-1, 1, 8))
        for name in PARAMETER_NAMES
    }
    told = engine(columns)
    stepped = told["outcome"] == Outcome.STEPPED
    assert np.count_nonzero(stepped) >= 4
    assert len(np.unique(told["speed"][stepped])) == np.count_nonzero(stepped)


def test_a_cycle_is_a_fixed_point_of_the_event_driven_step(
    engine: Engine, told: Mapping[str, np.ndarray]
) -> None:
    assert np.all(told["outcome"] == Outcome.STEPPED)
    cycle = vrw.limit_cycle(WheelParams(damping=150.0, slope=0.3))
    back = vrw.return_map(WheelParams(damping=150.0, slope=0.3), cycle.section_state)
    np.testing.assert_allclose(back, cycle.section_state, atol=1e-8)


def test_a_cycle_that_the_step_does_not_confirm_is_told_so(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine({"damping": np.array([200.0])})
    monkeypatch.setattr(finder, "AGREEMENT", 0.0)
    told = engine({"damping": np.array([200.0])})
    assert told["outcome"] == Outcome.MESH_TOO_COARSE
    assert np.isnan(told["speed"])


def test_the_engine_is_traced_once(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    engine({"damping": np.array([200.0])})
    monkeypatch.setattr(Engine, "_compile", lambda *_: pytest.fail("compiled again"))
    engine({"slope": np.array([0.29, 0.3]), "stiffness": np.array([480.0, 500.0])})


# Many at work


def test_batches_run_side_by_side_and_change_nothing(
    engine: Engine, told: Mapping[str, np.ndarray]
) -> None:
    """Each of two batches waits until the other has begun: with turns none would ever go on."""
    both = threading.Barrier(2, timeout=60.0)
    programs = [engine._free.get(timeout=60.0) for _ in range(2)]

    def met(program: Callable) -> Callable:
        return lambda values: (both.wait(), program(values))[1]

    for program in programs:
        engine._free.put(program._replace(cycle=met(program.cycle)))
    columns = GRID.block((slice(None), slice(None)))
    size = LANES + GRID.size
    together = engine({name: np.resize(column, size) for name, column in columns.items()})
    for _ in programs:
        engine._free.get()
    for program in programs:
        engine._free.put(program)
    for name, value in told.items():
        np.testing.assert_array_equal(together[name][: GRID.size], value, name)
        np.testing.assert_array_equal(together[name][LANES:], np.roll(value, -12, 0), name)


ON_TWO_DEVICES = """
import os, sys
os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=2"
import jax, numpy as np
import vrw_jax
from vrw_jax.scans.evaluate import LANES
vrw_jax.start_jax(os.environ["JAX_COMPILATION_CACHE_DIR"])
sys.path.insert(0, {tests!r})
from support import scanning
of = scanning.planned()
engine = scanning.Engine(of.for_engine)
columns = scanning.GRID.block((slice(None), slice(None)))
size = LANES + scanning.GRID.size
told = engine({{name: np.resize(column, size) for name, column in columns.items()}})
devices = {{engine._free.get().device.id for _ in range(engine._workers)}}
assert devices == {{0, 1}}, devices
np.savez({place!r}, **told)
"""


def test_two_devices_give_bitwise_what_one_gives(
    told: Mapping[str, np.ndarray], tmp_path: Path
) -> None:
    """Two batches, one for each device of a process that has two."""
    place = tmp_path / "told.npz"
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    code = ON_TWO_DEVICES.format(tests=str(Path(__file__).parents[1]), place=str(place))
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
    together = np.load(place)
    assert set(together) == set(told)
    for name, value in told.items():
        np.testing.assert_array_equal(together[name][: GRID.size], value, name)
        np.testing.assert_array_equal(together[name][LANES:], np.roll(value, -12, 0), name)


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_gives_bitwise_the_serial_scan(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two worker processes; the one at work on most chunks is killed with signal 9 in mid-scan."""
    from distributed import Client, LocalCluster

    alone, shared = tmp_path / "alone.zarr", tmp_path / "shared.zarr"
    run(planned(1), alone, evaluate=engine)
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", cache)  # workers start out with the suite's
    told: list[Progress] = []
    killed: list[int] = []
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
        workers(cluster.scheduler_address) as through,
    ):
        places = client.run(os.getpid)

        def report(progress: Progress) -> None:
            told.append(progress)
            if progress.done and not killed:
                busy = client.processing()
                victim = max(places, key=lambda place: len(busy.get(place, ())))
                if busy.get(victim):  # else both are done with what they had: at a later chunk
                    killed.append(places[victim])
                    os.kill(places[victim], signal.SIGKILL)

        result = run(planned(1), shared, report=report, through=through)
        assert len(killed) == 1
        assert killed[0] not in client.run(os.getpid).values()
    assert told[-1].done == GRID.size
    assert np.all(result.outcome.values != -1)
    assert files(shared) == files(alone)


def test_a_worker_names_its_traces_as_the_process_that_asked() -> None:
    """Otherwise each would trace and compile what the cache holds."""
    here = planned().for_engine
    there = pickle.loads(pickle.dumps(here))
    assert repr(Engine(here)._settings) == repr(Engine(there)._settings)


def backwards(planned: Plan, missing: Sequence[int]) -> Iterator[Chunk]:
    for index in reversed(missing):
        yield index, arithmetic(planned.design.block(planned.layout.region(index)))


def test_chunks_may_come_in_any_order(tmp_path: Path) -> None:
    run(planned(), tmp_path / "whole.zarr", evaluate=arithmetic)
    run(planned(), tmp_path / "backwards.zarr", through=backwards)
    assert files(tmp_path / "backwards.zarr") == files(tmp_path / "whole.zarr")


def test_workers_of_another_kind_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cluster of threads in this process, which say that they run other code."""
    from distributed import LocalCluster

    scan_dask = dask
    told = iter([{"code": "ours"}])
    monkeypatch.setattr(scan_dask, "origin", lambda: next(told, {"code": "theirs"}))
    monkeypatch.setattr(scan_dask, "_engine", lambda _: arithmetic)
    with (
        LocalCluster(n_workers=1, processes=False, dashboard_address=None) as cluster,
        workers(cluster.scheduler_address) as through,
        pytest.raises(ValueError, match="the library's code differs"),
    ):
        run(planned(), tmp_path / "s.zarr", through=through)
    assert np.all(open_scan(tmp_path / "s.zarr").outcome.values == -1)


def test_an_address_without_a_scheduler_gets_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dask, "ANSWER", "1s")
    for address in ("nonsense://there", "tcp://127.0.0.1:9"):
        with pytest.raises(ValueError, match="no dask scheduler answers"), workers(address):
            pass
