"""The commands: walk a wheel, reproduce the paper, scan parameters, tune, continue branches.

Slow imports are inside the commands, so that help appears quickly. A user's mistake is reported in
one sentence on stderr, with exit code 2.
"""

import gc
import importlib
import importlib.metadata
import os
import signal
import tempfile
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vrw_jax.cli import console as printing
from vrw_jax.cli import scanning
from vrw_jax.cli.console import (
    ExitCode,
    print_error,
    report_errors,
    show_stages,
    show_warnings_as_sentences,
    stdout_console,
)
from vrw_jax.cli.encoding import spell_unencodable_characters

if TYPE_CHECKING:
    from vrw_jax.cli.config import Config

MAX_OPTION_INTEGER = 10**9
"""Largest integer of an option, chosen because a scan takes no more samples."""

SENSITIVITY_MEASURES = ("period", "speed")
"""Measures whose gait sensitivity norms `vrw robustness` prints."""

FolderOption = Annotated[
    Path | None,
    typer.Option("--out", help="Folder for the result; results/NAME of the config by default."),
]
PictureOption = Annotated[bool, typer.Option(help="Draw the result.")]
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
    # collector takes a tenth of the first run's time.
    gc.set_threshold(200_000, 20, 20)
    signal.signal(signal.SIGINT, _interrupt_command)
    show_warnings_as_sentences()
    spell_unencodable_characters()
    with printing.report_output_errors():
        app()


def _interrupt_command(_signal: int, _frame: object) -> None:
    """Handle the first Ctrl-C: end the command regularly, and install the handler of a second
    one.
    """
    signal.signal(signal.SIGINT, _end_process)
    raise KeyboardInterrupt


def _end_process(_signal: int, _frame: object) -> None:
    """Handle the second Ctrl-C: end the process immediately."""
    os.write(2, b"vrw: stopped at once; run the same to go on.\n")
    os._exit(ExitCode.INTERRUPTED)


def _print_version(is_wanted: bool) -> None:
    """Print the version and exit if `--version` is given."""
    if is_wanted:
        try:
            version_number = importlib.metadata.version("vrw-jax")
        except importlib.metadata.PackageNotFoundError:
            version_number = "(not installed)"
        print(f"vrw {version_number}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Simulate the passive viscoelastic-legged rimless wheel: walk, scan, tune, follow branches.

    [bold]Examples[/bold]

      [cyan]vrw init[/cyan]                              write the example configs named here

      [cyan]vrw gait[/cyan]                              the wheel of Table 1 on the paper's slope

      [cyan]vrw gait --set damping=150[/cyan]            the same with weaker dampers

      [cyan]vrw reproduce --out paper[/cyan]             all figures and the table of facts

      [cyan]vrw scan configs/quickstart.toml[/cyan]      4,096 steady gaits, a dataset and a picture

      [cyan]vrw robustness configs/robustness.toml[/cyan]   mean lives on random slopes

      [cyan]vrw tune configs/tune_dls.toml[/cyan]        the most double support without scuffing

      [cyan]vrw continue configs/branch_damping.toml[/cyan]   a branch of gaits, special points

    [bold]Files[/bold]   init: configs. gait: none. reproduce: figures and tables. scan: scan.zarr
    (open it with vrw_jax.open_scan or xarray.open_zarr) and pictures, PNG and SVG.
    tune: path.zarr, a picture, summary.md, and wheel.toml, a config of vrw gait.
    continue: branch.zarr, borders.csv, a picture and summary.md.

    The first run of a command compiles for some seconds. The code is kept in a cache folder
    (JAX_COMPILATION_CACHE_DIR names another), so later runs start quickly. Angles are in rad, all
    other quantities in SI units.
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
    steps: Annotated[
        int | None, typer.Option(min=1, max=MAX_OPTION_INTEGER, help="Steps to walk.")
    ] = None,
) -> None:
    """Walk a wheel and print its gait: durations, speed, indicators, force peaks and margins.

    The walk begins near the gait of Table 1, or at the start in the config. The command then
    finds the limit cycle near the last step. With unilateral contact and no start in the config,
    it finds the slowest attracting gait instead. It writes no file.

    [bold]Examples[/bold]

      vrw gait --set damping=150 --set slope=0.28

      vrw gait configs/table1.toml --steps 50
    """
    with report_errors():
        settings = _load_config(config)
        from vrw_jax.cli.config import parse_assignment

        params = settings.make_wheel(dict(parse_assignment(text) for text in changes or []))
        import jax.numpy as jnp

        from vrw_jax.cycles import limit_cycle, make_finder, resolve_model_with_reason
        from vrw_jax.simulation import SAMPLED_PEAK_MEASURES, force_peaks, simulate, step
        from vrw_jax.wheel import Outcome

        model: Any = settings.make_model()
        options = settings.make_options()
        start = settings.gait.start
        state = model.default_start(params) if start is None else jnp.asarray(start)
        state = model.embed_section(params, state)
        n_walked, n_steps = 0, steps or settings.gait.steps
        with show_stages("walking (the first time compiles for a while)"):
            while True:
                result: Any = step(params, state, model=model, options=options)
                has_stepped = int(result.outcome) == Outcome.STEPPED
                n_walked += has_stepped
                if not has_stepped or n_walked == n_steps:
                    break
                state = result.section_state
            model, reason = resolve_model_with_reason(params, model)
            needs_no_guess = start is None or make_finder(model, params.n_legs).supports_cold_start
            cycle: Any = limit_cycle(params, guess=None if needs_no_guess else state, model=model)
            peaks = None
            if model.is_compliant and bool(cycle.found):
                gait_step = simulate(params, cycle.section_state, 1, model=model, options=options)
                peaks = force_peaks(gait_step)[list(SAMPLED_PEAK_MEASURES)]
        printing.print_gait(params, result, state, n_walked, cycle, peaks)
        if reason:
            stdout_console.print(reason)


@app.command()
def explore(
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Initial parameter; may be repeated."),
    ] = None,
    model_name: Annotated[
        str, typer.Option("--model", help="viscoelastic, rigid or unilateral.")
    ] = "viscoelastic",
) -> None:
    """Open an interactive page of the wheel in your browser; the page computes by itself."""
    with report_errors():
        from vrw_jax.cli.config import parse_assignment
        from vrw_jax.web import make_page_address

        params = _load_config(None).make_wheel(dict(parse_assignment(t) for t in changes or []))
        address = make_page_address(params, model_name)
        webbrowser.open(address)
        print(address)


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(help="Where to write them.")] = Path("configs"),
) -> None:
    """Write the example configs, from which you can derive your own.

    Existing files are kept. If an existing file differs, the command names it and writes nothing.
    """
    with report_errors():
        example_folder = find_example_configs()
        example_texts = {
            path.name: path.read_text(encoding="utf-8") for path in example_folder.glob("*.toml")
        }
        existing_paths = [
            folder / name for name in sorted(example_texts) if (folder / name).exists()
        ]
        for path in existing_paths:
            if path.read_text(encoding="utf-8", errors="replace") != example_texts[path.name]:
                raise ValueError(f"{path} is there already and differs: give another folder.")
        _require_writable(folder)
        folder.mkdir(parents=True, exist_ok=True)
        missing_names = [
            folder / name for name in sorted(example_texts) if folder / name not in existing_paths
        ]
        for path in missing_names:
            path.write_text(example_texts[path.name], encoding="utf-8")
        printing.print_written_paths(missing_names)
        if not missing_names:
            stdout_console.print(f"{folder} has them all: nothing to write.", highlight=False)


def find_example_configs() -> Path:
    """Return the folder of the example configs, inside an installed package or beside it."""
    package = Path(__file__).parents[1]
    return next(
        candidate_folder
        for candidate_folder in (package / "configs", package.parent / "configs")
        if candidate_folder.is_dir()
    )


def _require_writable(folder: Path) -> None:
    """Raise a ValueError if the folder cannot be written to; nothing is created."""
    existing_folder = folder
    while not existing_folder.exists():
        existing_folder = existing_folder.parent
    try:
        with tempfile.TemporaryDirectory(dir=existing_folder):
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

    The command prints the table of facts, and writes it with the figures, tolerances and their
    reasons. The exit code is 1 if a fact does not hold.
    """
    from vrw_jax.runtime import start_jax

    with report_errors():
        start_jax()
        _require_compiler()
        _require_writable(folder)
        _require_pictures(True)
    from vrw_jax.paper import reproduce as run

    with (
        report_errors(f"stopped; what is done stays in {folder}."),
        printing.make_progress_bar("reproducing the paper") as progress_bar,
    ):
        task = progress_bar.add_task("starting", total=1.0)
        facts = run(
            folder,
            on_progress=lambda progress_fraction, stage_description: progress_bar.update(
                task, completed=progress_fraction, description=stage_description
            ),
        )
    with report_errors():
        printing.print_facts(facts, folder)
    if not all(fact.holds for fact in facts):
        raise typer.Exit(ExitCode.CHECK_FAILED)


@app.command()
def scan(
    config: Annotated[Path, typer.Argument(help="TOML file with the samples and measures.")],
    folder: FolderOption = None,
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
        int | None,
        typer.Option(
            min=1, max=MAX_OPTION_INTEGER, help="Most samples that are written at a time."
        ),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute on the dask cluster at this address; 'local' starts one here.",
        ),
    ] = None,
    picture: PictureOption = True,
) -> None:
    """Find the steady gait of every sample of a design, with its outcome and margins.

    The command writes scan.zarr and figures (PNG and SVG) into the folder. After an interruption
    the same command continues where it stopped, and ends with bitwise the same data. Of a finished
    scan only chunks with damaged files are computed again. The exit code is 1 if --verify finds
    damage.

    [bold]Examples[/bold]

      vrw scan configs/quickstart.toml --explain

      vrw scan configs/quickstart.toml --out results/first

      vrw scan configs/quickstart.toml --dask tcp://host:8786
    """
    with report_errors():
        settings, folder = _load_config_for(config, folder, "design", "scan")
        plan, store = scanning.plan_config_scan(settings, chunk), folder / "scan.zarr"
        from vrw_jax.scans import forecast_scan

        if explain:
            with show_stages("measuring some samples (the first time compiles for a while)"):
                forecast = forecast_scan(plan, store) | {"store": str(store)}
            printing.print_table("What this scan would do", forecast.items())
            return
        if verify:
            scanning.verify_store(plan, store)
            return
        _require_writable(folder)
        _require_pictures(picture)
    dataset = scanning.compute_scan(plan, store, dask)
    with report_errors(f"stopped; the data are in {store}."):
        printing.print_outcomes(dataset)
        stdout_console.print(f"data: {store}", highlight=False, soft_wrap=True)
        if picture:
            from vrw_jax.cli.reports import write_scan

            printing.print_written_paths(write_scan(dataset, folder))


@app.command()
def robustness(
    config: Annotated[Path, typer.Argument(help="TOML file with slope_sd in its table [scan].")],
    folder: FolderOption = None,
    picture: PictureOption = True,
) -> None:
    """Compute the mean number of steps until failure on random slopes, and gait sensitivities.

    Without a design in the config, prints both for one wheel and writes no file. With a grid or
    samples, computes each sample in turn and writes scan.zarr and figures (PNG and SVG) into the
    folder. After an interruption the same command continues where it stopped.

    [bold]Examples[/bold]

      vrw robustness configs/robustness.toml
    """
    with report_errors():
        settings = _load_config(config)
        slope_sd = settings.scan.slope_sd
        if slope_sd is None:
            raise ValueError(
                f"{config.name}: [scan] has no slope_sd, the standard deviation of the slopes: "
                "write slope_sd = 0.01, in rad, say."
            )
        if settings.design is None:
            from vrw_jax.robustness import first_passage, gait_sensitivity

            params, model = settings.make_wheel(), settings.make_model()
            with show_stages("walking over random slopes (the first time compiles for a while)"):
                passage = first_passage(params, slope_sd, model=model)
                sensitivity = gait_sensitivity(params, SENSITIVITY_MEASURES, model=model)
            print(passage)
            print(sensitivity)
            return
    scan(config, folder, picture=picture)


@app.command("map")
def map_special_points(
    config: Annotated[Path, typer.Argument(help="TOML file with a grid over two parameters.")],
    folder: FolderOption = None,
) -> None:
    """Draw all special points of gaits over two parameters: `vrw map configs/map_c_k.toml`."""
    with report_errors():
        settings, folder = _load_config_for(config, folder, "design", "map")
        from vrw_jax.branches import SPECIAL_POINT_MEASURES
        from vrw_jax.cli.reports import write_map
        from vrw_jax.scans import follow_special_points, require_map_grid

        plan = scanning.plan_config_scan(settings, None, SPECIAL_POINT_MEASURES)
        require_map_grid(plan.design)
        _require_writable(folder)
        _require_pictures(True)
    dataset = scanning.compute_scan(plan, folder / "scan.zarr", None)

    with (
        report_errors(),
        show_stages("following special points (the first time compiles for minutes)") as on_stage,
    ):
        special_points = follow_special_points(
            dataset, settings.make_wheel(), settings.make_model(), on_stage
        )
        on_stage("drawing the map")
        paths = write_map(special_points, folder)
    printing.print_written_paths(paths)


@app.command()
def tune(
    config: Annotated[Path, typer.Argument(help="TOML file with objective, bounds, constraints.")],
    folder: FolderOption = None,
    picture: PictureOption = True,
) -> None:
    """Tune a wheel: find the best gait within bounds that satisfies its constraints.

    The optimization follows the branch of gaits with exact gradients; then the tuned wheel walks.
    The command writes path.zarr (every gait evaluated), summary.md, wheel.toml (the tuned wheel)
    and figures (PNG and SVG) into the folder. The exit code is 1 if the run does not end at an
    optimum. It is 2, and nothing is written, if the start has no gait.

    [bold]Examples[/bold]

      vrw tune configs/tune_dls.toml

      vrw tune configs/tune_stability.toml --out results/steady

      vrw gait results/steady/wheel.toml
    """
    with report_errors():
        settings, folder = _load_config_for(config, folder, "tune", "tune")
        tune_config = settings.tune
        assert tune_config is not None
        _require_writable(folder)
        _require_pictures(picture)
        from vrw_jax.cli.reports import write_tuning
        from vrw_jax.tuning import tune as run

        with show_stages("tuning (the first time compiles for a while)"):
            result = run(
                settings.make_wheel(),
                tune_config.objective,
                tuple(tune_config.bounds),
                tune_config.bounds,
                tune_config.constraints,
                model=settings.make_model(),
                options=settings.make_options(),
                max_evaluations=tune_config.evaluations,
            )
        printing.print_table("Tuned gait", result.describe().items())
        printing.print_written_paths(write_tuning(result, folder, picture))
    if not result.converged:
        print_error(f"this is no optimum ({result.status.name}): what was reached is written.")
        raise typer.Exit(ExitCode.CHECK_FAILED)


@app.command("continue")
def continue_(
    config: Annotated[Path, typer.Argument(help=r"TOML file with a table \[branch].")],
    folder: FolderOption = None,
    picture: PictureOption = True,
) -> None:
    """Continue a branch of stable and unstable gaits along a parameter, with its special points.

    The command writes branch.zarr (open it with xarray.open_zarr), borders.csv, summary.md and
    figures (PNG and SVG) into the folder. The exit code is 1, and nothing is written, if there is
    no gait to start from.

    [bold]Examples[/bold]

      vrw continue configs/branch_damping.toml

      vrw continue configs/branch_damping.toml --out results/along_c --no-picture
    """
    with report_errors():
        settings, folder = _load_config_for(config, folder, "branch", "branch")
        branch_config = settings.branch
        assert branch_config is not None
        _require_writable(folder)
        _require_pictures(picture)
        from vrw_jax.branches import continue_branch
        from vrw_jax.cli.reports import write_branch
        from vrw_jax.continuation import ArclengthOptions

        options = ArclengthOptions()
        if branch_config.max_ds is not None:
            initial_ds = min(options.initial_ds, branch_config.max_ds)
            options = ArclengthOptions(initial_ds=initial_ds, max_ds=branch_config.max_ds)
        with show_stages("following the branch (the first time compiles for a while)"):
            branch = continue_branch(
                settings.make_wheel(),
                branch_config.parameter,
                branch_config.bounds,
                period_n=branch_config.period,
                model=settings.make_model(),
                options=options,
            )
        if not branch.values.size:
            print_error(
                f"there is no gait to start from ({branch.outcome.name}: "
                f"{branch.outcome.meaning[:-1]}): give a wheel that walks, such as that of Table 1."
            )
            raise typer.Exit(ExitCode.CHECK_FAILED)
        stdout_console.print(str(branch), highlight=False, markup=False)
        printing.print_written_paths(write_branch(branch, folder, picture))


def _load_config(path: Path | None) -> "Config":
    """Start JAX, and return the config at `path` or the default config."""
    from vrw_jax.runtime import start_jax

    start_jax()
    _require_compiler()
    from vrw_jax.cli.config import Config, load_config

    return Config() if path is None else load_config(path)


def _require_compiler() -> None:
    """Raise a ValueError if compilation is disabled, because commands would take hours."""
    import jax

    if jax.config.jax_disable_jit:  # type: ignore[attr-defined]
        raise ValueError(
            "JAX_DISABLE_JIT is set, but commands compute with compiled code: unset it."
        )


def _require_pictures(picture: bool) -> None:
    """Raise a ValueError if matplotlib lacks the backend, before anything is computed."""
    if not picture:
        return
    try:
        importlib.import_module("vrw_jax.figures")
    except ValueError as error:
        raise ValueError(
            f"MPLBACKEND is {os.environ.get('MPLBACKEND')!r}, which matplotlib doesn't know: unset "
            "it, or set it to agg."
        ) from error


MISSING_TABLE_MESSAGES = {
    "design": "has no samples, but a scan needs a design: add a table [grid], [samples], [sobol], "
    "[uniform] or [saltelli], as in configs/quickstart.toml of `vrw init`.",
    "tune": "seeks nothing, but tuning needs an objective and bounds: add the tables [tune] and "
    "[tune.bounds], as in configs/tune_dls.toml of `vrw init`.",
    "branch": "names no branch, but continuation needs a parameter and bounds: add a table "
    "[branch], as in configs/branch_damping.toml of `vrw init`.",
}
"""Messages about a config that lacks the table that a command needs, by table."""


def _load_config_for(
    path: Path, folder: Path | None, table_name: str, command: str
) -> tuple["Config", Path]:
    """Return the config and the folder of the result; raise a ValueError if the needed table is
    missing.
    """
    settings = _load_config(path)
    if getattr(settings, table_name) is None:
        raise ValueError(f"{settings.file_name} {MISSING_TABLE_MESSAGES[table_name]}")
    from vrw_jax.selection import list_config_names

    supported_models = list_config_names(command)
    if settings.model_name not in supported_models:
        raise ValueError(
            f"{settings.file_name} names the model {settings.model_name}, but this command takes "
            f"{', '.join(supported_models)}: write "
            f"{'one of these' if len(supported_models) > 1 else 'that'} below [model]."
        )
    return settings, Path("results") / path.stem if folder is None else folder
