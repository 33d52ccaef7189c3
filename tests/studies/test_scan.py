"""Scans survive kills, do not mix designs, and compute each sample independently of the others."""

import errno
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from support.scanning import (
    SCANNED_MEASURES,
    SMALL_GRID,
    CountingEngine,
    evaluate_arithmetically,
    make_plan,
    run_plan,
)

import vrw_jax as vrw
from vrw_jax import Outcome, WheelParams
from vrw_jax.app.config import parse_config
from vrw_jax.gaits import finder
from vrw_jax.lanes.keys import make_key
from vrw_jax.models import MARGIN_MEASURES
from vrw_jax.studies import ScanPlan, ScanProgress, plan_scan, scan_engines, scan_store
from vrw_jax.studies import scan_design as designs
from vrw_jax.studies import scan_execution as dask
from vrw_jax.studies import scan_planning as planning
from vrw_jax.studies.scan_engines import SCAN_BATCH_SIZE, CollocationScanEngine
from vrw_jax.studies.scan_planning import describe_settings_difference
from vrw_jax.wheel import PARAMETER_NAMES


def list_files(store: Path) -> dict[str, bytes]:
    return {str(p.relative_to(store)): p.read_bytes() for p in store.rglob("*") if p.is_file()}


# What a store promises


def test_a_stored_scan_equals_the_scan_in_memory(tmp_path: Path) -> None:
    scan_in_memory = run_plan(make_plan(), evaluate=evaluate_arithmetically)
    stored_scan = run_plan(make_plan(), tmp_path / "s.zarr", evaluate=evaluate_arithmetically)
    xr.testing.assert_identical(scan_in_memory.drop_attrs(), stored_scan.load().drop_attrs())
    assert scan_in_memory.attrs == stored_scan.attrs


def test_a_stored_scan_opens_with_xarray_alone(tmp_path: Path) -> None:
    run_plan(make_plan(), tmp_path / "s.zarr", evaluate=evaluate_arithmetically)
    opened_scan = xr.open_zarr(tmp_path / "s.zarr", consolidated=False, chunks=None)
    assert opened_scan.speed.dims == ("damping", "slope")
    assert opened_scan.speed.attrs["units"] == "m/s"
    np.testing.assert_array_equal(opened_scan.damping, SMALL_GRID.values_by_parameter["damping"])


def test_a_stored_list_of_samples_keeps_its_coordinates(tmp_path: Path) -> None:
    design = designs.sobol({"damping": (100.0, 200.0), "slope": (0.28, 0.3)}, 16)
    scan_in_memory = run_plan(plan_scan(design, SCANNED_MEASURES), evaluate=evaluate_arithmetically)
    stored_scan = run_plan(
        plan_scan(design, SCANNED_MEASURES), tmp_path / "s.zarr", evaluate=evaluate_arithmetically
    )
    xr.testing.assert_identical(scan_in_memory.drop_attrs(), stored_scan.load().drop_attrs())
    assert set(stored_scan.coords) == {"sample", "damping", "slope", "leg"}


def test_a_scan_interrupted_at_any_chunk_ends_bitwise_the_same(tmp_path: Path) -> None:
    whole_store = tmp_path / "whole.zarr"
    run_plan(make_plan(), whole_store, evaluate=evaluate_arithmetically)
    n_chunks = make_plan().result_layout.n_chunks
    for stop in range(1, n_chunks + 1):
        store = tmp_path / f"stopped_{stop}.zarr"
        with pytest.raises(KeyboardInterrupt):
            run_plan(make_plan(), store, evaluate=CountingEngine(stop))
        rest = CountingEngine()
        run_plan(make_plan(), store, evaluate=rest)
        assert rest.n_calls == n_chunks - (stop - 1)
        assert list_files(store) == list_files(whole_store)


def test_a_finished_scan_computes_nothing(tmp_path: Path) -> None:
    first = run_plan(make_plan(), tmp_path / "s.zarr", evaluate=evaluate_arithmetically).load()
    counting_engine = CountingEngine()
    second = run_plan(make_plan(), tmp_path / "s.zarr", evaluate=counting_engine)
    assert counting_engine.n_calls == 0
    xr.testing.assert_identical(first, second.load())


def test_an_incompletely_written_chunk_is_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fills up at every possible write: metadata, coordinates, data, the mark itself."""
    import zarr.storage._local as local

    run_plan(make_plan(10), tmp_path / "whole.zarr", evaluate=evaluate_arithmetically)
    placed_values, count = local._put, 0

    def counting(*args: object, **kwargs: object) -> int:
        nonlocal count
        count += 1
        if count == fails_at:
            raise OSError(errno.ENOSPC, "No space left on device")
        return placed_values(*args, **kwargs)

    fails_at, broke_off = 1, 0
    while True:
        store, count = tmp_path / f"{fails_at}.zarr", 0
        monkeypatch.setattr(local, "_put", counting)
        try:
            run_plan(make_plan(10), store, evaluate=evaluate_arithmetically)
        except OSError:
            broke_off += 1
        else:
            break
        finally:
            monkeypatch.setattr(local, "_put", placed_values)
        run_plan(make_plan(10), store, evaluate=evaluate_arithmetically)
        assert list_files(store) == list_files(tmp_path / "whole.zarr")
        fails_at += 17  # coprime to the writes per chunk, so that every kind of write has its turn
    assert broke_off > 4


@pytest.mark.parametrize("wheel", [vrw.UnilateralWheel(), vrw.LadderWheel(friction=0.7)])
def test_settings_of_every_model_can_be_stored(wheel):
    attrs = plan_scan(vrw.grid(friction=[0.5, 0.7]), model=wheel).store_attributes
    assert json.loads(attrs[scan_store.MANIFEST_ATTRIBUTE])["model"]["kind"] == type(wheel).__name__


def test_settings_are_stored_under_the_names_of_version_0_1() -> None:
    """Otherwise a scan would refuse a finished store of that version."""
    settings = make_plan().scan_settings
    assert settings["model"] == {
        "kind": "ViscoelasticWheel", "rung": "viscoelastic", "tells_contacts": False,
        "lanes": "phases", "legs_yield": True, "parameter_names": list(PARAMETER_NAMES),
        "friction": 1.0, "stop_at_lift_off": True,
    }  # fmt: skip
    assert settings["options"] == {
        "kind": "Options", "solver": "Dopri8", "engine": "auto", "rtol": 1e-10, "atol": 1e-10,
        "derivative_tightening": 20.0, "max_phase_time": 20.0, "max_solver_steps": 20_000,
        "first_step": 5e-3, "event_steps": 100, "monitor_steps": 5,
    }  # fmt: skip
    assert settings["cycle_options"] == {
        "kind": "CycleOptions", "steps": [10, 8, 3], "growth": 2.0, "tolerance": 1e-10,
        "iterations": 12, "first_iterations": 4, "stages": 12, "block": 64,
    }  # fmt: skip


KILLED_SCAN_SCRIPT = """
import sys, time
sys.path.insert(0, {tests!r})
import jax
jax.config.update("jax_enable_x64", True)
from support import scanning
def slow(columns):
    time.sleep(0.15)
    return scanning.evaluate_arithmetically(columns)
print("ready", flush=True)
scanning.run_plan(scanning.make_plan(1), {store!r}, evaluate=slow)
"""


def test_a_store_whose_creation_was_killed_is_created_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing that a killed process can leave behind is taken for a store."""
    fill, path = scan_store._create_zarr_arrays, tmp_path / "s.zarr"

    def killed(place: Path, *rest: object) -> None:
        fill(place, *rest)
        raise KeyboardInterrupt

    monkeypatch.setattr(scan_store, "_create_zarr_arrays", killed)
    monkeypatch.setattr(scan_store.shutil, "rmtree", lambda *_, **__: None)  # nothing cleans up
    with pytest.raises(KeyboardInterrupt):
        run_plan(make_plan(), path, evaluate=evaluate_arithmetically)
    assert not path.exists()
    monkeypatch.undo()
    run_plan(make_plan(), tmp_path / "whole.zarr", evaluate=evaluate_arithmetically)
    run_plan(make_plan(), path, evaluate=evaluate_arithmetically)
    assert list_files(path) == list_files(tmp_path / "whole.zarr")


def test_a_scan_killed_with_signal_9_ends_bitwise_the_same(tmp_path: Path) -> None:
    whole_store, store = tmp_path / "whole.zarr", tmp_path / "killed.zarr"
    run_plan(make_plan(1), whole_store, evaluate=evaluate_arithmetically)
    code = KILLED_SCAN_SCRIPT.format(tests=str(Path(__file__).parents[1]), store=str(store))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    while not store.exists() or not np.any(vrw.open_scan(store).outcome.values != -1):
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    done = int(np.sum(vrw.open_scan(store).outcome.values != -1))
    assert 0 < done < SMALL_GRID.size
    rest = CountingEngine()
    run_plan(make_plan(1), store, evaluate=rest)
    assert 0 < rest.n_calls <= SMALL_GRID.size - done + 1
    assert list_files(store) == list_files(whole_store)


SETTING_CHANGES = {
    "a parameter": ({"base": WheelParams(stiffness=450.0)}, "wheel.stiffness is 500.0"),
    "a tolerance": ({"options": vrw.StepOptions(rtol=1e-8)}, "options.rtol"),
    "the ground": ({"model": vrw.ViscoelasticWheel(friction=0.7)}, "model.friction is 1.0"),
    "the chunks": ({"chunk": 2}, "chunk"),
}


@pytest.mark.parametrize("what", SETTING_CHANGES)
def test_a_store_made_with_other_settings_is_refused_by_naming_them(
    what: str, tmp_path: Path
) -> None:
    store = tmp_path / "s.zarr"
    run_plan(make_plan(), store, evaluate=evaluate_arithmetically)
    before = list_files(store)
    changes, expected = SETTING_CHANGES[what]
    with pytest.raises(ValueError, match="made with other settings") as caught:
        run_plan(make_plan(**changes), store, evaluate=evaluate_arithmetically)
    assert expected in str(caught.value)
    assert list_files(store) == before


def test_other_samples_or_measures_are_refused_by_naming_them(tmp_path: Path) -> None:
    store = tmp_path / "s.zarr"
    run_plan(make_plan(), store, evaluate=evaluate_arithmetically)
    design = designs.grid(
        damping=SMALL_GRID.values_by_parameter["damping"] + 1.0,
        slope=SMALL_GRID.values_by_parameter["slope"],
    )
    with pytest.raises(ValueError, match="values of the swept parameters differ"):
        run_plan(plan_scan(design, SCANNED_MEASURES, chunk=4), store)
    with pytest.raises(ValueError, match="measures is"):
        run_plan(plan_scan(SMALL_GRID, SCANNED_MEASURES[:2], chunk=4), store)
    with pytest.raises(ValueError, match=r"design\.shape"):
        run_plan(
            plan_scan(designs.grid(damping=[1.0, 2.0], slope=[0.3]), SCANNED_MEASURES, chunk=4),
            store,
        )


def test_a_folder_that_holds_no_scan_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear reader")
    with pytest.raises(ValueError, match="no scan's store"):
        run_plan(make_plan(), tmp_path, evaluate=evaluate_arithmetically)
    assert list_files(tmp_path) == {"letter.txt": b"dear reader"}


def test_an_unfinished_scan_is_not_continued_by_other_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "s.zarr"
    with pytest.raises(KeyboardInterrupt):
        run_plan(make_plan(), store, evaluate=CountingEngine(2))
    monkeypatch.setattr(planning, "compute_source_digest", lambda: "other")
    with pytest.raises(ValueError, match="the library's code differs"):
        run_plan(make_plan(), store, evaluate=evaluate_arithmetically)
    monkeypatch.undo()
    run_plan(make_plan(), store, evaluate=evaluate_arithmetically)
    monkeypatch.setattr(planning, "compute_source_digest", lambda: "other")
    run_plan(
        make_plan(), store, evaluate=CountingEngine(1)
    )  # finished: nothing is computed, all is there


# Layout and labels


def test_every_sample_is_in_exactly_one_chunk() -> None:
    design = designs.grid(damping=[1.0, 2.0, 3.0], slope=[0.1, 0.2], stiffness=np.arange(1.0, 8.0))
    for chunk in (1, 2, 5, 7, 8, 14, 40, 42, 100):
        layout = plan_scan(design, SCANNED_MEASURES, chunk=chunk).result_layout
        assert np.prod(layout.chunk_shape) <= chunk
        n_chunks_of_sample = np.zeros(design.shape, int)
        for index in range(layout.n_chunks):
            n_chunks_of_sample[layout.compute_chunk_region(index)] += 1
        assert np.all(n_chunks_of_sample == 1)


@pytest.mark.parametrize(
    ("shape", "chunk", "expected"),
    [
        ((16, 8, 4, 8), 1024, (4, 8, 4, 8)),
        ((10_000,), 4096, (4096,)),
        ((3, 5), 4096, (3, 5)),
    ],
)
def test_chunks_are_slabs(shape, chunk, expected) -> None:
    names = ("damping", "slope", "stiffness", "gravity")
    axes = {name: np.linspace(1.0, 1.5, n) for name, n in zip(names, shape, strict=False)}
    plan = plan_scan(vrw.grid(**axes), SCANNED_MEASURES, chunk=chunk)
    assert plan.result_layout.chunk_shape == expected


def test_values_match_their_coordinates() -> None:
    scan_result = run_plan(make_plan(), evaluate=evaluate_arithmetically)
    for damping in SMALL_GRID.values_by_parameter["damping"]:
        for slope in SMALL_GRID.values_by_parameter["slope"]:
            sample = scan_result.sel(damping=damping, slope=slope)
            assert sample.dls_fraction == pytest.approx(np.sin(damping) + np.sin(slope), abs=1e-15)


def test_every_variable_is_described() -> None:
    scan_result = run_plan(make_plan(), evaluate=evaluate_arithmetically)
    names = {"outcome", "spectral_radius", *MARGIN_MEASURES, *SCANNED_MEASURES, *SMALL_GRID.dims}
    assert names <= set(scan_result.variables)
    for variable in scan_result.variables.values():
        assert variable.attrs["units"]
        assert variable.attrs["long_name"]
    assert len(scan_result.outcome.attrs["flag_values"]) == len(Outcome)
    assert scan_result.outcome.attrs["flag_meanings"].split()[0] == "STEPPED"
    assert json.loads(scan_result.attrs["scan"])["wheel"]["stiffness"] == 500.0
    assert "jax" in json.loads(scan_result.attrs["provenance"])["versions"]


def test_progress_counts_samples_failures_and_reused_samples(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_plan(make_plan(), tmp_path / "s.zarr", evaluate=CountingEngine(2))
    reports: list[ScanProgress] = []
    result = run_plan(
        make_plan(),
        tmp_path / "s.zarr",
        evaluate=evaluate_arithmetically,
        on_progress=reports.append,
    )
    assert (reports[0].n_done, reports[0].n_samples, reports[0].n_reused) == (0, 16, 4)
    assert (reports[-1].n_done, reports[-1].n_samples) == (16, 16)
    assert reports[-1].n_failed == int(np.sum(result.outcome.values[1:] != Outcome.STEPPED))


def test_the_first_difference_is_named_by_its_path() -> None:
    nested_difference = describe_settings_difference({"a": {"b": 1}}, {"a": {"b": 2}})
    assert nested_difference == "a.b is 1 there and 2 here"
    additional_setting = describe_settings_difference({"a": 1}, {"a": 1, "c": 3})
    assert additional_setting == "c is None there and 3 here"
    assert describe_settings_difference({"a": 1}, {"a": 1}) == ""


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: designs.grid(), "sweeps no parameter"),
        (lambda: plan_scan(designs.grid(dampin=[1.0])), "did you mean 'damping'"),
        (lambda: designs.grid(damping=[]), "has no values"),
        (lambda: designs.samples({"damping": [1.0], "slope": [0.1, 0.2]}), "one length"),
        (lambda: designs.sobol({"damping": (2.0, 1.0)}, 4), "holds nothing"),
        (lambda: designs.uniform({"damping": (1.0, 2.0)}, 0), "at least 1"),
        (lambda: plan_scan(SMALL_GRID, ["sped"]), "did you mean 'speed'"),
        (lambda: plan_scan(SMALL_GRID, chunk=0), "at least 1"),
    ],
)
def test_a_wrong_design_gets_one_sentence(make, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        make()


# The engine


@pytest.fixture(scope="module")
def engine() -> CollocationScanEngine:
    return CollocationScanEngine(make_plan().evaluation_request, n_threads=2)


@pytest.fixture(scope="module")
def engine_results(engine: CollocationScanEngine) -> Mapping[str, np.ndarray]:
    return engine(SMALL_GRID.select_samples((slice(None), slice(None))))


def test_table_1_gives_the_paper_s_gait(engine: CollocationScanEngine) -> None:
    values_by_name = engine({"damping": np.array([200.0])})
    assert values_by_name["outcome"] == Outcome.STEPPED
    assert values_by_name["dls_fraction"] == pytest.approx(0.5315, abs=1e-4)
    assert values_by_name["speed"] == pytest.approx(0.8700, abs=1e-4)
    assert values_by_name["fore_foot_force"] == pytest.approx(103.9, abs=0.05)


def test_the_result_of_a_sample_does_not_depend_on_the_others(
    engine: CollocationScanEngine, engine_results: Mapping[str, np.ndarray]
) -> None:
    """Alone, in another order, in another company, at another place of a batch."""
    columns = SMALL_GRID.select_samples((slice(None), slice(None)))
    order = np.random.default_rng(0).permutation(SMALL_GRID.size)
    shuffled = engine({name: column[order] for name, column in columns.items()})
    single_sample = engine({name: column[7:8] for name, column in columns.items()})
    strangers = {"damping": np.full(40, 60.0), "slope": np.full(40, 0.5)}
    mixed = engine({n: np.concatenate([strangers[n], columns[n]]) for n in columns})
    for name, value in engine_results.items():
        np.testing.assert_array_equal(shuffled[name], value[order], name)
        np.testing.assert_array_equal(single_sample[name], value[7:8], name)
        np.testing.assert_array_equal(mixed[name][40:], value, name)


def test_rows_outside_a_domain_are_known_before_a_gait_with_contact_is_searched() -> None:
    plan = plan_scan(vrw.grid(slope=[0.3]), ["speed"], model=vrw.UnilateralWheel())
    samples = {"slope": np.array([0.3, np.nan, 0.3]), "friction": np.array([np.inf, 0.8, -1.0])}
    request = plan.evaluation_request
    is_inside = request.are_rows_in_domain(request.stack_parameter_rows(samples))
    np.testing.assert_array_equal(is_inside, [True, False, False])


def test_a_scan_does_not_depend_on_its_chunks(engine: CollocationScanEngine) -> None:
    by_chunk = [
        run_plan(make_plan(chunk), evaluate=engine).drop_attrs() for chunk in (12, SMALL_GRID.size)
    ]
    for other in by_chunk[1:]:
        xr.testing.assert_identical(by_chunk[0], other)


def test_invalid_samples_get_outcomes_and_leave_the_others_unchanged(
    engine: CollocationScanEngine,
) -> None:
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


def scan_and_search(rows: np.ndarray) -> tuple[xr.Dataset, vrw.LimitCycle]:
    """Return the scan and the limit cycles of wheels with given dampings, stiffnesses, natural
    lengths and slopes."""
    columns = dict(
        zip(("damping", "stiffness", "natural_length", "slope"), np.transpose(rows), strict=True)
    )
    measures = ["dls_fraction", "speed", "spectral_radius"]
    return vrw.scan(vrw.samples(columns), measures), vrw.limit_cycles(WheelParams(**columns))


def check_same_gaits(scanned: xr.Dataset, cycles: vrw.LimitCycle) -> None:
    """The scan has one mesh for each wheel, and `limit_cycles` one for all: 1e-9 in values."""
    np.testing.assert_array_equal(scanned.outcome, cycles.outcome)
    found = np.asarray(cycles.found)
    for name in ("dls_fraction", "speed", "spectral_radius"):
        np.testing.assert_allclose(
            scanned[name].values[found], getattr(cycles, name)[found], rtol=1e-7, atol=1e-8
        )


def test_a_scan_reports_the_gaits_and_reasons_that_limit_cycles_reports() -> None:
    """Found at once, on a finer mesh, from a walk, in more iterations; and three kinds of failure.

    By the attempts on one mesh alone, the second and the third wheel have no gait."""
    scanned, cycles = scan_and_search(
        np.array(
            [
                [200.0, 500.0, 1.025, 0.3],
                [95.09570, 872.5634, 1.0342, 0.0687],
                [152.4933, 2104.4025, 1.002, 0.1199],
                [47.9742225, 927.510420, 1.02902603, 0.130571501],
                [300.0, 500.0, 1.025, 0.3],
                [28.9, 4000.0, 1.0, 0.05],
                [np.nan, 500.0, 1.025, 0.3],
            ]
        )
    )
    assert np.asarray(cycles.found).tolist() == [True] * 4 + [False] * 3
    check_same_gaits(scanned, cycles)


@pytest.mark.slow
def test_a_scan_far_from_the_paper_s_ranges_finds_every_gait() -> None:
    """400 wheels, of which earlier scans found 71 gaits and `limit_cycles` 144.

    24,576 walks from random starts on the other wheels settled on no further gait."""
    lows, highs = np.log([[20.0, 300.0, 1.0, 0.05], [400.0, 3000.0, 1.05, 0.35]])
    rows = np.exp(np.random.default_rng(42).uniform(lows, highs, (400, 4)))
    scanned, cycles = scan_and_search(rows)
    assert np.count_nonzero(cycles.found) >= 144
    check_same_gaits(scanned, cycles)


def test_a_derivative_by_name_equals_the_difference_quotient(engine: CollocationScanEngine) -> None:
    h = 1e-3
    near = engine({"damping": np.array([180.0 - h, 180.0, 180.0 + h])})
    quotient = (near["dls_fraction"][2] - near["dls_fraction"][0]) / (2 * h)
    assert near["d_dls_fraction_d_damping"][1] == pytest.approx(quotient, rel=1e-5)


def test_every_parameter_can_be_swept_at_once(engine: CollocationScanEngine) -> None:
    base = WheelParams()
    rng = np.random.default_rng(1)
    columns = {
        name: float(getattr(base, name)) * (1.0 + 0.01 * rng.uniform(-1, 1, 8))
        for name in PARAMETER_NAMES
    }
    values_by_name = engine(columns)
    step_result = values_by_name["outcome"] == Outcome.STEPPED
    assert np.count_nonzero(step_result) >= 4
    assert len(np.unique(values_by_name["speed"][step_result])) == np.count_nonzero(step_result)


def test_a_cycle_is_a_fixed_point_of_the_event_driven_step(
    engine: CollocationScanEngine, engine_results: Mapping[str, np.ndarray]
) -> None:
    assert np.all(engine_results["outcome"] == Outcome.STEPPED)
    cycle = vrw.limit_cycle(WheelParams(damping=150.0, slope=0.3))
    back = vrw.return_map(WheelParams(damping=150.0, slope=0.3), cycle.section_state)
    np.testing.assert_allclose(back, cycle.section_state, atol=1e-8)


def test_a_cycle_that_the_step_does_not_confirm_has_an_outcome(
    engine: CollocationScanEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine({"damping": np.array([200.0])})
    monkeypatch.setattr(finder, "STATE_AGREEMENT_TOLERANCE", 0.0)
    values_by_name = engine({"damping": np.array([200.0])})
    assert values_by_name["outcome"] == Outcome.MESH_TOO_COARSE
    assert np.isnan(values_by_name["speed"])


def test_the_engine_is_traced_once(
    engine: CollocationScanEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine({"damping": np.array([200.0])})
    monkeypatch.setattr(
        scan_engines, "compile_exported_function", lambda *_: pytest.fail("compiled again")
    )
    engine({"slope": np.array([0.29, 0.3]), "stiffness": np.array([480.0, 500.0])})


# Many at work


def test_parallel_batches_give_the_same_results(
    engine: CollocationScanEngine,
    engine_results: Mapping[str, np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each of two batches waits until the other has begun: with turns none would ever go on."""
    barrier = threading.Barrier(2, timeout=60.0)
    programs = engine.programs["cycles"]

    def meet(program: Callable) -> Callable:
        return lambda values: (barrier.wait(), program(values))[1]

    meeting_programs = {device: meet(program) for device, program in programs.items()}
    monkeypatch.setitem(engine.programs, "cycles", meeting_programs)
    columns = SMALL_GRID.select_samples((slice(None), slice(None)))
    size = SCAN_BATCH_SIZE + SMALL_GRID.size
    joint_result = engine({name: np.resize(column, size) for name, column in columns.items()})
    for name, value in engine_results.items():
        np.testing.assert_array_equal(joint_result[name][: SMALL_GRID.size], value, name)
        np.testing.assert_array_equal(
            joint_result[name][SCAN_BATCH_SIZE:], np.roll(value, -12, 0), name
        )


TWO_DEVICE_SCRIPT = """
import os, sys
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " {flag}"
import jax, numpy as np
import vrw_jax
from vrw_jax.studies.scan_engines import SCAN_BATCH_SIZE
from vrw_jax.studies.scan_engines import CollocationScanEngine
vrw_jax.start_jax(os.environ["JAX_COMPILATION_CACHE_DIR"])
sys.path.insert(0, {tests!r})
from support import scanning
engine = CollocationScanEngine(scanning.make_plan().evaluation_request)
columns = scanning.SMALL_GRID.select_samples((slice(None), slice(None)))
size = SCAN_BATCH_SIZE + scanning.SMALL_GRID.size
results = engine({{name: np.resize(column, size) for name, column in columns.items()}})
for programs in (engine.programs["cycles"], engine.programs["steps"]):
    assert {{device.id for device in programs}} == {{0, 1}}, programs
np.savez({place!r}, **results)
"""


def test_two_devices_give_bitwise_the_results_of_one(
    engine_results: Mapping[str, np.ndarray], tmp_path: Path
) -> None:
    """Two batches, one for each device of a process that has two."""
    place = tmp_path / "told.npz"
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    code = TWO_DEVICE_SCRIPT.format(
        tests=str(Path(__file__).parents[1]),
        place=str(place),
        flag="--xla_force_host_platform_device_count=2",
    )
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
    joint_result = np.load(place)
    assert set(joint_result) == set(engine_results)
    for name, value in engine_results.items():
        np.testing.assert_array_equal(joint_result[name][: SMALL_GRID.size], value, name)
        np.testing.assert_array_equal(
            joint_result[name][SCAN_BATCH_SIZE:], np.roll(value, -12, 0), name
        )


def scan_on_cluster(
    store: Path | None, address: str, chunk: int = 4, on_progress: Callable | None = None
) -> xr.Dataset:
    """Return the scan of `make_plan`, computed by the workers of a cluster."""
    return vrw.scan(
        SMALL_GRID,
        SCANNED_MEASURES,
        store=store,
        chunk=chunk,
        on_progress=on_progress,
        dask=address,
    )


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_gives_bitwise_the_serial_scan(
    engine: CollocationScanEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two worker processes; the one at work on most chunks is killed with signal 9 in mid-scan."""
    from distributed import Client, LocalCluster

    serial_store, shared = tmp_path / "alone.zarr", tmp_path / "shared.zarr"
    run_plan(make_plan(1), serial_store, evaluate=engine)
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", cache)  # workers start out with the suite's
    reports: list[ScanProgress] = []
    killed: list[int] = []
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        places = client.run(os.getpid)

        def report(progress: ScanProgress) -> None:
            reports.append(progress)
            if progress.n_done and not killed:
                busy = client.processing()
                victim = max(places, key=lambda place: len(busy.get(place, ())))
                if busy.get(victim):  # else both are done with what they had: at a later chunk
                    killed.append(places[victim])
                    os.kill(places[victim], signal.SIGKILL)

        result = scan_on_cluster(shared, cluster.scheduler_address, 1, report)
        assert len(killed) == 1
        assert killed[0] not in client.run(os.getpid).values()
    assert reports[-1].n_done == SMALL_GRID.size
    assert np.all(result.outcome.values != -1)
    assert list_files(shared) == list_files(serial_store)


def test_a_worker_uses_the_trace_keys_of_the_calling_process() -> None:
    """Otherwise each would trace and compile what the cache holds."""
    evaluation_request = make_plan().evaluation_request
    parsed = pickle.loads(pickle.dumps(evaluation_request))
    own, of_worker = map(CollocationScanEngine, (evaluation_request, parsed))
    for name in ("evaluate_cycles", "evaluate_steps"):
        assert make_key(getattr(own, name)) == make_key(getattr(of_worker, name))


def compute_backwards(planned: ScanPlan, missing: Sequence[int]) -> Iterator[tuple[int, dict]]:
    for index in reversed(missing):
        yield (
            index,
            evaluate_arithmetically(
                planned.design.select_samples(planned.result_layout.compute_chunk_region(index))
            ),
        )


def test_chunks_may_be_computed_in_any_order(tmp_path: Path) -> None:
    run_plan(make_plan(), tmp_path / "whole.zarr", evaluate=evaluate_arithmetically)
    run_plan(make_plan(), tmp_path / "backwards.zarr", chunk_executor=compute_backwards)
    assert list_files(tmp_path / "backwards.zarr") == list_files(tmp_path / "whole.zarr")


def test_workers_with_another_environment_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cluster of threads in this process, which say that they run other code.

    The threads leave the folder for compiled code that the process has chosen.
    """
    from distributed import LocalCluster

    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    environments = iter([{"code": "ours"}])
    monkeypatch.setattr(
        dask, "describe_computing_environment", lambda: next(environments, {"code": "theirs"})
    )
    monkeypatch.setattr(dask, "make_worker_engine", lambda _: evaluate_arithmetically)
    with (
        LocalCluster(n_workers=1, processes=False, dashboard_address=None) as cluster,
        pytest.raises(ValueError, match="the library's code differs"),
    ):
        scan_on_cluster(tmp_path / "s.zarr", cluster.scheduler_address)
    assert np.all(vrw.open_scan(tmp_path / "s.zarr").outcome.values == -1)
    assert jax.config.jax_compilation_cache_dir == cache  # type: ignore[attr-defined]


@pytest.mark.slow  # compiles the search with a law
def test_workers_of_a_cluster_compute_laws_of_a_script() -> None:
    """Python's pickle refuses functions without a name."""
    from distributed import LocalCluster

    law = lambda L, dL, p: p.stiffness * (p.natural_length - L) - 1.1 * p.damping * dL
    model, design = vrw.ViscoelasticWheel(leg_force=law), vrw.grid(damping=[150.0])
    with LocalCluster(n_workers=1, processes=False, dashboard_address=None) as cluster:
        table = vrw.scan(design, ["period"], model=model, dask=cluster.scheduler_address)
    expected = vrw.limit_cycle(vrw.WheelParams(damping=165.0)).period
    assert float(table.period[0]) == pytest.approx(float(expected), rel=1e-9)


@pytest.mark.slow  # starts a process
def test_a_class_that_workers_cannot_import_gets_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "laws.py").write_text(
        "import equinox as eqx\n"
        "class Leg(eqx.Module):\n"
        "    k: float = 500.0\n"
        "    def __call__(self, L, dL, p):\n"
        "        return self.k * (p.natural_length - L) - p.damping * dL\n"
    )
    monkeypatch.chdir(tmp_path)
    model = parse_config('[model]\nleg_force = "laws.py:Leg"\n').make_model()
    with pytest.raises(ValueError, match="a class that the workers cannot import: define it"):
        vrw.scan(vrw.grid(damping=[150.0]), ["period"], model=model, dask="local")


def test_an_address_without_a_scheduler_gets_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dask, "DASK_SCHEDULER_TIMEOUT", "1s")
    for address in ("nonsense://there", "tcp://127.0.0.1:9"):
        with pytest.raises(ValueError, match="no dask scheduler answers"):
            scan_on_cluster(None, address)


def test_a_cluster_without_workers_is_reported_and_continues_with_the_first_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(dask, "MAX_SECONDS_WITHOUT_RESULT", 0.5)
    monkeypatch.setattr(dask, "make_worker_engine", lambda _: evaluate_arithmetically)
    run_plan(make_plan(), tmp_path / "alone.zarr", evaluate=evaluate_arithmetically)
    with LocalCluster(n_workers=0, processes=False, dashboard_address=None) as cluster:
        messages: list[str] = []

        def show(message: Warning | str, *_: object, **__: object) -> None:
            messages.append(str(message))
            cluster.scale(1)

        with warnings.catch_warnings():
            warnings.simplefilter("always")
            monkeypatch.setattr("warnings.showwarning", show)
            scan_on_cluster(tmp_path / "s.zarr", cluster.scheduler_address)
    assert len([text for text in messages if "has no workers" in text]) == 1
    assert list_files(tmp_path / "s.zarr") == list_files(tmp_path / "alone.zarr")


def test_a_lost_cluster_gets_one_sentence_and_the_scan_continues_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(dask, "make_worker_engine", lambda _: evaluate_arithmetically)
    cluster = LocalCluster(n_workers=1, processes=False, dashboard_address=None)
    n_done_at_loss: list[int] = []

    def close_cluster(progress: ScanProgress) -> None:
        if progress.n_done and not n_done_at_loss:
            n_done_at_loss.append(progress.n_done)
            cluster.close()

    with pytest.raises(ValueError, match=r"the dask cluster at .* is gone: start it again"):
        scan_on_cluster(tmp_path / "s.zarr", cluster.scheduler_address, 1, close_cluster)
    n_kept = np.count_nonzero(vrw.open_scan(tmp_path / "s.zarr").outcome.values != -1)
    assert n_done_at_loss[0] <= n_kept < SMALL_GRID.size
    run_plan(make_plan(1), tmp_path / "whole.zarr", evaluate=evaluate_arithmetically)
    run_plan(make_plan(1), tmp_path / "s.zarr", evaluate=evaluate_arithmetically)
    assert list_files(tmp_path / "s.zarr") == list_files(tmp_path / "whole.zarr")


def test_an_interrupted_scan_names_the_kept_chunks_below_a_short_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "s.zarr"
    with pytest.raises(KeyboardInterrupt, match=r"stopped: 1 of \d+ chunks are kept") as caught:
        run_plan(make_plan(), store, evaluate=CountingEngine(2))
    assert "run the same again, it goes on from there" in str(caught.value)
    assert str(store) in str(caught.value)
    monkeypatch.setattr(ScanPlan, "build_scan_engine", lambda _: CountingEngine(2))
    with pytest.raises(KeyboardInterrupt, match="2 of 5 chunks are kept") as caught:
        vrw.scan(SMALL_GRID, SCANNED_MEASURES, store=store, chunk=4)
    text = "".join(traceback.format_exception(caught.value))
    assert "zarr/" not in text
    assert "During handling" not in text
    # the call of this test, and one function of the library; the annotation checks add others
    assert text.count("vrw_jax/") == 1
    with pytest.raises(KeyboardInterrupt, match="nothing is kept: give store="):
        run_plan(make_plan(), evaluate=CountingEngine(2))
