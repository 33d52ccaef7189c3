"""Measure what the first answer of a new process costs, with an empty cache and with a filled one.

    python -m experiments.speed.first_answers           # all calls, and the table of the page
    python -m experiments.speed.first_answers gradient  # only calls whose name contains the word

Each call runs twice in new processes on one core, and the second process finds the compiled code of
the first. The times include the start of Python and the import, for which Python's bytecode exists
as after an installation by pip. The command writes
`docs/figures/first_answers.csv` and the table of `docs/benchmarks/compiling.md`. Run it on an idle
machine.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time

from experiments.shared.command import make_parser
from experiments.shared.tables import (
    DOCS,
    FIGURES,
    describe_run,
    format_markdown,
    replace_block,
    write_named_rows,
)
from experiments.shared.timing import use_one_core

CALLS = {
    "step": "vrw.step(params, start)",
    "gait of Table 1": "vrw.limit_cycle(params)",
    "gait that needs walks": (
        "vrw.limit_cycle(vrw.WheelParams(damping=120.0, stiffness=1800.0, slope=0.08))"
    ),
    "gradient of a gait": "jax.grad(lambda p: vrw.limit_cycle(p).dls_fraction)(params)",
    "gradient of a force peak": (
        "jax.grad(lambda p: vrw.limit_cycle(p).measure('peak_force'))(params)"
    ),
    "sensitivities of a gait": "vrw.sensitivities(params)",
    "Hessian of a gait": "jax.hessian(lambda p: vrw.limit_cycle(p).dls_fraction)(params)",
    "branch over damping": "vrw.continue_branch(params, 'damping', (150.0, 230.0))",
    "curve of a special point, with its branch": (
        "vrw.continue_branch(params, 'damping', (150.0, 230.0)); "
        "vrw.continue_special_point('lambda_4_plus', ('damping', 'slope'), vrw.limit_cycle(params))"
    ),
    "tuning of three parameters": (
        "vrw.tune(params, 'dls_fraction', free=('damping', 'stiffness', 'slope'), "
        "bounds={'damping': (100.0, 200.0), 'stiffness': (400.0, 600.0), 'slope': (0.25, 0.35)})"
    ),
    "gait with unilateral contact": "vrw.limit_cycle(params, model=vrw.UnilateralWheel())",
    "Jacobian of a step with unilateral contact": (
        "jax.jacfwd(lambda x: vrw.return_map(params, x, model=vrw.UnilateralWheel()))"
        "(jnp.asarray(vrw.UnilateralWheel().complete_section_state(params, jnp.asarray(start))))"
    ),
    "first passage": "vrw.first_passage(params, slope_sd=0.015)",
    "scan of 4,096 wheels": (
        "vrw.scan(vrw.grid(damping=list(np.linspace(22.0, 215.0, 64)), "
        "stiffness=list(np.linspace(400.0, 600.0, 64))), ['dls_fraction'])"
    ),
}
PREPARATION = """\
import jax, jax.numpy as jnp, numpy as np
import vrw_jax as vrw
vrw.start_jax()
params, start = vrw.WheelParams(), (0.1, 1.6, -0.1)
"""
OPTIONAL_IMPORTS = "import dask, optimistix, pandas, scipy.optimize, scipy.stats, xarray, zarr"
"""Packages that some calls import, whose bytecode exists after an installation."""


def measure_process(call: str, cache: str, bytecode: str) -> tuple[float, float]:
    """Return CPU time and wall time of a new process that computes a call, s.

    - `bytecode`: folder of Python's bytecode.
    """
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": cache,
        "VRW_PROGRESS": "0",
        "PYTHONPYCACHEPREFIX": bytecode,
        "PYTHONDONTWRITEBYTECODE": "",
    }
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-c", PREPARATION + call], env=environment, check=True)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("word", nargs="?", default="", help="part of the names of the calls")
    word = parser.parse_args().word
    rows = []
    bytecode = tempfile.TemporaryDirectory()
    measure_process(OPTIONAL_IMPORTS, bytecode.name, bytecode.name)
    for name, call in CALLS.items():
        if word not in name:
            continue
        with tempfile.TemporaryDirectory() as cache, use_one_core():
            (cold, cold_wall), (warm, warm_wall) = (
                measure_process(call, cache, bytecode.name) for _ in range(2)
            )
        rows.append(
            {
                "first answer": name,
                "empty cache, CPU s": f"{cold:.1f}",
                "wall, s": f"{cold_wall:.1f}",
                "filled cache, CPU s": f"{warm:.1f}",
                "filled, wall, s": f"{warm_wall:.1f}",
            }
        )
        print(*rows[-1].values(), flush=True)
    if word:
        return
    write_named_rows(FIGURES / "first_answers.csv", rows)
    shown = ("first answer", "empty cache, CPU s", "filled cache, CPU s")
    table = format_markdown(shown, [[row[name] for name in shown] for row in rows])
    source = describe_run("experiments.speed.first_answers")
    replace_block(DOCS / "benchmarks" / "compiling.md", "first answers", table, source)


if __name__ == "__main__":
    main()
