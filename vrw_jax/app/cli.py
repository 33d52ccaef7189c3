"""The command line: walk a wheel, reproduce the paper, scan parameters.

Nothing heavy is imported before a command runs, so that help comes at once. What a user got wrong
is said in one sentence on stderr, with exit code 2.
"""

import contextlib
import gc
import importlib.metadata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

    from vrw_jax.app.config import Config
    from vrw_jax.cycles import LimitCycle
    from vrw_jax.models import StepResult
    from vrw_jax.paper import Fact
    from vrw_jax.scans import Plan, Progress
    from vrw_jax.tuning import Tuned
    from vrw_jax.wheel import WheelParams

USER_ERROR, FACT_FAILED, NOT_CONVERGED, INTERRUPTED = 2, 1, 1, 130
"""Exit codes."""

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
out, err = Console(), Console(stderr=True)


def main() -> None:
    """Entry point of `vrw`."""
    # Traces are many small objects that live on: looking for dead ones among them as often as
    # Python does by itself takes a tenth of a cold start.
    gc.set_threshold(200_000, 20, 20)
    app()


def _version(wanted: bool) -> None:
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

      [cyan]vrw gait[/cyan]                              the wheel of Table 1 on the paper's slope

      [cyan]vrw gait --set damping=150[/cyan]            the same with softer dampers

      [cyan]vrw reproduce --out paper[/cyan]             all figures and the table of facts

      [cyan]vrw scan configs/quickstart.toml[/cyan]      4,096 steady gaits, a dataset and a picture

      [cyan]vrw tune configs/tune_dls.toml[/cyan]        the most double support without scuffing

      [cyan]vrw continue configs/branch_damping.toml[/cyan]   a branch of gaits and its borders

    [bold]What is written[/bold]   gait: nothing. reproduce: figures and tables into its folder.
    scan: scan.zarr (open it with vrw_jax.open_scan or xarray.open_zarr) and pictures, PNG and SVG.
    tune: path.zarr, a picture, summary.md, and wheel.toml, which vrw gait walks. continue:
    branch.zarr, borders.csv, a picture and summary.md.

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
    """Walk a wheel and tell its gait: durations, speed, indicators, and which premises hold.

    Walks step by step from a start near the gait of Table 1 (or the config's), then looks for the
    limit cycle next to where it got to. Writes no file.

    [bold]Examples[/bold]

      vrw gait --set damping=150 --set slope=0.28

      vrw gait configs/table1.toml --steps 50
    """
    with _sentences():
        settings = _config(config)
        changed = dict(_assignment(text) for text in changes or [])
        params = settings.params(changed)
    _tell_gait(settings, params, steps or settings.gait.steps)


@app.command()
def reproduce(
    folder: Annotated[
        Path, typer.Option("--out", help="Folder for the figures and the table.")
    ] = Path("results/reproduction"),
) -> None:
    """Reproduce the paper: figures 6 to 10, and every published fact beside what is found.

    Prints the table of facts and writes it beside the figures, with tolerances and their reasons.
    Exit code 1 if a fact does not hold.
    """
    from vrw_jax.runtime import start_jax

    with _sentences():
        start_jax()
        folder.mkdir(parents=True, exist_ok=True)
    from vrw_jax.paper import reproduce as run

    with _bar("reproducing the paper") as bar:
        task = bar.add_task("starting", total=1.0)
        facts = run(
            folder, progress=lambda share, what: bar.update(task, completed=share, description=what)
        )
    _tell_facts(facts, folder)
    if not all(fact.holds for fact in facts):
        raise typer.Exit(FACT_FAILED)


def _tell_facts(facts: "list[Fact]", folder: Path) -> None:
    table = Table("fact", "where", "published", "found", "", box=None)
    for fact in facts:
        verdict = "[green]holds[/green]" if fact.holds else "[bold red]does not hold[/bold red]"
        told = fact.claim, fact.where, fact.published, fact.found
        table.add_row(*map(_escaped, told), verdict)
    out.print(table)
    n_held = sum(fact.holds for fact in facts)
    out.print(f"{n_held} of {len(facts)} hold; figures and {folder / 'facts.md'} tell more.")


@app.command()
def scan(
    config: Annotated[Path, typer.Argument(help="TOML file with the samples and measures.")],
    folder: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the result; results/NAME of the config by default."),
    ] = None,
    explain: Annotated[
        bool, typer.Option("--explain", help="Only tell sizes, chunks, memory and time.")
    ] = False,
    chunk: Annotated[
        int | None, typer.Option(min=1, help="Most samples that are written at a time.")
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute on the dask cluster at this address; 'local' starts one here.",
        ),
    ] = None,
    picture: Annotated[bool, typer.Option(help="Draw the result.")] = True,
) -> None:
    """Find the steady gait of every sample of a design, with outcome and premises of each.

    Writes scan.zarr and pictures (PNG and SVG) into the folder. Interrupt it as you like: the same
    command goes on where it stopped, and ends with bitwise the same data. A finished scan is not
    computed again.

    [bold]Examples[/bold]

      vrw scan configs/quickstart.toml --explain

      vrw scan configs/quickstart.toml --out results/first

      vrw scan configs/quickstart.toml --dask tcp://host:8786
    """
    with _sentences():
        planned, name = _planned(config, chunk)
        folder = Path("results") / name if folder is None else folder
        store = folder / "scan.zarr"
        if explain:
            _tell_plan(planned, store)
            return
        from vrw_jax.scans import open_store

        missing = open_store(planned, store).missing()
    if missing:
        _compute(planned, store, dask)
    else:
        out.print(f"{store} is complete: nothing to compute.", highlight=False)
    _tell_scan(store, folder, picture)


@app.command()
def tune(
    config: Annotated[Path, typer.Argument(help="TOML file with objective, bounds, constraints.")],
    folder: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the result; results/NAME of the config by default."),
    ] = None,
    picture: Annotated[bool, typer.Option(help="Draw the result.")] = True,
) -> None:
    """Tune a wheel: the best gait within bounds that keeps its premises.

    Climbs along the branch of gaits with exact gradients, then walks the tuned wheel. Writes
    path.zarr (every gait evaluated), summary.md, wheel.toml (the tuned wheel) and pictures (PNG and
    SVG) into the folder. Exit code 1 if it did not end at an optimum.

    [bold]Examples[/bold]

      vrw tune configs/tune_dls.toml

      vrw tune configs/tune_stability.toml --out results/steady

      vrw gait results/steady/wheel.toml
    """
    with _sentences():
        settings = _config(config)
        sought = settings.tune
        if sought is None:
            raise ValueError(
                f"{settings.name} seeks nothing, but tuning needs an objective and bounds: add the "
                "tables [tune] and [tune.bounds], as in configs/tune_dls.toml."
            )
        folder = Path("results") / config.stem if folder is None else folder
        folder.mkdir(parents=True, exist_ok=True)
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
    _tell_tuned(tuned)
    from vrw_jax.app.tune_report import write

    with _sentences():
        for path in write(tuned, folder, picture):
            out.print(f"written: {path}", highlight=False, soft_wrap=True)
    if not tuned.converged:
        raise typer.Exit(NOT_CONVERGED)


def _tell_tuned(tuned: "Tuned") -> None:
    table = Table(title="Tuned gait", title_justify="left", show_header=False, box=None)
    for name, text in tuned.lines().items():
        table.add_row(f"[bold]{name}[/]", _escaped(text))
    out.print(table)


@app.command("continue")
def continue_(
    config: Annotated[Path, typer.Argument(help="TOML file with a table [branch].")],
    folder: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the result; results/NAME of the config by default."),
    ] = None,
    picture: Annotated[bool, typer.Option(help="Draw the result.")] = True,
) -> None:
    """Follow a branch of gaits along a parameter, stable or not, and locate every border on it.

    Writes branch.zarr (open it with xarray.open_zarr), borders.csv, summary.md and pictures (PNG
    and SVG) into the folder. Exit code 1 if there is no limit cycle to start from.

    [bold]Examples[/bold]

      vrw continue configs/branch_damping.toml

      vrw continue configs/branch_damping.toml --out results/along_c --no-picture
    """
    with _sentences():
        settings = _config(config)
        asked = settings.branch
        if asked is None:
            raise ValueError(
                f"{settings.name} names no branch, but continuation needs a parameter and bounds: "
                "add a table [branch], as in configs/branch_damping.toml."
            )
        folder = Path("results") / config.stem if folder is None else folder
        folder.mkdir(parents=True, exist_ok=True)
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
    out.print(_escaped(str(branch)), highlight=False)
    from vrw_jax.app.branch_report import write

    with _sentences():
        for path in write(branch, folder, picture):
            out.print(f"written: {path}", highlight=False, soft_wrap=True)
    if not branch.values.size:
        raise typer.Exit(NOT_CONVERGED)


@contextlib.contextmanager
def _sentences() -> Iterator[None]:
    """What the user got wrong as one sentence on stderr and exit code 2."""
    try:
        yield
    except (ValueError, OSError) as error:
        text = str(error) if isinstance(error, ValueError) else _of_system(error)
        err.print(f"[bold red]vrw:[/] {_escaped(text)}", highlight=False, soft_wrap=True)
        raise typer.Exit(USER_ERROR) from error


def _of_system(error: OSError) -> str:
    place = f"{error.filename}: " if error.filename else ""
    return f"{place}{error.strerror or error}."


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)


def _config(path: Path | None) -> "Config":
    from vrw_jax.runtime import start_jax

    start_jax()
    from vrw_jax.app.config import Config, load

    return Config() if path is None else load(path)


def _assignment(text: str) -> tuple[str, float | int]:
    from vrw_jax.app.config import assignment

    return assignment(text)


def _bar(what: str) -> "Bar":
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        *((MofNCompleteColumn(),) if what == "scan" else ()),
        TextColumn("{task.fields[note]}") if what == "scan" else TimeElapsedColumn(),
    )
    return Bar(*columns, console=err)


def _planned(path: Path, chunk: int | None) -> tuple["Plan", str]:
    settings = _config(path)
    from vrw_jax.app.config import ConfigError
    from vrw_jax.scans import DEFAULT_MEASURES, plan

    if settings.design is None:
        raise ConfigError(
            f"{settings.name} has no samples, but a scan needs a design: add a table [grid], "
            "[samples], [sobol], [uniform] or [saltelli], as in configs/quickstart.toml."
        )
    planned = plan(
        settings.design,
        settings.scan.measures or DEFAULT_MEASURES,
        base=settings.params(),
        model=settings.wheel_model(),
        options=settings.numerical_options(),
        chunk=chunk or settings.scan.chunk,
        text=settings.text,
    )
    return planned, path.stem


def _tell_plan(planned: "Plan", store: Path) -> None:
    from vrw_jax.scans import explained

    table = Table(
        title="What this scan would do", title_justify="left", show_header=False, box=None
    )
    for name, text in explained(planned, store).items():
        table.add_row(f"[bold]{name}[/]", text)
    table.add_row("[bold]store[/]", str(store))
    out.print(table)


def _compute(planned: "Plan", store: Path, dask: str | None) -> None:
    from vrw_jax.scans import carried, run

    try:
        with _sentences(), carried(dask) as through, _bar("scan") as bar:
            task = bar.add_task("compiling", total=None, note="")
            run(planned, store, report=_reporter(bar.update, task), through=through)
    except KeyboardInterrupt:
        err.print(
            f"vrw: stopped; what is done stays in {store}, run the same to go on.", soft_wrap=True
        )
        raise typer.Exit(INTERRUPTED) from None


def _reporter(update: Callable, task: int) -> Callable[["Progress"], None]:
    """Shows rate, share without a gait and time left; the first chunk's time is compiling too."""
    import time

    from vrw_jax.scans import in_words

    first: list[tuple[float, int]] = []

    def report(progress: "Progress") -> None:
        now, done = time.monotonic(), progress.done
        note = ""
        if done:
            first.append((now, done))
            began, before = first[0]
            note = f"{100 * progress.failed / done:.0f} % without a gait"
            if now > began:
                rate = (done - before) / (now - began)
                left = (progress.samples - done) / rate
                note = f"{rate:,.0f} per s, {note}, {in_words(left)} left"
        update(
            task,
            total=progress.samples,
            completed=done,
            description="scanning" if done else "compiling",
            note=note,
        )

    return report


def _tell_scan(store: Path, folder: Path, picture: bool) -> None:
    import numpy as np

    from vrw_jax.scans import open_scan
    from vrw_jax.wheel import Outcome

    dataset = open_scan(store)
    codes, counts = np.unique(dataset.outcome.values, return_counts=True)
    table = Table(title="Outcomes", title_justify="left", box=None)
    for heading in ("samples", "share", "outcome", "meaning"):
        table.add_column(heading, justify="right" if heading in ("samples", "share") else "left")
    for code, count in zip(codes, counts, strict=True):
        outcome = Outcome(int(code))
        share = f"{100 * count / counts.sum():.1f} %"
        table.add_row(f"{count:,}", share, outcome.name, outcome.meaning)
    out.print(table)
    out.print(f"data: {store}", highlight=False, soft_wrap=True)
    if picture:
        from vrw_jax.figures import scan_figures
        from vrw_jax.figures import walk as plots

        for name, figure in scan_figures(dataset).items():
            for path in plots.save(figure, folder, name):
                out.print(f"picture: {path}", highlight=False, soft_wrap=True)


def _tell_gait(settings: "Config", params: "WheelParams", n_steps: int) -> None:
    import numpy as np

    import vrw_jax as vrw
    from vrw_jax.cycles import limit_cycle

    model, options = settings.wheel_model(), settings.numerical_options()
    start = settings.gait.start
    state = model.start(params) if start is None else start
    walked = 0
    with err.status("walking (the first time compiles for a while)"):
        while True:
            result = vrw.step(params, state, model=model, options=options)
            outcome = vrw.Outcome(int(result.outcome))
            walked += outcome == vrw.Outcome.STEPPED
            if outcome != vrw.Outcome.STEPPED or walked == n_steps:
                break
            state = result.section_state
        cycle = limit_cycle(params)
    _tell_wheel(params)
    if outcome == vrw.Outcome.STEPPED:
        change = float(np.abs(np.asarray(result.section_state) - np.asarray(state)).max())
        out.print(f"Walked {walked} steps; the last changed the section state by {change:.1e}.")
        _tell_step(result)
    else:
        out.print(f"[bold]Step {walked + 1} ended as {outcome.name}:[/] {outcome.meaning}")
    _tell_cycle(cycle)
    if outcome == vrw.Outcome.STEPPED:
        _tell_premises(result)


def _tell_wheel(params: "WheelParams") -> None:
    from vrw_jax.wheel import DOMAINS

    told = [f"{name} {float(getattr(params, name)):g} {d.unit}" for name, d in DOMAINS.items()]
    out.print("[bold]Wheel[/]  " + ", ".join(told) + f", {params.n_legs} legs")


def _tell_step(result: "StepResult") -> None:
    from vrw_jax.results import MARGINS, STEP

    values = result.measures()
    table = Table(title="Last step", title_justify="left", box=None)
    for heading in ("quantity", "symbol", "value", "unit"):
        table.add_column(heading, justify="right" if heading == "value" else "left")
    for name, measure in STEP.items():
        if name in ("outcome", "solver_steps") or name in MARGINS:
            continue
        unit = "" if measure.unit == "1" else measure.unit
        table.add_row(measure.long_name, measure.symbol, f"{float(values[name]):.5g}", unit)
    out.print(table)


def _tell_cycle(cycle: "LimitCycle") -> None:
    import numpy as np

    if not bool(cycle.found):
        out.print("[bold]Limit cycle[/]  none was found in the paper's sequence of phases.")
        return
    multipliers = ", ".join(_complex(complex(z)) for z in np.asarray(cycle.multipliers))
    radius = float(cycle.spectral_radius)
    verdict = "stable" if radius < 1.0 else "unstable"
    out.print(
        f"[bold]Limit cycle[/]  {verdict}: multipliers {multipliers}; period "
        f"{float(cycle.period):.5f} s, speed {float(cycle.speed):.5f} m/s, "
        f"DLS {100 * float(cycle.dls_fraction):.2f} %."
    )


def _complex(z: complex) -> str:
    return f"{z.real:.4f}" if abs(z.imag) < 1e-12 else f"{z.real:.4f}{z.imag:+.4f}i"


def _tell_premises(result: "StepResult") -> None:
    import numpy as np

    from vrw_jax.results import MARGINS

    table = Table(title="Premises of the paper's rung", title_justify="left", box=None)
    for heading in ("", "margin of", "symbol", "least", "unit"):
        table.add_column(heading, justify="right" if heading == "least" else "left")
    broken = 0
    for name, measure in MARGINS.items():
        values = np.atleast_1d(np.asarray(getattr(result.monitors, name)))
        least = float(values.min())
        mark = "[green]holds[/]" if least >= 0.0 else "[bold red]broken[/]"
        broken += least < 0.0
        where = measure.long_name
        if measure.axis:
            legs = [str(leg + 3) for leg in np.flatnonzero(values < 0.0)]
            where += f" (broken at legs {', '.join(legs)})" if legs else ""
        unit = "" if measure.unit == "1" else measure.unit
        table.add_row(mark, where, measure.symbol, f"{least:.4g}", unit)
    out.print(table)
    n = len(MARGINS)
    out.print(
        f"{n - broken} of {n} premises hold, {broken} are broken. The rung walks on regardless: "
        "it measures what it does not model."
    )
