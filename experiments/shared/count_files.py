"""Count the files that one opens to follow four calls, for the architecture page.

    python -m experiments.shared.count_files [CALL]

A file counts if at least one of its functions runs. Files of `lanes`, which compiles, are listed
apart, because a reader stops at a public name of that package. Without CALL, each call runs in a
process of its own without a cache on disk, because a trace from a cache runs no functions.
"""

import cProfile
import itertools
import pstats
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser

LIBRARY_FOLDER = Path(vrw.__file__).parent
"""Folder of the package `vrw_jax`."""


def run_step() -> object:
    return vrw.step(vrw.WheelParams(), vrw.paper_start())


def run_limit_cycle() -> object:
    return vrw.limit_cycle(vrw.WheelParams())


def run_gradient() -> object:
    return jax.grad(lambda params: vrw.limit_cycle(params).dls_fraction)(vrw.WheelParams())


def run_contact_batch() -> object:
    params = vrw.WheelParams(damping=np.full(4, 150.0))
    starts = np.tile(vrw.paper_start(), (4, 1))
    return vrw.step_batch(params, starts, model=vrw.UnilateralWheel())


CALLS: dict[str, Callable[[], object]] = {
    "step": run_step,
    "limit_cycle": run_limit_cycle,
    "gradient": run_gradient,
    "contact_batch": run_contact_batch,
}


def list_files(call: Callable[[], object]) -> tuple[list[str], list[str]]:
    """Return the files of which a function runs in a call, by name.

    The second list contains the files of `lanes`.
    """
    profile = cProfile.Profile()
    profile.runcall(call)
    functions = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    paths = {Path(file) for file, _, function in functions if function != "<module>"}
    files = sorted(
        path.relative_to(LIBRARY_FOLDER).as_posix()
        for path in paths
        if path.is_relative_to(LIBRARY_FOLDER)
    )
    is_compiler = lambda file: file.startswith("lanes/")
    return list(itertools.filterfalse(is_compiler, files)), list(filter(is_compiler, files))


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("call", nargs="?", choices=CALLS, help="only this call, in this process")
    call_name = parser.parse_args().call
    if call_name:
        jax.config.update("jax_enable_x64", True)  # Without `start_jax` there is no cache on disk.
        if call_name == "gradient":
            run_limit_cycle()  # The gradient's count then holds only the files that it adds.
        files, lane_files = list_files(CALLS[call_name])
        print(f"{call_name}: {len(files)} files, and {len(lane_files)} of lanes")
        print("  " + "\n  ".join(files))
    else:
        for name in CALLS:
            command = [sys.executable, "-m", "experiments.shared.count_files", name]
            subprocess.run(command, check=True)
