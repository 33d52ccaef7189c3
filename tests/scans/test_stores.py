"""What lies in a store is what was written there, and anyone may read it."""

import json
import shutil
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from support.scanning import GRID, MEASURES, Counted, arithmetic, planned, run

import vrw_jax as vrw
from vrw_jax.scans import design as designs
from vrw_jax.scans import planning, soundness
from vrw_jax.scans import store as scan_store
from vrw_jax.scans.planning import plan
from vrw_jax.scans.store import open_scan


def files(store: Path) -> dict[str, bytes]:
    return {str(p.relative_to(store)): p.read_bytes() for p in store.rglob("*") if p.is_file()}


@pytest.fixture
def store(tmp_path: Path) -> Path:
    run(planned(), tmp_path / "s.zarr", evaluate=arithmetic)
    return tmp_path / "s.zarr"


def of_version_0_1(store: Path) -> None:
    """Makes a store what it would have been then: marks in sight, no digest, metadata apart."""
    shutil.rmtree(store / "bookkeeping")
    root = json.loads((store / "zarr.json").read_text())
    del root["consolidated_metadata"], root["attributes"]["asked"]
    for name in ("scan", "provenance"):
        root["attributes"][name] = json.loads(root["attributes"][name])
    (store / "zarr.json").write_text(json.dumps(root))
    n = planned().layout.n_chunks
    done = zarr.open_group(store, mode="r+").create_array(
        "chunk_done", shape=(n,), chunks=(1,), dtype="u1", fill_value=0, dimension_names=("chunk",)
    )
    done[:] = 1


# Damage

DAMAGE = {
    "another byte": lambda file: file.write_bytes(file.read_bytes()[:-1] + b"?"),
    "truncated": lambda file: file.write_bytes(file.read_bytes()[:5]),
    "empty": lambda file: file.write_bytes(b""),
    "deleted": lambda file: file.unlink(),
}
CHUNK = "c/1/0"
"""The file of the chunk of number 1: each holds one value of damping."""


@pytest.mark.parametrize("what", DAMAGE)
@pytest.mark.parametrize("variable", ["outcome", "speed", "clearance_sls1", "locked_stopper_force"])
def test_a_damaged_chunk_is_computed_again_and_said(store: Path, what: str, variable: str) -> None:
    whole, n = files(store), planned().layout.n_chunks
    file = store / variable / (CHUNK + "/0" * (variable == "locked_stopper_force"))
    DAMAGE[what](file)
    with pytest.raises(ValueError, match=r"1 damaged chunk \(number 1\): run the scan again"):
        open_scan(store)
    again = Counted()
    with pytest.warns(UserWarning, match=r"1 damaged chunk \(number 1\): computed again"):
        run(planned(), store, evaluate=again)
    assert again.calls == 1 < n
    assert files(store) == whole


def test_a_scan_at_work_may_be_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a scan writes between two looks at its store is no damage."""
    path, read = tmp_path / "s.zarr", zarr.Array.__getitem__
    with pytest.raises(KeyboardInterrupt):
        run(planned(), path, evaluate=Counted(fails_at=3))

    def and_meanwhile(array: zarr.Array, where: object) -> object:
        told = read(array, where)
        if array.path == soundness.DIGEST:
            with monkeypatch.context() as as_before:
                as_before.setattr(zarr.Array, "__getitem__", read)
                with pytest.raises(KeyboardInterrupt):
                    run(planned(), path, evaluate=Counted(fails_at=2))
        return told

    monkeypatch.setattr(zarr.Array, "__getitem__", and_meanwhile)
    open_scan(path)
    monkeypatch.undo()
    assert np.sum(open_scan(path).outcome.values[:, 0] != -1) > 2  # it did go on


def test_damage_beside_an_unfinished_scan_is_found_too(tmp_path: Path) -> None:
    store = tmp_path / "s.zarr"
    run(planned(), tmp_path / "whole.zarr", evaluate=arithmetic)
    with pytest.raises(KeyboardInterrupt):
        run(planned(), store, evaluate=Counted(4))
    (store / "speed" / CHUNK).unlink()
    rest = Counted()
    with pytest.warns(UserWarning, match="damaged"):
        run(planned(), store, evaluate=rest)
    assert rest.calls == planned().layout.n_chunks - 3 + 1
    assert files(store) == files(tmp_path / "whole.zarr")


def test_damaged_coordinates_are_written_again(store: Path) -> None:
    whole = files(store)
    (store / "damping" / "c" / "0").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="damaged coordinates"):
        open_scan(store)
    again = Counted()
    with pytest.warns(UserWarning, match="damaged coordinates"):
        run(planned(), store, evaluate=again)
    assert again.calls == 0
    assert files(store) == whole


def test_what_is_left_of_a_damaged_store_can_be_read(store: Path) -> None:
    (store / "speed" / CHUNK).unlink()
    left = open_scan(store, verify=False)
    assert np.isnan(left.speed.values[1]).all()
    assert np.isfinite(left.speed.values[0]).all()


def test_a_damaged_chunk_of_other_code_is_not_mixed_in(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (store / "speed" / CHUNK).unlink()
    monkeypatch.setattr(planning, "code_digest", lambda: "other")
    with pytest.raises(ValueError, match=r"lacks 1 of 5 chunks \(1 of them damaged\)"):
        run(planned(), store, evaluate=arithmetic)


@pytest.mark.parametrize("what", [None, *DAMAGE])
def test_a_store_of_version_0_1_opens_and_its_damage_is_seen(store: Path, what: str | None) -> None:
    before = open_scan(store).load()
    of_version_0_1(store)
    if what is None:
        after = open_scan(store).load()
        xr.testing.assert_identical(
            before.rename({MEASURES[2]: "d_dls_fraction_d_damping"}).drop_attrs(),
            after.drop_attrs(),
        )
        assert run(planned(), store, evaluate=Counted(1)).attrs["scan"]
        return
    DAMAGE[what](store / "speed" / CHUNK)
    with pytest.raises(ValueError, match=r"1 damaged chunk \(number 1\)"):
        open_scan(store)


# Reading


def test_xarray_opens_a_store_without_a_warning_and_sees_no_bookkeeping(store: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = xr.open_zarr(store)
    assert list(alone.data_vars)[:4] == [*MEASURES[:2], "d_dls_fraction_d_damping", "outcome"]
    assert set(alone.sizes) == {"damping", "slope", "leg"}


@pytest.mark.parametrize("place", [None, "s.zarr"])
def test_variables_come_in_the_order_and_by_the_names_asked_for(
    tmp_path: Path, place: str | None
) -> None:
    asked = ("speed", "d dls_fraction / d damping", "outcome", "dls_fraction")
    told = run(plan(GRID, asked), place and tmp_path / place, evaluate=arithmetic)
    assert tuple(told.data_vars)[:4] == asked
    assert told["d dls_fraction / d damping"].attrs["units"]
    underscored = run(plan(GRID, ["d_dls_fraction_d_damping"]), evaluate=arithmetic)
    assert next(iter(underscored.data_vars)) == "d_dls_fraction_d_damping"


@pytest.mark.parametrize("place", [None, "s.zarr"])
@pytest.mark.parametrize("kind", ["grid", "saltelli"])
def test_a_scan_goes_into_a_netcdf_file_and_back(
    tmp_path: Path, kind: str, place: str | None
) -> None:
    box = {"damping": (100.0, 101.0), "slope": (0.28, 0.281)}
    design = GRID if kind == "grid" else designs.saltelli(box, 128)
    told = run(plan(design, MEASURES), place and tmp_path / place, evaluate=arithmetic).load()
    told.to_netcdf(tmp_path / "scan.nc")
    back = xr.open_dataset(tmp_path / "scan.nc")
    for name in told.data_vars:
        np.testing.assert_array_equal(back[name], told[name], str(name))
    if kind == "saltelli":
        indices = vrw.sobol_indices(back, ["speed"])
        indices.to_netcdf(tmp_path / "indices.nc")


# Refusals, before anything is written


def test_a_misspelt_solver_is_refused_before_there_is_a_store(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="solver is 'Dopri9'"):
        vrw.scan(GRID, options=vrw.Options(solver="Dopri9"), store=tmp_path / "s.zarr")
    assert not list(tmp_path.iterdir())


def test_a_second_scan_at_work_on_the_same_store_is_refused(store: Path) -> None:
    (store / "speed" / CHUNK).unlink()
    with (
        soundness.alone(store),
        pytest.warns(UserWarning, match="damaged"),
        pytest.raises(ValueError, match="another scan is at work"),
    ):
        run(planned(), store, evaluate=arithmetic)
    with pytest.warns(UserWarning, match="damaged"):
        run(planned(), store, evaluate=arithmetic)


def test_of_two_scans_that_start_at_one_instant_one_makes_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both find nothing there, and both build; one is the first to put its own in place."""
    together, fill = threading.Barrier(2, timeout=60.0), scan_store._fill

    def filled(*arguments: object) -> None:
        fill(*arguments)
        together.wait()

    monkeypatch.setattr(scan_store, "_fill", filled)
    ends: list[object] = []

    def scan() -> None:
        try:
            ends.append(run(planned(), tmp_path / "s.zarr", evaluate=slowly))
        except Exception as error:
            ends.append(error)

    begun = threading.Event()

    def slowly(columns: dict[str, np.ndarray]) -> object:
        begun.wait(1.0)
        return arithmetic(columns)

    both = [threading.Thread(target=scan) for _ in range(2)]
    for one in both:
        one.start()
    for one in both:
        one.join()
    told = [end for end in ends if isinstance(end, Exception)]
    assert len(told) == 1
    assert "another scan is at work" in str(told[0])
    assert np.all(open_scan(tmp_path / "s.zarr").outcome.values != -1)
    assert [path.name for path in tmp_path.iterdir()] == ["s.zarr"]


def test_a_place_that_can_t_be_written_gets_one_sentence() -> None:
    with pytest.raises(OSError, match="no store can be made at /proc/x"):
        run(planned(), "/proc/x", evaluate=arithmetic)


def test_too_large_a_design_gets_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = np.linspace(100.0, 200.0, 100_000)
    with pytest.raises(ValueError, match="10,000,000,000 samples, but a scan takes"):
        plan(designs.grid(damping=wide, stiffness=wide))
    with pytest.raises(ValueError, match="a list takes 10,000,000 samples"):
        designs.sobol({"damping": (100.0, 200.0)}, 20_000_000_000)

    def full(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(scan_store.np, "full", full)
    with pytest.raises(ValueError, match="more than this memory holds: give a store"):
        run(planned(), evaluate=arithmetic)
