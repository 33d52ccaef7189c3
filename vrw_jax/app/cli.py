"""The command line: walk a wheel, reproduce the paper, scan parameters.

Slow imports are made inside commands, so that help appears at once. A user's mistake is reported in
one sentence on stderr, with exit code 2.
"""

import gc
import importlib.metadata
import os
import signal
import tempfile
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vrw_jax.app import printing, scanning
from vrw_jax.app.printing import INTERRUPTED, complain, err, out, sentences

if TYPE_CHECKING:
    from vrw_jax.app.config import Config

FACT_FAILED, NOT_CONVERGED = 1, 1
"""Exit codes of a failed fact and of a run that did not converge."""

Folder = Annotated[
    Path | None,
    typer.Option("--out", help="Folder for the result; results/NAME of the config by default."),
]
Picture = Annotated[bool, typer.Option(help="Draw the result.")]
"""Options that several commands share."""

app = typer.Typer(
    name="vrw",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command line."""
    # Traces consist of many small, long-lived objects. With Python's default thresholds the garbage
    # collector takes a tenth of a cold start.
    gc.set_threshold(200_000, 20, 20)
    signal.signal(signal.SIGINT, _stop)
    app()


def _stop(_signal: int, _frame: object) -> None:
    """Handle the first Ctrl-C: end the command in order, and let a second one end it at once."""
    signal.signal(signal.SIGINT, _stop_at_once)
    raise KeyboardInterrupt


def _stop_at_once(_signal: int, _frame: object) -> None:
    """Handle the second Ctrl-C: end the process at once."""
    os.write(2, b"vrw: stopped at once; run the same to go on.\n")
    os._exit(INTERRUPTED)


def _version(wanted: bool) -> None:
    """Print the version and exit, if wanted."""
    if wanted:
        try:
            number = importlib.metadata.version("vrw-jax")
        except importlib.metadata.PackageNotFoundError:
            number = "(not installed)"
        print(f"vrw {number}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """The passive viscoelastic-legged rimless wheel: walk it, reproduce the paper, scan it.

    [bold]Examples[/bold]

      [cyan]vrw init[/cyan]                              the example configs named here

      [cyan]vrw gait[/cyan]                              the wheel of Table 1 on the paper's slope

      [cyan]vrw gait --set damping=150[/cyan]            the same with softer dampers

      [cyan]vrw reproduce --out paper[/cyan]             all figures and the table of facts

      [cyan]vrw scan configs/quickstart.toml[/cyan]      4,096 steady gaits, a dataset and a picture

      [cyan]vrw tune configs/tune_dls.toml[/cyan]        the most double support without scuffing

      [cyan]vrw continue configs/branch_damping.toml[/cyan]   a branch of gaits and its borders

    [bold]What is written[/bold]   init: configs. gait: nothing. reproduce: figures and tables into
    its folder. scan: scan.zarr (open it with vrw_jax.open_scan or xarray.open_zarr) and pictures,
    PNG and SVG. tune: path.zarr, a picture, summary.md, and wheel.toml, which vrw gait walks.
    continue: branch.zarr, borders.csv, a picture and summary.md.

    The first run of a command compiles for a while; the code is kept in a cache folder of yours
    (JAX_COMPILATION_CACHE_DIR names another), and later runs start quickly. Angles are in rad, all
    else in SI units.
    """


@app.command()
def gait(
    config: Annotated[
        Path | None, typer.Argument(help="TOML file; without one the wheel of Table 1.")
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Change a parameter; may be repeated."),
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps to walk.")] = None,
) -> None:
    """Walk a wheel and print its gait: durations, speed, indicators and margins.

    Walks step by step from a start near the gait of Table 1, or from the start in the config. Then
    finds the limit cycle near the last step. With unilateral contact and no start in the config,
    finds the slowest attracting gait instead. Writes no file.

    [bold]Examples[/bold]

      vrw gait --set damping=150 --set slope=0.28

      vrw gait configs/table1.toml --steps 50
    """
    with sentences():
        settings = _settings(config)
        from vrw_jax.app.config import assignment

        params = settings.params(dict(assignment(text) for text in changes or []))
        import jax.numpy as jnp

        from vrw_jax.cycles import finder_of, serving_and_why
        from vrw_jax.gaits import limit_cycle
        from vrw_jax.walks import step
        from vrw_jax.wheel import Outcome

        model: Any = settings.wheel_model()
        options = settings.numerical_options()
        start = settings.gait.start
        state = model.start(params) if start is None else jnp.asarray(start)
        state = model.full_section(params, state)
        walked, n_steps = 0, steps or settings.gait.steps
        with err.status("walking (the first time compiles for a while)"):
            while True:
                result: Any = step(params, state, model=model, options=options)
                stepped = int(result.outcome) == Outcome.STEPPED
                walked += stepped
                if not stepped or walked == n_steps:
                    break
                state = result.section_state
            model, why = serving_and_why(params, model)
            cold = start is None or finder_of(model, params.n_legs).from_nothing
            cycle: Any = limit_cycle(params, guess=None if cold else state, model=model)
        printing.tell_gait(params, result, state, walked, cycle)
        if why:
            out.print(why)


@app.command()
def explore(
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Begin there; may be repeated."),
    ] = None,
    rung: Annotated[str, typer.Option(help="viscoelastic, rigid or unilateral.")] = "viscoelastic",
) -> None:
    """Open an interactive page of the wheel in your browser; the page computes by itself."""
    with sentences():
        from vrw_jax.app.config import assignment
        from vrw_jax.web import page_address

        params = _settings(None).params(dict(assignment(t) for t in changes or []))
        address = page_address(params, rung)
        webbrowser.open(address)
        print(address)


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(help="Where to write them.")] = Path("configs"),
) -> None:
    """Write the example configs as a start for your own.

    Existing files are kept. If an existing file differs, the command names it and writes nothing.
    """
    with sentences():
        source = _examples()
        texts = {path.name: path.read_text(encoding="utf-8") for path in source.glob("*.toml")}
        there = [folder / name for name in sorted(texts) if (folder / name).exists()]
        for path in there:
            if path.read_text(encoding="utf-8", errors="replace") != texts[path.name]:
                raise ValueError(f"{path} is there already and differs: give another folder.")
        _require_place(folder)
        folder.mkdir(parents=True, exist_ok=True)
        new = [folder / name for name in sorted(texts) if folder / name not in there]
        for path in new:
            path.write_text(texts[path.name], encoding="utf-8")
        printing.tell_written(new)
        if not new:
            out.print(f"{folder} has them all: nothing to write.", highlight=False)


def _examples() -> Path:
    """Return the folder of the example configs, inside an installed package or beside it."""
    package = Path(__file__).parents[1]
    return next(p for p in (package / "configs", package.parent / "configs") if p.is_dir())


def _require_place(folder: Path) -> None:
    """Raise if the folder cannot be written to, without creating it."""
    there = folder
    while not there.exists():
        there = there.parent
    try:
        with tempfile.TemporaryDirectory(dir=there):
            pass
    except OSError as error:
        raise ValueError(
            f"nothing can be written to {folder} ({error.strerror}): give a place of your own."
        ) from error


@app.command()
def reproduce(
    folder: Annotated[
        Path, typer.Option("--out", help="Folder for the figures and the table.")
    ] = Path("results/reproduction"),
) -> None:
    """Reproduce the paper: figures 6 to 10, and every published fact with the computed value.

    Prints the table of facts and writes it with the figures, including tolerances and their
    reasons. The exit code is 1 if a fact does not hold.
    """
    from vrw_jax.runtime import start_jax

    with sentences():
        start_jax()
        _require_place(folder)
    from vrw_jax.paper import reproduce as run

    with (
        sentences(f"stopped; what is done stays in {folder}."),
        printing.progress_bar("reproducing the paper") as bar,
    ):
        task = bar.add_task("starting", total=1.0)
        facts = run(
            folder, progress=lambda share, what: bar.update(task, completed=share, description=what)
        )
    printing.tell_facts(facts, folder)
    if not all(fact.holds for fact in facts):
        raise typer.Exit(FACT_FAILED)


@app.command()
def scan(
    config: Annotated[Path, typer.Argument(help="TOML file with the samples and measures.")],
    folder: Folder = None,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain", help="Only print sizes, and memory and time measured on some samples."
        ),
    ] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Only print whether the store is complete and intact.")
    ] = False,
    chunk: Annotated[
        int | None, typer.Option(min=1, help="Largest number of samples written at a time.")
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute on the dask cluster at this address; 'local' starts one here.",
        ),
    ] = None,
    picture: Picture = True,
) -> None:
    """Find the steady gait of every sample of a design, with its outcome and margins.

    Writes scan.zarr and figures (PNG and SVG) into the folder. After an interruption the same
    command continues where it stopped, and ends with bitwise the same data. Of a finished scan only
    chunks with damaged files are computed again. The exit code is 1 if --verify finds damage.

    [bold]Examples[/bold]

      vrw scan configs/quickstart.toml --explain

      vrw scan configs/quickstart.toml --out results/first

      vrw scan configs/quickstart.toml --dask tcp://host:8786
    """
    with sentences():
        settings, folder = _asked(config, folder, "design")
        planned, store = scanning.planned_scan(settings, chunk), folder / "scan.zarr"
        from vrw_jax.scans import explained

        if explain:
            with err.status("measuring some samples (the first time compiles for a while)"):
                told = explained(planned, store) | {"store": str(store)}
            printing.tell_table("What this scan would do", told.items())
            return
        if verify:
            scanning.verify_store(planned, store)
            return
        _require_place(folder)
    dataset = scanning.compute_scan(planned, store, dask)
    printing.tell_outcomes(dataset)
    out.print(f"data: {store}", highlight=False, soft_wrap=True)
    if picture:
        from vrw_jax.app.reports import write_scan

        printing.tell_written(write_scan(dataset, folder))


@app.command("map")
def map_borders(
    config: Annotated[Path, typer.Argument(help="TOML file with a grid over two parameters.")],
    folder: Folder = None,
) -> None:
    """Draw all special points of gaits over two parameters: `vrw map configs/map_c_k.toml`."""
    with sentences():
        settings, folder = _asked(config, folder, "design", "map")
        from vrw_jax.app.reports import require_map, write_map
        from vrw_jax.branches import SCANNED

        planned = scanning.planned_scan(settings, None, SCANNED)
        require_map(planned.design)
        _require_place(folder)
    dataset = scanning.compute_scan(planned, folder / "scan.zarr", None)

    with sentences(), err.status("following borders (the first time compiles for minutes)"):
        printing.tell_written(write_map(dataset, settings, folder))


@app.command()
def tune(
    config: Annotated[Path, typer.Argument(help="TOML file with objective, bounds, constraints.")],
    folder: Folder = None,
    picture: Picture = True,
) -> None:
    """Tune a wheel: find the best gait within bounds that satisfies its constraints.

    Optimizes along the branch of gaits with exact gradients, then walks the tuned wheel. Writes
    path.zarr (every gait evaluated), summary.md, wheel.toml (the tuned wheel) and figures (PNG and
    SVG) into the folder. The exit code is 1 if the run does not end at an optimum. It is 2, and
    nothing is written, if the start has no gait.

    [bold]Examples[/bold]

      vrw tune configs/tune_dls.toml

      vrw tune configs/tune_stability.toml --out results/steady

      vrw gait results/steady/wheel.toml
    """
    with sentences():
        settings, folder = _asked(config, folder, "tune")
        sought = settings.tune
        assert sought is not None
        _require_place(folder)
        from vrw_jax.app.reports import write_tuned
        from vrw_jax.tuning import tune as run

        with err.status("tuning (the first time compiles for a while)"):
            tuned = run(
                settings.params(),
                sought.objective,
                tuple(sought.bounds),
                sought.bounds,
                sought.constraints,
                model=settings.wheel_model(),
                options=settings.numerical_options(),
                max_evaluations=sought.evaluations,
            )
        printing.tell_table("Tuned gait", tuned.lines().items())
        printing.tell_written(write_tuned(tuned, folder, picture))
    if not tuned.converged:
        complain(f"this is no optimum ({tuned.ending.name}): what was reached is written.")
        raise typer.Exit(NOT_CONVERGED)


@app.command("continue")
def continue_(
    config: Annotated[Path, typer.Argument(help=r"TOML file with a table \[branch].")],
    folder: Folder = None,
    picture: Picture = True,
) -> None:
    """Continue a branch of stable and unstable gaits along a parameter, with its special points.

    Writes branch.zarr (open it with xarray.open_zarr), borders.csv, summary.md and figures (PNG and
    SVG) into the folder. The exit code is 1, and nothing is written, if there is no gait to start
    from.

    [bold]Examples[/bold]

      vrw continue configs/branch_damping.toml

      vrw continue configs/branch_damping.toml --out results/along_c --no-picture
    """
    with sentences():
        settings, folder = _asked(config, folder, "branch")
        asked = settings.branch
        assert asked is not None
        _require_place(folder)
        from vrw_jax.app.reports import write_branch
        from vrw_jax.branches import continue_branch
        from vrw_jax.numerics import ArclengthOptions

        options = ArclengthOptions()
        if asked.largest_step is not None:
            first = min(options.first_step, asked.largest_step)
            options = ArclengthOptions(first_step=first, largest_step=asked.largest_step)
        with err.status("following the branch (the first time compiles for a while)"):
            branch = continue_branch(
                settings.params(),
                asked.parameter,
                asked.bounds,
                period_n=asked.period,
                model=settings.wheel_model(),
                options=options,
            )
        if not branch.values.size:
            complain(
                f"there is no gait to start from ({branch.outcome.name}: "
                f"{branch.outcome.meaning[:-1]}): give a wheel that walks, such as that of Table 1."
            )
            raise typer.Exit(NOT_CONVERGED)
        out.print(str(branch), highlight=False, markup=False)
        printing.tell_written(write_branch(branch, folder, picture))


def _settings(path: Path | None) -> "Config":
    """Start JAX, and return the config at `path` or the default config."""
    from vrw_jax.runtime import start_jax

    start_jax()
    from vrw_jax.app.config import Config, load

    return Config() if path is None else load(path)


NEEDED = {
    "design": "has no samples, but a scan needs a design: add a table [grid], [samples], [sobol], "
    "[uniform] or [saltelli], as in configs/quickstart.toml of `vrw init`.",
    "tune": "seeks nothing, but tuning needs an objective and bounds: add the tables [tune] and "
    "[tune.bounds], as in configs/tune_dls.toml of `vrw init`.",
    "branch": "names no branch, but continuation needs a parameter and bounds: add a table "
    "[branch], as in configs/branch_damping.toml of `vrw init`.",
}
"""Messages about a config that lacks the table that a command needs."""

SERVES = {
    "design": ("viscoelastic", "unilateral", "auto"),
    "map": ("viscoelastic",),
    "tune": ("viscoelastic", "unilateral"),
    "branch": ("viscoelastic", "unilateral", "rigid"),
}
"""Models that each command supports."""


def _asked(
    path: Path, folder: Path | None, needed: str, command: str = ""
) -> tuple["Config", Path]:
    """Return the config and the folder of the result; raise if the needed table is missing."""
    settings = _settings(path)
    if getattr(settings, needed) is None:
        raise ValueError(f"{settings.name} {NEEDED[needed]}")
    serves = SERVES[command or needed]
    if settings.rung not in serves:
        raise ValueError(
            f"{settings.name} names the rung {settings.rung}, but this command takes "
            f"{', '.join(serves)}: write {'one of these' if len(serves) > 1 else 'that'} below "
            "[model]."
        )
    return settings, Path("results") / path.stem if folder is None else folder
