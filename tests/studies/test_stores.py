"""A store returns what a scan wrote, and other programs can read it."""

import json
import shutil
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from support.scanning import (
    SCANNED_MEASURES,
    SMALL_GRID,
    CountingEngine,
    evaluate_arithmetically,
    make_plan,
    run_plan,
)
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax import open_scan
from vrw_jax.studies import plan_scan, scan_store
from vrw_jax.studies import scan_design as designs
from vrw_jax.studies import scan_execution as running
from vrw_jax.studies import scan_planning as planning


def list_files(complete_store: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(complete_store)): p.read_bytes()
        for p in complete_store.rglob("*")
        if p.is_file()
    }


@pytest.fixture(scope="module")
def written_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stores") / "s.zarr"
    run_plan(make_plan(), path, evaluate=evaluate_arithmetically)
    return path


@pytest.fixture
def complete_store(written_store: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_store, tmp_path / "s.zarr"))


# Damage

DAMAGE_CASES = {
    "another byte": lambda file: file.write_bytes(file.read_bytes()[:-1] + b"?"),
    "truncated": lambda file: file.write_bytes(file.read_bytes()[:5]),
    "empty": lambda file: file.write_bytes(b""),
    "deleted": lambda file: file.unlink(),
}
CHUNK_FILE = "c/1/0"
"""The file of the chunk of number 1: each holds one value of damping."""


@pytest.mark.parametrize("what", DAMAGE_CASES)
@pytest.mark.parametrize(
    "variable", ["locked_stopper_force", *mark_slow("outcome", "speed", "clearance_sls1")]
)
def test_a_damaged_chunk_is_computed_again_with_a_warning(
    complete_store: Path, what: str, variable: str
) -> None:
    files, n = list_files(complete_store), make_plan().result_layout.n_chunks
    file = complete_store / variable / (CHUNK_FILE + "/0" * (variable == "locked_stopper_force"))
    DAMAGE_CASES[what](file)
    with pytest.raises(ValueError, match=r"1 damaged chunk \(number 1\): run the scan again"):
        open_scan(complete_store)
    counting_engine = CountingEngine()
    with pytest.warns(UserWarning, match=r"1 damaged chunk \(number 1\): computed again"):
        run_plan(make_plan(), complete_store, evaluate=counting_engine)
    assert counting_engine.n_calls == 1 < n
    assert list_files(complete_store) == files


def test_a_running_scan_can_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a scan writes between two looks at its store is no damage."""
    path, read = tmp_path / "s.zarr", zarr.Array.__getitem__
    with pytest.raises(KeyboardInterrupt):
        run_plan(make_plan(), path, evaluate=CountingEngine(failing_call=3))

    def and_meanwhile(array: zarr.Array, where: object) -> object:
        result = read(array, where)
        if array.path == scan_store.CHECKSUM_ARRAY_NAME:
            with monkeypatch.context() as as_before:
                as_before.setattr(zarr.Array, "__getitem__", read)
                with pytest.raises(KeyboardInterrupt):
                    run_plan(make_plan(), path, evaluate=CountingEngine(failing_call=2))
        return result

    monkeypatch.setattr(zarr.Array, "__getitem__", and_meanwhile)
    open_scan(path)
    monkeypatch.undo()
    assert np.sum(open_scan(path).outcome.values[:, 0] != -1) > 2  # it did go on


def test_damage_in_an_unfinished_scan_is_found(tmp_path: Path) -> None:
    store = tmp_path / "s.zarr"
    run_plan(make_plan(), tmp_path / "whole.zarr", evaluate=evaluate_arithmetically)
    with pytest.raises(KeyboardInterrupt):
        run_plan(make_plan(), store, evaluate=CountingEngine(4))
    (store / "speed" / CHUNK_FILE).unlink()
    rest = CountingEngine()
    with pytest.warns(UserWarning, match="damaged"):
        run_plan(make_plan(), store, evaluate=rest)
    assert rest.n_calls == make_plan().result_layout.n_chunks - 3 + 1
    assert list_files(store) == list_files(tmp_path / "whole.zarr")


def test_damaged_coordinates_are_written_again(complete_store: Path) -> None:
    files = list_files(complete_store)
    (complete_store / "damping" / "c" / "0").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="damaged coordinates"):
        open_scan(complete_store)
    counting_engine = CountingEngine()
    with pytest.warns(UserWarning, match="damaged coordinates"):
        run_plan(make_plan(), complete_store, evaluate=counting_engine)
    assert counting_engine.n_calls == 0
    assert list_files(complete_store) == files


def test_intact_parts_of_a_damaged_store_can_be_read(complete_store: Path) -> None:
    (complete_store / "speed" / CHUNK_FILE).unlink()
    intact_scan = open_scan(complete_store, verify=False)
    assert np.isnan(intact_scan.speed.values[1]).all()
    assert np.isfinite(intact_scan.speed.values[0]).all()


def test_a_damaged_chunk_is_not_recomputed_by_other_code(
    complete_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (complete_store / "speed" / CHUNK_FILE).unlink()
    monkeypatch.setattr(planning, "compute_source_digest", lambda: "other")
    with pytest.raises(ValueError, match=r"lacks 1 of 5 chunks \(1 of them damaged\)"):
        run_plan(make_plan(), complete_store, evaluate=evaluate_arithmetically)


# Reading


def test_xarray_opens_a_store_without_a_warning_and_sees_no_bookkeeping(
    complete_store: Path,
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened_scan = xr.open_zarr(complete_store)
    assert list(opened_scan.data_vars)[:4] == [
        *SCANNED_MEASURES[:2],
        "d_dls_fraction_d_damping",
        "outcome",
    ]
    assert set(opened_scan.sizes) == {"damping", "slope", "leg"}


@pytest.mark.parametrize("place", [None, "s.zarr"])
def test_variables_have_the_requested_order_and_names(tmp_path: Path, place: str | None) -> None:
    requested = ("speed", "d dls_fraction / d damping", "outcome", "dls_fraction")
    scan_result = run_plan(
        plan_scan(SMALL_GRID, requested),
        place and tmp_path / place,
        evaluate=evaluate_arithmetically,
    )
    assert tuple(scan_result.data_vars)[:4] == requested
    assert scan_result["d dls_fraction / d damping"].attrs["units"]
    underscored = run_plan(
        plan_scan(SMALL_GRID, ["d_dls_fraction_d_damping"]), evaluate=evaluate_arithmetically
    )
    assert next(iter(underscored.data_vars)) == "d_dls_fraction_d_damping"


@pytest.mark.parametrize("place", [None, "s.zarr"])
@pytest.mark.parametrize("kind", ["grid", "saltelli"])
def test_a_scan_goes_into_a_netcdf_file_and_back(
    tmp_path: Path, kind: str, place: str | None
) -> None:
    box = {"damping": (100.0, 101.0), "slope": (0.28, 0.281)}
    design = SMALL_GRID if kind == "grid" else designs.saltelli(box, 128)
    result = run_plan(
        plan_scan(design, SCANNED_MEASURES),
        place and tmp_path / place,
        evaluate=evaluate_arithmetically,
    ).load()
    result.to_netcdf(tmp_path / "scan.nc")
    back = xr.open_dataset(tmp_path / "scan.nc")
    for name in result.data_vars:
        np.testing.assert_array_equal(back[name], result[name], str(name))
    if kind == "saltelli":
        indices = vrw.sobol_indices(back, ["speed"])
        indices.to_netcdf(tmp_path / "indices.nc")


# Refusals, before anything is written


def test_a_misspelled_solver_is_refused_before_a_store_is_created(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="solver is 'Dopri9'"):
        vrw.scan(SMALL_GRID, options=vrw.StepOptions(solver="Dopri9"), store=tmp_path / "s.zarr")
    assert not list(tmp_path.iterdir())


def test_a_second_scan_on_the_same_store_is_refused(complete_store: Path) -> None:
    (complete_store / "speed" / CHUNK_FILE).unlink()
    with (
        scan_store.lock_store(complete_store),
        pytest.warns(UserWarning, match="damaged"),
        pytest.raises(ValueError, match="another scan is at work"),
    ):
        run_plan(make_plan(), complete_store, evaluate=evaluate_arithmetically)
    with pytest.warns(UserWarning, match="damaged"):
        run_plan(make_plan(), complete_store, evaluate=evaluate_arithmetically)


def test_of_two_simultaneous_scans_one_creates_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both find nothing there, and both build; one is the first to put its own in place."""
    joint_result, fill = threading.Barrier(2, timeout=60.0), scan_store._create_zarr_arrays

    def filled(*arguments: object) -> None:
        fill(*arguments)
        joint_result.wait()

    monkeypatch.setattr(scan_store, "_create_zarr_arrays", filled)
    ends: list[object] = []

    def scan() -> None:
        try:
            ends.append(run_plan(make_plan(), tmp_path / "s.zarr", evaluate=slowly))
        except Exception as error:
            ends.append(error)

    start_result = threading.Event()

    def slowly(columns: dict[str, np.ndarray]) -> object:
        start_result.wait(1.0)
        return evaluate_arithmetically(columns)

    threads = [threading.Thread(target=scan) for _ in range(2)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    rows = [end for end in ends if isinstance(end, Exception)]
    assert len(rows) == 1
    assert "another scan is at work" in str(rows[0])
    assert np.all(open_scan(tmp_path / "s.zarr").outcome.values != -1)
    assert [path.name for path in tmp_path.iterdir()] == ["s.zarr"]


def test_a_folder_in_place_of_a_file_is_named(complete_store: Path) -> None:
    file = complete_store / "speed" / CHUNK_FILE
    file.unlink()
    file.mkdir()
    with (
        pytest.warns(UserWarning, match="1 damaged chunk"),
        pytest.raises(ValueError, match=r"speed/c/1/0 is a folder, but .*: remove the folder"),
    ):
        run_plan(make_plan(), complete_store, evaluate=evaluate_arithmetically)


def test_an_unwritable_folder_is_refused_in_one_sentence() -> None:
    with pytest.raises(ValueError, match="no store can be made at /proc/x"):
        run_plan(make_plan(), "/proc/x", evaluate=evaluate_arithmetically)


@pytest.mark.parametrize("name", ["scan", "provenance"])
def test_a_store_whose_settings_are_no_table_is_damaged(tmp_path: Path, name: str) -> None:
    plan = make_plan()
    attributes = plan.store_attributes | {name: "null"}
    scan_store.create_empty_store(tmp_path / "s.zarr", plan.result_layout, attributes)
    with pytest.raises(ValueError, match="has damaged attributes"):
        run_plan(plan, tmp_path / "s.zarr", evaluate=evaluate_arithmetically)


def test_too_large_a_design_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = np.linspace(100.0, 200.0, 100_000)
    with pytest.raises(ValueError, match="10,000,000,000 samples, but a scan takes"):
        plan_scan(designs.grid(damping=wide, stiffness=wide))
    half = np.linspace(0.1, 0.2, 2**16)
    with pytest.raises(ValueError, match="18,446,744,073,709,551,616 samples, but a scan takes"):
        plan_scan(designs.grid(damping=half, stiffness=half, slope=half, leg_mass=half))
    with pytest.raises(ValueError, match="a list takes 10,000,000 samples"):
        designs.sobol({"damping": (100.0, 200.0)}, 20_000_000_000)

    def copy(*_: object, deep: bool) -> None:
        raise MemoryError

    monkeypatch.setattr(xr.Variable, "copy", copy)
    with pytest.raises(ValueError, match="more than this memory holds: give a store"):
        run_plan(make_plan(), evaluate=evaluate_arithmetically)


# Position, design, foreign variables, metadata


def test_chunks_in_each_others_place_are_seen_though_their_marks_went_along(
    complete_store: Path,
) -> None:
    """Reference: the store as written. Each chunk's files agree with the mark beside them."""
    whole = list_files(complete_store)
    for array in complete_store.iterdir():
        first, second = (array / "c" / number for number in ("1", "3"))
        if array.name == "bookkeeping":
            first, second = (array / "digest" / "c" / number for number in ("1", "3"))
        if array.is_dir() and first.exists():
            first.rename(array / "aside")
            second.rename(first)
            (array / "aside").rename(second)
    with pytest.raises(ValueError, match=r"2 damaged chunks \(number 1, 3\)"):
        open_scan(complete_store)
    with pytest.warns(UserWarning, match="2 damaged chunks"):
        run_plan(make_plan(), complete_store, evaluate=evaluate_arithmetically)
    assert list_files(complete_store) == whole


def test_a_chunk_of_another_design_is_seen_though_its_mark_came_along(
    complete_store: Path, tmp_path: Path
) -> None:
    other = designs.grid(damping=np.linspace(100.0, 200.0, 5), slope=np.linspace(0.28, 0.32, 4))
    run_plan(
        plan_scan(other, SCANNED_MEASURES, chunk=4),
        tmp_path / "other.zarr",
        evaluate=evaluate_arithmetically,
    )
    for path in (tmp_path / "other.zarr").rglob("c/1"):
        if path.is_dir():  # the files of a chunk, not a coordinate
            place = complete_store / path.relative_to(tmp_path / "other.zarr")
            shutil.copytree(path, place, dirs_exist_ok=True)
    with pytest.raises(ValueError, match=r"1 damaged chunk \(number 1\)"):
        open_scan(complete_store)


@pytest.mark.parametrize("keeps", [True, False], ids=["attributes kept", "attributes lost"])
def test_a_variable_that_a_user_adds_is_no_damage(complete_store: Path, keeps: bool) -> None:
    before = open_scan(complete_store).load()
    mine = xr.Dataset({"mine": 2.0 * before.speed}, attrs=before.attrs if keeps else {})
    mine.to_zarr(complete_store, mode="a")
    after = open_scan(complete_store).load()
    xr.testing.assert_identical(after.drop_vars("mine")[list(before.data_vars)], before)
    np.testing.assert_array_equal(after.mine, mine.mine)
    again = CountingEngine()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run_plan(make_plan(), complete_store, evaluate=again)
    assert again.n_calls == 0


METADATA = {
    "not JSON": lambda text: text[: len(text) // 2],
    "empty": lambda text: "",
    "another kind of number": lambda text: text.replace("float64", "int64").replace(
        "int8", "int16"
    ),
    "other chunks": lambda text: text.replace('"chunk_shape": [', '"chunk_shape": [7'),
    "not an object": lambda text: "[]",
    "deleted": lambda text: None,
}


@pytest.mark.parametrize("what", METADATA)
@pytest.mark.parametrize("name", ["speed", "bookkeeping/digest", *mark_slow("outcome", "damping")])
def test_damaged_metadata_of_an_array_are_said_and_mended(
    complete_store: Path, name: str, what: str
) -> None:
    whole, place = list_files(complete_store), complete_store / name / "zarr.json"
    text = METADATA[what](place.read_text())
    if text == place.read_text():
        text += "]"
    place.write_text(text) if text is not None else place.unlink()
    with pytest.raises(ValueError, match=rf"damaged metadata \({name}\)|can't be opened \({name}"):
        open_scan(complete_store)
    assert (
        f"damaged metadata ({name})"
        in running.find_matching_store(make_plan(), complete_store).damage_description
    )
    again = CountingEngine()
    with pytest.warns(UserWarning, match="damaged metadata"):
        run_plan(make_plan(), complete_store, evaluate=again)
    assert again.n_calls == 0
    assert list_files(complete_store) == whole


def edited_root(store: Path, edit: object) -> None:
    root = json.loads((store / "zarr.json").read_text())
    edit(root)
    (store / "zarr.json").write_text(json.dumps(root, indent=2))


ROOT = {
    "kind of number": lambda r: inline(r, "speed").update(data_type="int8"),
    "an array's gone": lambda r: r["consolidated_metadata"]["metadata"].pop("speed"),
    "nonsense": lambda r: r["consolidated_metadata"]["metadata"].update(speed=3),
    "the settings": lambda r: r["attributes"].update(scan="{}"),
    "no settings": lambda r: r["attributes"].pop("scan"),
    "the list of variables": lambda r: inline(r, "bookkeeping")["attributes"].update(variables=[]),
}


def inline(root: dict, name: str) -> dict:
    return root["consolidated_metadata"]["metadata"][name]


@pytest.mark.parametrize("what", ROOT)
def test_damage_of_the_metadata_of_all_is_said_and_mended_or_harmless(
    complete_store: Path, what: str
) -> None:
    whole, before = list_files(complete_store), open_scan(complete_store).load()
    edited_root(complete_store, ROOT[what])
    if what == "no settings":
        xr.testing.assert_identical(open_scan(complete_store).load(), before)
        return
    with pytest.raises(ValueError, match=r"damaged metadata|can't be opened"):
        open_scan(complete_store)
    again = CountingEngine()
    with pytest.warns(UserWarning, match="damaged metadata"):
        run_plan(make_plan(), complete_store, evaluate=again)
    assert again.n_calls == 0
    assert list_files(complete_store) == whole


def test_a_damaged_coordinate_that_is_not_swept_is_written_again(complete_store: Path) -> None:
    whole = list_files(complete_store)
    (complete_store / "leg" / "c" / "0").unlink()
    with pytest.raises(ValueError, match=r"damaged coordinates \(leg\)"):
        open_scan(complete_store)
    with pytest.warns(UserWarning, match="damaged coordinates"):
        run_plan(make_plan(), complete_store, evaluate=CountingEngine(1))
    assert list_files(complete_store) == whole


def test_a_store_without_a_list_of_its_variables_is_refused_and_unchanged(
    complete_store: Path,
) -> None:
    edited_root(complete_store, lambda root: inline(root, "bookkeeping").update(attributes={}))
    book = complete_store / "bookkeeping" / "zarr.json"
    book.write_text(json.dumps(json.loads(book.read_text()) | {"attributes": {}}, indent=2))
    before = list_files(complete_store)
    sentence = "has no list of its variables.* run the scan into a new folder"
    with pytest.raises(ValueError, match=sentence):
        open_scan(complete_store)
    with pytest.raises(ValueError, match=sentence):
        run_plan(make_plan(), complete_store, evaluate=evaluate_arithmetically)
    assert list_files(complete_store) == before
