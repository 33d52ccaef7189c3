"""Damaged files are reported, repaired, rejected or harmless; those of others execute nothing."""

import csv
import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.scanning import evaluate_arithmetically, make_plan, run_plan

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def rows(tmp_path_factory) -> dict[tuple[str, str], str]:
    folder = tmp_path_factory.mktemp("damage")
    command = [sys.executable, "-m", "experiments.hardening.damage", folder, "--quick"]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    with (folder / "damage.csv").open() as file:
        found = {(row["kind"], row["fault"]): row["ending"] for row in csv.DictReader(file)}
    assert process.returncode == 0, process.stdout + process.stderr[-1000:]
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "fault", "endings"),
    [
        ("chunk of speed", "a bit flipped", {"repaired"}),
        ("chunk of speed", "another's content", {"repaired"}),
        ("mark of a chunk", "deleted", {"harmless", "repaired"}),
        ("metadata of an array", "cut in half", {"repaired"}),
        ("metadata of the store", "noise", {"rejected"}),
        ("other coordinate", "deleted", {"repaired"}),
        ("index of machine code", "another's content", {"repaired"}),
        ("machine code", "noise", {"repaired"}),
        ("trace", "a folder in its place", {"repaired"}),
        ("machine code", "writable by others", {"repaired"}),
        ("folder of the cache", "writable by others", {"rejected"}),
        ("config", "noise", {"rejected"}),
        ("config", "cut in half", {"rejected"}),
    ],
)
def test_damage_ends_as_it_should(rows, kind, fault, endings):
    assert rows[kind, fault] in endings


class Canary:
    """A pickle that creates a file when it is loaded."""

    def __init__(self, place):
        self.place = place

    def __reduce__(self):
        return Path.touch, (self.place,)


OPEN_PROGRAM = """
import sys, warnings
import vrw_jax as vrw
from vrw_jax.app.config import load_config
warnings.simplefilter("ignore")
intact, config, log, *hostile_stores = sys.argv[1:]
vrw.open_scan(intact).load()  # imports what opening needs
EXECUTING = ("pickle.find_class", "os.system", "os.exec", "os.posix_spawn", "os.fork",
             "subprocess.Popen", "ctypes.dlopen", "os.startfile", "code.__new__")
events, is_watching = [], True
def record(event, _):
    if is_watching and event in EXECUTING:
        events.append(event)
sys.addaudithook(record)
def try_to_open(open_file, path, **choices):
    try:
        open_file(path, **choices)
    except (ValueError, OSError):
        pass
load_store = lambda path, **choices: vrw.open_scan(path, **choices).load()
try_to_open(load_config, config)
for hostile_store in hostile_stores:
    try_to_open(load_store, hostile_store)
    try_to_open(load_store, hostile_store, verify=False)
is_watching = False
open(log, "w").write(repr(events))
"""
"""Opens hostile stores and a config, and logs the audit events that could execute code."""


def edit_json(path: Path, edit) -> None:
    metadata = json.loads(path.read_text())
    edit(metadata)
    path.write_text(json.dumps(metadata))


def put_pickles_as_chunks(store: Path, payload: bytes) -> None:
    for chunk in store.rglob("c/*/*"):
        if chunk.is_file():
            chunk.write_bytes(payload)


def name_a_pickle_codec(store: Path, payload: bytes) -> None:
    codec = {"name": "numcodecs.pickle", "configuration": {"id": "pickle"}}
    put_pickles_as_chunks(store, payload)
    edit_json(store / "speed" / "zarr.json", lambda x: x.update(codecs=[codec]))
    edit_json(
        store / "zarr.json",
        lambda x: x["consolidated_metadata"]["metadata"]["speed"].update(codecs=[codec]),
    )


def put_code_in_attributes(store: Path, payload: bytes) -> None:
    text = f"__import__('pathlib').Path({str(store / 'canary')!r}).touch()"
    edit_json(
        store / "zarr.json",
        lambda x: x["attributes"].update(scan=text, config=text, asked=text, coordinates=text),
    )


def store_objects(store: Path, payload: bytes) -> None:
    kind = {"name": "numpy.object", "configuration": {"object_codec": "pickle"}}
    put_pickles_as_chunks(store, payload)
    for place in (store / "speed" / "zarr.json",):
        edit_json(place, lambda x: x.update(data_type=kind))
    edit_json(
        store / "zarr.json",
        lambda x: x["consolidated_metadata"]["metadata"]["speed"].update(data_type=kind),
    )


def add_an_array_of_zarr_2(store: Path, payload: bytes) -> None:
    """Add an array of Zarr format 2, whose filters may be pickles."""
    place = store / "mine"
    place.mkdir()
    array = {
        "zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "fill_value": None,
        "order": "C", "compressor": None, "filters": [{"id": "pickle", "protocol": 5}],
    }  # fmt: skip
    (place / ".zarray").write_text(json.dumps(array))
    (place / "0").write_bytes(payload)


HOSTILE_DAMAGES = (
    put_pickles_as_chunks, name_a_pickle_codec, put_code_in_attributes, store_objects,
    add_an_array_of_zarr_2,
)  # fmt: skip


def test_a_hostile_store_or_config_executes_nothing(tmp_path: Path) -> None:
    """By Python's audit events while they are opened, and by a file that code would make."""
    intact, canary = tmp_path / "intact.zarr", tmp_path / "canary"
    run_plan(make_plan(), intact, evaluate=evaluate_arithmetically)
    hostile_stores = [tmp_path / f"{damage.__name__}.zarr" for damage in HOSTILE_DAMAGES]
    for damage, store in zip(HOSTILE_DAMAGES, hostile_stores, strict=True):
        shutil.copytree(intact, store)
        damage(store, pickle.dumps(Canary(canary)))
    config, log = tmp_path / "hostile.toml", tmp_path / "log"
    config.write_text(
        "[model]\nname = \"__import__('os').system('touch canary')\"\n"
        '[options]\nsolver = "!!python/object/apply:os.system [touch canary]"\n'
    )
    process = subprocess.run(
        [sys.executable, "-c", OPEN_PROGRAM, *map(str, (intact, config, log, *hostile_stores))],
        cwd=tmp_path, env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr[-2000:]
    assert log.read_text() == "[]"
    assert not list(tmp_path.rglob("canary"))
