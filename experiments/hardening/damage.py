"""Damage stores, cached code, cached traces and configs, and write how the library ends.

Each row of the table is a kind of file and a fault. Its ending is one of these:

- "reported": the library names the damage, and returns no wrong number;
- "repaired": it names the damage, and computes or compiles bitwise the same again;
- "rejected": it rejects the file with one sentence;
- "harmless": the results are bitwise the same, or the config is read as written;

or a fault of the library: "silently wrong", "traceback", "crash". Each row runs in a process of
its own.

    python -m experiments.hardening.damage results
"""

import json
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.shared.command import make_parser
from experiments.shared.tables import write_table

ENDINGS = ("reported", "repaired", "rejected", "harmless")
"""Endings of rows without a fault of the library."""
MAX_ROW_SECONDS = 300
"""Longest time of a row, chosen because a row of a store may compile a scan."""

CONFIG = """\
[wheel]
damping = 150.0
n_legs = 8
[grid]
slope = [0.28, 0.3]
[scan]
measures = ["speed"]
"""
"""Valid config that the rows of the family "config" damage."""


class Kind(NamedTuple):
    """A kind of damaged file: the program that reads it and the pattern of its names."""

    family: str
    pattern: str


KINDS = {
    "chunk of outcome": Kind("store", "outcome/c/*/*"),
    "chunk of speed": Kind("store", "speed/c/*/*"),
    "mark of a chunk": Kind("store", "bookkeeping/digest/c/*/*"),
    "swept coordinate": Kind("store", "damping/c/*"),
    "other coordinate": Kind("store", "leg/c/*"),
    "metadata of an array": Kind("store", "speed/zarr.json"),
    "metadata of a coordinate": Kind("store", "damping/zarr.json"),
    "metadata of marks": Kind("store", "bookkeeping/zarr.json"),
    "metadata of the array of marks": Kind("store", "bookkeeping/digest/zarr.json"),
    "metadata of the store": Kind("store", "zarr.json"),
    "index of machine code": Kind("cache", "lanes_index_*"),
    "machine code": Kind("cache", "lanes_code_*"),
    "trace": Kind("cache", "vrw_trace_*"),
    "JAX's executable": Kind("cache", "*-cache"),
    "config": Kind("config", "*.toml"),
}
"""Kinds of files by the names in the table."""


def flip_bit(path: Path, others: list[Path]) -> None:
    """Change one bit in the middle of the file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def change_last_byte(path: Path, others: list[Path]) -> None:
    """Change the last byte."""
    content = bytearray(path.read_bytes())
    content[-1] ^= 255
    path.write_bytes(content)


def cut_in_half(path: Path, others: list[Path]) -> None:
    """Keep the first half of the file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def put_noise(path: Path, others: list[Path]) -> None:
    """Replace the content by as many random bytes."""
    noise = np.random.default_rng(0).bytes(path.stat().st_size)
    path.write_bytes(noise)


def rotate_contents(path: Path, others: list[Path]) -> None:
    """Give each file the content of the next file of its kind."""
    contents = [other.read_bytes() for other in others]
    for other, content in zip(others, contents[1:] + contents[:1], strict=True):
        other.write_bytes(content)


def put_folder(path: Path, others: list[Path]) -> None:
    """Replace the file by an empty folder."""
    path.unlink()
    path.mkdir()


def put_loop(path: Path, others: list[Path]) -> None:
    """Replace the file by a link to itself."""
    path.unlink()
    path.symlink_to(path.name)


def append_text(path: Path, others: list[Path]) -> None:
    """Append a line to the file."""
    path.write_bytes(path.read_bytes() + b"\nand more\n")


def let_others_write(path: Path, others: list[Path]) -> None:
    """Allow every user to write the file."""
    path.chmod(0o666)


FAULTS: dict[str, Callable[[Path, list[Path]], object]] = {
    "a bit flipped": flip_bit,
    "last byte changed": change_last_byte,
    "cut in half": cut_in_half,
    "empty": lambda path, others: path.write_bytes(b""),
    "deleted": lambda path, others: path.unlink(),
    "noise": put_noise,
    "another's content": rotate_contents,
    "a folder in its place": put_folder,
    "a link to itself": put_loop,
    "a line appended": append_text,
    "writable by others": let_others_write,
}
FOLDER_FAULTS = {
    ("folder of the cache", "writable by others"): 0o777,
    ("folder of the cache", "writable by its group"): 0o770,
}
"""File modes of the cache folder that some rows set."""
QUICK_ROWS = (
    ("chunk of speed", "a bit flipped"), ("chunk of speed", "another's content"),
    ("mark of a chunk", "deleted"), ("mark of a chunk", "noise"),
    ("metadata of an array", "cut in half"),
    ("metadata of the store", "noise"), ("other coordinate", "deleted"),
    ("index of machine code", "another's content"), ("machine code", "noise"),
    ("trace", "a folder in its place"), ("machine code", "writable by others"),
    ("folder of the cache", "writable by others"), ("config", "noise"), ("config", "cut in half"),
)  # fmt: skip
"""Rows that the tests run."""


def list_rows() -> list[tuple[str, str]]:
    """Return all rows, each a kind and a fault."""
    return [(kind, fault) for kind in KINDS for fault in FAULTS] + list(FOLDER_FAULTS)


# The functions below run in the process of one row.


def compute() -> list[list[float]]:
    """Return numbers of machine code, of a cached trace that calls it, and of a compiled JAX
    program."""
    import jax
    import jax.numpy as jnp

    from vrw_jax import lanes

    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    x, results = np.arange(4.0), []
    for factor in (2.0, 3.0):
        times = lanes.compile_batch_function(lambda y, f=factor: f * y)
        results.append(times.run(x))
        call = lambda y, g=times: jnp.sin(g(y))
        results.append(
            lanes.compile_exported_function(call, (jnp.asarray(x),), jax.devices()[0])(x)
        )
    return [np.asarray(values).tolist() for values in results]


def use_cache(cache: Path) -> list[list[float]]:
    """Start JAX with a cache folder, and return the numbers of `compute`."""
    import vrw_jax as vrw

    vrw.start_jax(cache)
    return compute()


def scan_into(store: Path) -> "object":
    """Scan four wheels into a store, or continue the scan of the store."""
    import vrw_jax as vrw

    design = vrw.grid(damping=[120.0, 150.0], slope=[0.29, 0.3])
    return vrw.scan(design, ["speed"], store=store, chunk=2).load()


def run_store_row(place: Path, store: Path, fault: str, pattern: str) -> str:
    """Open a damaged store, continue its scan, and return the ending."""
    import vrw_jax as vrw

    vrw.start_jax()
    intact = scan_into(store)
    apply_fault(store, pattern, fault)
    message = ""
    try:
        opened = vrw.open_scan(store).load()
        if not opened.identical(intact):
            return "silently wrong"
    except (ValueError, OSError) as error:
        message = check_sentence(error)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            continued = scan_into(store)
        except (ValueError, OSError) as error:
            check_sentence(error)
            return "rejected"
    if not continued.identical(intact) or not vrw.open_scan(store).load().identical(intact):
        return "silently wrong"
    is_reported = message or any("damaged" in str(warning.message) for warning in caught)
    return "repaired" if is_reported else "harmless"


def run_cache_row(place: Path, cache: Path, fault: str, pattern: str) -> str:
    """Return the ending of a process that uses a damaged cache."""
    expected = json.loads((place / "expected.json").read_text())
    if (pattern, fault) in FOLDER_FAULTS:
        cache.chmod(FOLDER_FAULTS[pattern, fault])
    else:
        apply_fault(cache, pattern, fault)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            results = use_cache(cache)
        except (ValueError, OSError) as error:
            check_sentence(error)
            return "rejected"
    if results != expected:
        return "silently wrong"
    is_reported = any("cache" in str(warning.message) for warning in caught)
    return "repaired" if is_reported else "harmless"


def run_config_row(place: Path, folder: Path, fault: str, pattern: str) -> str:
    """Return the ending of a damaged config: rejected, or read as written."""
    from vrw_jax.app.config import load_config

    (folder / "second.toml").write_text("[wheel]\ndamping = 120.0\n")
    (folder / "first.toml").write_text(CONFIG)
    apply_fault(folder, pattern, fault)
    try:
        load_config(folder / "first.toml")
    except (ValueError, OSError) as error:
        check_sentence(error)
        return "rejected"
    return "harmless"


def apply_fault(folder: Path, pattern: str, fault: str) -> None:
    """Apply a fault to the first file of a kind."""
    files = sorted(path for path in folder.glob(pattern) if path.is_file())
    FAULTS[fault](files[0], files)


def check_sentence(error: Exception) -> str:
    """Return the text of an error; raise another error if it is not one sentence."""
    text = str(error)
    if (not text.endswith(".") and not isinstance(error, OSError)) or "\n" in text:
        raise RuntimeError(f"no sentence: {text}") from error
    return text


PROGRAMS = {"store": run_store_row, "cache": run_cache_row, "config": run_config_row}


def run_row(kind: str, fault: str, prepared: Path) -> tuple[str, str]:
    """Run a row in a process of its own, and return its ending and the last line of an error."""
    family, pattern = KINDS.get(kind, Kind("cache", kind))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(prepared / family, folder / family)
        (folder / family).chmod(0o700)
        shutil.copy(prepared / "expected.json", folder)
        row = [sys.executable, "-m", __spec__.name, str(folder), "--row", family, pattern, fault]
        try:
            process = subprocess.run(row, capture_output=True, text=True, timeout=MAX_ROW_SECONDS)
        except subprocess.TimeoutExpired:
            return "crash", f"it ran for {MAX_ROW_SECONDS} s"
    last_line = process.stderr.strip().splitlines()[-1:]
    if process.returncode < 0:
        return "crash", f"signal {-process.returncode}"
    if process.returncode:
        return "traceback", "".join(last_line)
    return process.stdout.split("\n")[-2], ""


def prepare(folder: Path) -> None:
    """Compute an intact cache and the results with it, once for all rows."""
    for family in PROGRAMS:
        (folder / family).mkdir(mode=0o700)
    row = [sys.executable, "-m", __spec__.name, str(folder), "--row", "intact", "", ""]
    subprocess.run(row, check=True)


def run_rows(rows: Iterable[tuple[str, str]]) -> list[tuple[str, str, str, str]]:
    """Run each row in a process of its own, and return kind, fault, ending and error of each."""
    results = []
    with tempfile.TemporaryDirectory() as name:
        prepare(Path(name))
        for kind, fault in rows:
            ending = run_row(kind, fault, Path(name))
            results.append((kind, fault, *ending))
            print(*results[-1], sep=" | ", flush=True)
    return results


def main() -> None:
    """Run all rows, the rows that the tests select, or one row in this process."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("results"))
    parser.add_argument("--quick", action="store_true", help="run only the rows of the tests")
    parser.add_argument("--row", nargs=3, metavar=("FAMILY", "PATTERN", "FAULT"), help="one row")
    arguments = parser.parse_args()
    if arguments.row:
        family, pattern, fault = arguments.row
        if family == "intact":
            results = use_cache(arguments.folder / "cache")
            (arguments.folder / "expected.json").write_text(json.dumps(results))
            return
        damaged_folder = arguments.folder / family
        damaged_folder = damaged_folder / "scan.zarr" if family == "store" else damaged_folder
        print(PROGRAMS[family](arguments.folder, damaged_folder, fault, pattern))
        return
    rows = run_rows(QUICK_ROWS if arguments.quick else list_rows())
    write_table(arguments.folder / "damage.csv", ("kind", "fault", "ending", "error"), rows)
    sys.exit(any(ending not in ENDINGS for _, _, ending, _ in rows))


if __name__ == "__main__":
    main()
