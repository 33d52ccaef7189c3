"""The commands: walk a wheel, reproduce the paper, scan parameters, tune, continue branches.

The commands that draw figures import matplotlib themselves, so that help appears quickly. A user's
mistake is reported in one sentence on standard error, with exit code 2.
"""

import gc
import importlib.util
import io
import keyword
import os
import signal
import sys
import tokenize
import webbrowser
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import jax
import typer

from vrw_jax.app import output as printing
from vrw_jax.app import scanning
from vrw_jax.app.config import (
    Config,
    is_figure_file,
    load_config,
    parse_assignments,
)
from vrw_jax.app.explorer import make_page_address
from vrw_jax.app.output import (
    ExitCode,
    print_error_sentence,
    replace_unencodable_output,
    report_command_errors,
    require_writable_folder,
    require_writable_output,
    show_computation_stages,
    show_warnings_as_sentences,
    stdout_console,
    write_branch_report,
    write_special_point_map,
    write_tuning_report,
)
from vrw_jax.app.scanning import forecast_scan
from vrw_jax.base.checks import check_path
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import PROGRESS_VARIABLE, start_jax
from vrw_jax.base.results import Outcome
from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.branches.continuation import continue_branch
from vrw_jax.branches.special_point_curves import SPECIAL_POINT_MEASURES
from vrw_jax.gaits.gait_search import limit_cycle, make_finder, resolve_model_with_reason
from vrw_jax.lanes.environment import find_library_version
from vrw_jax.models.ladder import list_model_config_names
from vrw_jax.models.measures import FORCE_PEAK_MEASURES
from vrw_jax.models.stepping import step
from vrw_jax.studies.first_passage import first_passage
from vrw_jax.studies.robustness import gait_sensitivity
from vrw_jax.studies.scan_design import require_map_grid
from vrw_jax.studies.scan_execution import follow_special_points
from vrw_jax.wheel.params import WheelParams

MAX_OPTION_INTEGER = 10**9
"""Largest integer that an option accepts, chosen because no scan has more samples."""

SENSITIVITY_NORM_MEASURES = ("period", "speed")
"""Measures whose gait sensitivity norms `vrw robustness` prints."""

FolderOption = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Folder for the result; results/NAME of the config by default. FILE.pdf, FILE.svg or "
        "FILE.png is the file of the figure, and the data are then in results/NAME.",
    ),
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
    signal.signal(signal.SIGINT, _handle_first_interrupt)
    show_warnings_as_sentences()
    replace_unencodable_output()
    if (
        not printing.stderr_console.is_terminal
    ):  # Standard error of commands contains only messages.
        os.environ.setdefault(PROGRESS_VARIABLE, "0")
    with printing.report_stdout_errors():
        app()


def _handle_first_interrupt(_signal: int, _frame: object) -> None:
    """End the command in the regular way after the first Ctrl-C.

    A second Ctrl-C ends the process immediately.
    """

    def end_process(_signal: int, _frame: object) -> None:
        os.write(2, b"vrw: stopped at once; run the same to go on.\n")
        os._exit(ExitCode.INTERRUPTED)

    signal.signal(signal.SIGINT, end_process)
    raise KeyboardInterrupt


def _print_version_and_exit(is_version_requested: bool) -> None:
    if is_version_requested:
        print(f"vrw {find_library_version('vrw-jax')}")
        raise typer.Exit


@app.callback()
def configure_root_command(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version_and_exit, is_eager=True, help="Show the version."
        ),
    ] = False,
) -> None:
    """Simulate the passive viscoelastic-legged rimless wheel: walk, scan, tune, follow branches.

    [bold]Examples[/bold]

      [cyan]vrw init[/cyan]                              write the example configs named here

      [cyan]vrw gait[/cyan]                              the wheel of Table 1 of the paper

      [cyan]vrw gait --set damping=150[/cyan]            the same with weaker dampers

      [cyan]vrw reproduce --out paper[/cyan]             all figures and the table of facts

      [cyan]vrw scan configs/quickstart.toml[/cyan]      4,096 steady gaits, a dataset and figures

      [cyan]vrw robustness configs/robustness.toml[/cyan]   mean steps until failure, random slopes

      [cyan]vrw tune configs/tune_dls.toml[/cyan]        the most double support without scuffing

      [cyan]vrw continue configs/branch_damping.toml[/cyan]   a branch of gaits with special points

      [cyan]vrw new my_walker[/cyan]                     a skeleton of your own walker

    [bold]Files[/bold]   init: configs. new: two Python files. gait: none. reproduce: figures and
    tables. scan: scan.zarr (open it with vrw_jax.open_scan or xarray.open_zarr), pictures, PNG and
    SVG, and figures.json.
    map: map.zarr, map.csv, map.md and a picture.
    tune: path.zarr, a picture, tuning.md, and wheel.toml, a config of vrw gait.
    continue: branch.zarr, borders.csv, a picture and branch.md.

    The first run of a command compiles for some seconds. The compiled code is stored in a cache
    folder (JAX_COMPILATION_CACHE_DIR names another), so later runs start quickly. Angles are in
    rad, and all other quantities are in SI units.
    """


@app.command("gait")
def run_gait_command(
    config: Annotated[
        Path | None, typer.Argument(help="TOML file; by default the wheel of Table 1.")
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Change a parameter; may be repeated."),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, max=MAX_OPTION_INTEGER, help="Number of steps to walk.")
    ] = None,
) -> None:
    """Walk a wheel and print its gait: durations, speed, indicators, force peaks and margins.

    The walk begins near the gait of Table 1 of the paper, or at the start in the config. The
    command then finds the limit cycle of the wheel. With rigid legs or unilateral contact and a
    start in the config, this is the limit cycle near the end of the walk. With unilateral contact
    and no start, it is the slowest attracting gait. The command writes no file. The exit code is 1
    if no limit cycle is found.

    [bold]Examples[/bold]

      vrw gait --set damping=150 --set slope=0.28

      vrw gait configs/table1.toml --steps 50
    """
    with report_command_errors():
        gait_config, params = _load_config_and_wheel(config, changes)
        model: Any = gait_config.make_model()
        gait_model: Any
        gait_model, model_selection_reason = resolve_model_with_reason(params, model)
        options = gait_config.make_options()
        section_state = gait_config.gait.make_start(params, model)
        n_steps_walked, n_steps = 0, steps or gait_config.gait.steps
        models_of_legs = model.list_models_of_legs()
        while True:
            if n_steps_walked % model.leg_period == 0:
                guess = section_state
            model_of_leg = models_of_legs[n_steps_walked % model.leg_period]
            step_result: Any = step(params, section_state, model=model_of_leg, options=options)
            has_stepped = int(step_result.outcome) == Outcome.STEPPED
            n_steps_walked += has_stepped
            if not has_stepped or n_steps_walked == n_steps:
                break
            section_state = step_result.section_state
        finder = make_finder(gait_model, params.n_legs, period_n=model.leg_period)
        limit_cycle_result: Any = limit_cycle(
            params,
            guess=None if gait_config.gait.start is None or finder.supports_cold_start else guess,
            period_n=model.leg_period,
            model=gait_model,
            options=options if isinstance(options, finder.options_type) else None,
        )
        force_peaks: dict[str, Any] = {}
        missing_force_peaks_reason = ""
        if gait_model.is_compliant and limit_cycle_result.found:
            try:
                force_peaks = limit_cycle_result.measures(FORCE_PEAK_MEASURES)
            except ValueError as error:  # for unilateral contact without machine code
                missing_force_peaks_reason = str(error)
        printing.print_wheel_and_gait(
            params, step_result, section_state, n_steps_walked, limit_cycle_result, force_peaks
        )
        for gait_remark in filter(None, (missing_force_peaks_reason, model_selection_reason)):
            stdout_console.print(gait_remark)
        if not limit_cycle_result.found:
            raise typer.Exit(ExitCode.CHECK_FAILED)


@app.command("explore")
def run_explore_command(
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Initial parameter; may be repeated."),
    ] = None,
    model_name: Annotated[
        str, typer.Option("--model", help="viscoelastic, rigid or unilateral.")
    ] = "viscoelastic",
) -> None:
    """Open an interactive page of the wheel in your browser. The browser computes the steps."""
    with report_command_errors():
        _, params = _load_config_and_wheel(None, changes)
        page_address = make_page_address(params, model_name)
        webbrowser.open(page_address)
        print(page_address)


@app.command("init")
def run_init_command(
    folder: Annotated[Path, typer.Argument(help="Folder for the configs.")] = Path("configs"),
) -> None:
    """Write example configs, from which you can derive your own.

    The command does not change existing files. If an existing file differs from its example, the
    command names the file and writes nothing.
    """
    with report_command_errors():
        folder = check_path("the folder", folder, "give a folder")
        example_folder = find_example_config_folder()
        example_config_texts = {
            config_path.name: config_path.read_text(encoding="utf-8")
            for config_path in example_folder.glob("*.toml")
        }
        missing_config_paths = []
        for config_name, config_text in sorted(example_config_texts.items()):
            config_path = folder / config_name
            if not config_path.exists():
                missing_config_paths.append(config_path)
            elif config_path.read_text(encoding="utf-8-sig", errors="replace") != config_text:
                raise ValueError(
                    f"{config_path} is there already and differs: give another folder."
                )
        require_writable_folder(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for config_path in missing_config_paths:
            config_path.write_text(example_config_texts[config_path.name], encoding="utf-8")
        printing.print_written_paths(missing_config_paths)
        if not missing_config_paths:
            stdout_console.print(f"{folder} has them all: nothing to write.", highlight=False)


SKELETON_NAME = "my_walker"
"""Name of the walker in the folder `new` of the example configs."""


@app.command("new")
def run_new_command(
    name: Annotated[str, typer.Argument(help="Name of the walker, as my_walker.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder for the two files.")] = Path("."),
) -> None:
    """Write the skeleton of a walker of your own, NAME.py, with its test, test_NAME.py.

    The skeleton is a hopping leg that passes its test: replace its physics by your own. Existing
    files are never overwritten.
    """
    with report_command_errors():
        if not name.isidentifier() or keyword.iskeyword(name):
            raise ValueError(
                f"the name is {name!r}, but it is the name of a Python file that others import: "
                "give letters, digits and underscores, as my_walker."
            )
        is_dunder = name.startswith("__")  # as __main__, whose specification does not exist
        if (
            is_dunder
            or name in sys.stdlib_module_names
            or importlib.util.find_spec(name) is not None
        ):
            raise ValueError(
                f"{name} is the name of an installed module or of Python: give another name."
            )
        folder = check_path("--out", folder, "give a folder")
        skeleton_folder = find_example_config_folder() / "new"
        texts = {
            folder / skeleton.name.replace(SKELETON_NAME, name): skeleton.read_text("utf-8")
            for skeleton in sorted(skeleton_folder.glob("*.py"))
        }
        skeleton_names = {
            token.string
            for text in texts.values()
            for token in tokenize.generate_tokens(io.StringIO(text).readline)
        }
        if name in skeleton_names - {SKELETON_NAME}:
            raise ValueError(
                f"{name} is a name in the skeleton itself, which would hide the module: give "
                "another name."
            )
        for path in texts:
            if path.exists():
                raise ValueError(f"{path} is there already: give another name or --out FOLDER.")
        require_writable_folder(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in texts.items():
            path.write_text(text.replace(SKELETON_NAME, name), encoding="utf-8")
        printing.print_written_paths(list(texts))


def find_example_config_folder() -> Path:
    """Return the folder of the example configs, which is in the installed package or next to it."""
    package_folder = Path(__file__).parents[1]
    candidate_folders = (package_folder / "configs", package_folder.parent / "configs")
    return next(filter(Path.is_dir, candidate_folders))


@app.command("reproduce")
def run_reproduce_command(
    folder: Annotated[
        Path, typer.Option("--out", help="Folder for the figures and the table.")
    ] = Path("results/reproduction"),
) -> None:
    """Reproduce the paper: figures 6 to 10, and every published fact with the computed value.

    The command prints the table of facts. It writes figures, and the table with tolerances and
    their reasons. The exit code is 1 if a fact does not hold.
    """
    with report_command_errors():
        _start_jax_and_load_config(None)
        folder = check_path("--out", folder, "give a folder")
        if is_figure_file(folder):
            raise ValueError(
                f"--out is {folder}, but this command writes several figures: give a folder."
            )
        require_writable_folder(folder, draws_figure=True)
    from vrw_jax.app.paper_reproduction import reproduce_paper

    with (
        report_command_errors(f"stopped; what is done stays in {folder}."),
        printing.make_progress_bar("reproducing the paper") as progress_bar,
    ):
        progress_task = progress_bar.add_task("starting", total=1.0)
        paper_facts = reproduce_paper(
            folder,
            on_progress=lambda progress_fraction, stage_description: progress_bar.update(
                progress_task, completed=progress_fraction, description=stage_description
            ),
        )
    with report_command_errors():
        printing.print_paper_facts(paper_facts, folder)
    if not all(paper_fact.holds for paper_fact in paper_facts):
        raise typer.Exit(ExitCode.CHECK_FAILED)


@app.command("scan")
def run_scan_command(
    config: Annotated[Path, typer.Argument(help="TOML file with the samples and measures.")],
    folder: FolderOption = None,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain", help="Only print sizes, and memory and time estimated from some samples."
        ),
    ] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Only print whether the store is complete and intact.")
    ] = False,
    chunk: Annotated[
        int | None,
        typer.Option(
            min=1, max=MAX_OPTION_INTEGER, help="Number of samples in a chunk of the store."
        ),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Address of a dask cluster; 'local' starts a cluster on this machine.",
        ),
    ] = None,
    picture: PictureOption = True,
) -> None:
    """Find the steady gait of every sample of a design, with its outcome and margins.

    The command writes scan.zarr and figures (PNG and SVG) into the folder. After an interruption,
    the same command continues where it stopped, and the data are bitwise the same. For a finished
    scan, the command computes only chunks with damaged files again, and draws only figures that are
    missing or out of date. The exit code is 1 if --verify finds damage.

    [bold]Examples[/bold]

      vrw scan configs/quickstart.toml --explain

      vrw scan configs/quickstart.toml --out results/first

      vrw scan configs/quickstart.toml --dask tcp://host:8786
    """
    with report_command_errors():
        scan_config, folder = _load_config_with_table(config, folder, "design", "scan")
        scan_plan, store_path = scanning.plan_config_scan(scan_config, chunk), folder / "scan.zarr"
        if explain:
            with show_computation_stages(
                "measuring some samples (the first time compiles for a while)"
            ):
                forecast_texts = forecast_scan(scan_plan, store_path) | {"store": str(store_path)}
            printing.print_text_table("What this scan would do", forecast_texts.items())
            return
        if verify:
            scanning.verify_scan_store(scan_plan, store_path)
            return
        has_figures = (folder / scanning.FIGURE_RECORD_NAME).exists()
        require_writable_output(scan_config, folder, picture, tests_backend=not has_figures)
    scan_dataset = scanning.compute_scan_with_progress(scan_plan, store_path, dask)
    with report_command_errors(f"stopped; the data are in {store_path}."):
        printing.print_outcome_counts(scan_dataset)
        stdout_console.print(f"data: {store_path}", highlight=False, soft_wrap=True)
        if picture:
            scanning.draw_scan_figures(scan_dataset, store_path, scan_config.figures)


@app.command("robustness")
def run_robustness_command(
    config: Annotated[Path, typer.Argument(help=r"TOML file with slope_sd in its table \[scan].")],
    folder: FolderOption = None,
    picture: PictureOption = True,
) -> None:
    """Compute the mean number of steps until failure on random slopes, and gait sensitivities.

    If the config has no design, the command prints the results for one wheel and writes no file. If
    it has a grid or samples, the command computes one sample after the other, and writes scan.zarr
    and figures (PNG and SVG) into the folder. After an interruption, the same command continues
    where it stopped. Without a design, the exit code is 1 if the wheel has no gait.

    [bold]Examples[/bold]

      vrw robustness configs/robustness.toml
    """
    with report_command_errors():
        robustness_config = _start_jax_and_load_config(config)
        slope_sd = robustness_config.scan.slope_sd
        if slope_sd is None:
            raise ValueError(
                f"{config.name}: [scan] has no slope_sd, the standard deviation of the slopes: "
                "write slope_sd = 0.01, in rad, say."
            )
        if robustness_config.design is None:
            params = robustness_config.make_wheel()
            model: Any = resolve_model_with_reason(params, robustness_config.make_model())[0]
            finder = make_finder(model, params.n_legs, period_n=model.leg_period)
            has_options = bool(robustness_config.step_option_values)
            options = robustness_config.make_options() if has_options else None
            sensitivity_result = gait_sensitivity(
                params,
                SENSITIVITY_NORM_MEASURES,
                model=model,
                options=options if isinstance(options, finder.options_type) else None,
            )
            print(first_passage(params, slope_sd, model=model, options=options))
            print(sensitivity_result)
            return
    run_scan_command(config, folder, picture=picture)


@app.command("map")
def run_map_command(
    config: Annotated[Path, typer.Argument(help="TOML file with a grid over two parameters.")],
    folder: FolderOption = None,
) -> None:
    """Draw all special points of gaits over two parameters: `vrw map configs/map_c_k.toml`."""
    with report_command_errors():
        special_point_map_config, folder = _load_config_with_table(config, folder, "design", "map")

        scan_plan = scanning.plan_config_scan(
            special_point_map_config, None, SPECIAL_POINT_MEASURES
        )
        require_map_grid(scan_plan.design)
        require_writable_output(special_point_map_config, folder, draws_figure=True)
    scan_dataset = scanning.compute_scan_with_progress(scan_plan, folder / "map.zarr", None)

    with (
        report_command_errors(),
        show_computation_stages(
            "following special points (the first time compiles for minutes)"
        ) as stage_reporter,
    ):
        special_point_map = follow_special_points(
            scan_dataset,
            special_point_map_config.make_wheel(),
            special_point_map_config.make_model(),
            stage_reporter,
        )
        stage_reporter("drawing the map")
        written_paths = write_special_point_map(
            special_point_map, folder, special_point_map_config.figures
        )
    printing.print_written_paths(written_paths)


@app.command("tune")
def run_tune_command(
    config: Annotated[Path, typer.Argument(help="TOML file with objective, bounds, constraints.")],
    folder: FolderOption = None,
    picture: PictureOption = True,
) -> None:
    """Tune a wheel: find the best gait within bounds that satisfies its constraints.

    The optimization follows the branch of gaits with exact gradients. A walk of the tuned wheel
    then validates the result. The command writes path.zarr (every evaluated gait), tuning.md,
    wheel.toml (the tuned wheel) and figures (PNG and SVG) into the folder. The exit code is 1 if
    the run does not end at an optimum. It is also 1 if the start has no gait; nothing is then
    written.

    [bold]Examples[/bold]

      vrw tune configs/tune_dls.toml

      vrw tune configs/tune_stability.toml --out results/steady

      vrw gait results/steady/wheel.toml
    """
    with report_command_errors():
        command_config, folder = _load_config_with_table(config, folder, "tune", "tune")
        tune_config = command_config.tune
        assert tune_config is not None
        require_writable_output(command_config, folder, picture)

        tune_result = tune_config.tune_wheel(
            command_config.make_wheel(),
            model=command_config.make_model(),
            options=command_config.make_options(),
        )
        printing.print_text_table("Tuned gait", tune_result.describe().items())
        printing.print_written_paths(
            write_tuning_report(tune_result, folder, command_config, draws_figure=picture)
        )
    if not tune_result.converged:
        print_error_sentence(
            f"this is no optimum ({tune_result.status.name}): what was reached is written."
        )
        raise typer.Exit(ExitCode.CHECK_FAILED)


@app.command("continue")
def run_continue_command(
    config: Annotated[Path, typer.Argument(help=r"TOML file with a table \[branch].")],
    folder: FolderOption = None,
    picture: PictureOption = True,
) -> None:
    """Continue a branch of stable and unstable gaits along a parameter, with its special points.

    The command writes branch.zarr (open it with xarray.open_zarr), borders.csv, branch.md and
    figures (PNG and SVG) into the folder. If there is no gait to start from, the exit code is 1 and
    the command writes nothing.

    [bold]Examples[/bold]

      vrw continue configs/branch_damping.toml

      vrw continue configs/branch_damping.toml --out results/along_c --no-picture
    """
    with report_command_errors():
        command_config, folder = _load_config_with_table(config, folder, "branch", "branch")
        branch_config = command_config.branch
        assert branch_config is not None
        require_writable_output(command_config, folder, picture)

        arclength_options = ArclengthOptions()
        if branch_config.max_ds is not None:
            initial_ds = min(arclength_options.initial_ds, branch_config.max_ds)
            arclength_options = ArclengthOptions(initial_ds=initial_ds, max_ds=branch_config.max_ds)
        branch = continue_branch(
            command_config.make_wheel(),
            branch_config.parameter,
            branch_config.bounds,
            period_n=branch_config.period,
            model=command_config.make_model(),
            options=arclength_options,
            step_options=replace(StepOptions.tight(), **command_config.step_option_values),
        )
        if not branch.values.size:
            print_error_sentence(
                f"there is no gait to start from ({branch.outcome.name}: "
                f"{branch.outcome.meaning[:-1]}): give a wheel that walks, such as that of Table 1."
            )
            raise typer.Exit(ExitCode.CHECK_FAILED)
        stdout_console.print(str(branch), highlight=False, markup=False)
        printing.print_written_paths(
            write_branch_report(branch, folder, command_config.figures if picture else None)
        )


def _start_jax_and_load_config(config_path: Path | None) -> Config:
    """Start JAX, and return the config in the file `config_path`, or the default config for
    None.
    """
    start_jax()
    if jax.config.jax_disable_jit:  # type: ignore[attr-defined]
        # Commands would run for hours.
        raise ValueError(
            "JAX_DISABLE_JIT is set, but commands compute with compiled code: unset it."
        )
    return Config() if config_path is None else load_config(config_path)


def _load_config_and_wheel(
    config_path: Path | None, changes: list[str] | None
) -> tuple[Config, WheelParams]:
    """Start JAX, and return a config with its wheel, changed by assignments such as
    "damping=150".
    """
    command_config = _start_jax_and_load_config(config_path)
    return command_config, command_config.make_wheel(parse_assignments(changes or []))


MISSING_CONFIG_TABLE_MESSAGES = {
    "design": "has no samples, but a scan needs a design: add a table [grid], [samples], [sobol], "
    "[uniform] or [saltelli], as in configs/quickstart.toml of `vrw init`.",
    "tune": "seeks nothing, but tuning needs an objective and bounds: add the tables [tune] and "
    "[tune.bounds], as in configs/tune_dls.toml of `vrw init`.",
    "branch": "names no branch, but continuation needs a parameter and bounds: add a table "
    "[branch], as in configs/branch_damping.toml of `vrw init`.",
}
"""Error messages for a config without the table that a command needs, by name of the table."""


def _load_config_with_table(
    config_path: Path, result_folder: Path | None, table_name: str, command_name: str
) -> tuple[Config, Path]:
    """Load a config, and return it with the folder for the results.

    If `result_folder` is the file of a figure, the config contains this file. Raise a ValueError if
    the config lacks the table that the command needs, or if the command does not support the model.
    """
    command_config = _start_jax_and_load_config(config_path)
    if getattr(command_config, table_name) is None:
        raise ValueError(f"{command_config.file_name} {MISSING_CONFIG_TABLE_MESSAGES[table_name]}")
    supported_models = list_model_config_names(command_name)
    if command_config.model_name not in supported_models:
        raise ValueError(
            f"{command_config.file_name} names the model {command_config.model_name}, but this "
            f"command takes {', '.join(supported_models)}: write "
            f"{'one of these' if len(supported_models) > 1 else 'that'} below [model]."
        )
    if result_folder is not None:
        result_folder = check_path("--out", result_folder, "give a folder")
    if result_folder is not None and is_figure_file(result_folder):
        figure_config = replace(command_config.figures, file=result_folder)
        command_config, result_folder = replace(command_config, figures=figure_config), None
    return command_config, result_folder or Path("results") / config_path.stem
