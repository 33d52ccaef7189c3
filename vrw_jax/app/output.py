"""Output of commands: text in the terminal, error messages, and files in a folder."""

import codecs
import contextlib
import csv
import enum
import importlib
import io
import itertools
import json
import os
import sys
import tempfile
import time
import tomllib
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer
from jax.typing import ArrayLike
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from vrw_jax.app.config import Config, FigureConfig
from vrw_jax.base.progress import PROGRESS_VARIABLE
from vrw_jax.base.results import NoGaitError, Outcome, format_markdown_table
from vrw_jax.base.results import xarray as xr
from vrw_jax.branches.branch import Branch
from vrw_jax.gaits.cycle import format_floquet_multipliers
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.gaits.wheel_finders import ReturnMapCycle
from vrw_jax.models.measures import MARGIN_MEASURES, MEASURES, describe_violation, get_measure
from vrw_jax.models.step_results import StepResult
from vrw_jax.studies.measure_catalog import DIFFERENTIABLE_MEASURES
from vrw_jax.studies.scan_execution import ScanProgress, SpecialPointMap
from vrw_jax.studies.tuning import TuneResult
from vrw_jax.wheel.params import PARAMETER_DOMAINS, PARAMETER_NAMES, WheelParams

if TYPE_CHECKING:
    from vrw_jax.app.paper_evidence import PaperFact


ENCODING_ERROR_HANDLER_NAME = "vrw_spell"
"""Name of the handler for encoding errors, chosen because no other library uses it."""

ASCII_REPLACEMENTS = {
    "α": "alpha", "θ": "theta", "κ": "kappa", "λ": "lambda", "μ": "mu", "ρ": "rho", "σ": "sigma",
    "φ": "phi", "Δ": "Delta ", "∂": "d", "\u0307": "'", "\u0308": "''", "²": "^2", "ᵀ": "^T",
    "·": ".", "−": "-", "→": "->", "≤": "<=", "≥": ">=", "≈": "~", "±": "+-", "’": "'",
    "“": '"', "”": '"', "§": "section ",
}  # fmt: skip
"""ASCII replacements for the other characters that commands print."""


def replace_unencodable_output() -> None:
    """Replace, in standard output and standard error, characters that the stream's encoding
    lacks.
    """
    codecs.register_error(ENCODING_ERROR_HANDLER_NAME, _handle_encoding_error)
    for output_stream in (sys.stdout, sys.stderr):
        if isinstance(output_stream, io.TextIOWrapper):
            output_stream.reconfigure(errors=ENCODING_ERROR_HANDLER_NAME)


def replace_unencodable_characters(printed_text: str, encoding_name: str) -> str:
    """Return a text in which all characters that the encoding lacks are replaced."""
    codecs.register_error(ENCODING_ERROR_HANDLER_NAME, _handle_encoding_error)
    return printed_text.encode(encoding_name, ENCODING_ERROR_HANDLER_NAME).decode(encoding_name)


def _handle_encoding_error(encoding_error: UnicodeError) -> tuple[str, int]:
    """Return the replacement for characters that an encoding lacks, and the index after them."""
    if not isinstance(encoding_error, UnicodeEncodeError):
        raise encoding_error
    return "".join(
        map(_replace_with_ascii, encoding_error.object[encoding_error.start : encoding_error.end])
    ), encoding_error.end


def _replace_with_ascii(unencodable_character: str) -> str:
    if unencodable_character.isascii() or unencodable_character in ASCII_REPLACEMENTS:
        return ASCII_REPLACEMENTS.get(unencodable_character, unencodable_character)
    decomposed_characters = unicodedata.normalize("NFKD", unencodable_character)
    if decomposed_characters == unencodable_character:
        return "" if unicodedata.combining(unencodable_character) else "?"
    return "".join(map(_replace_with_ascii, decomposed_characters))


class ExitCode(enum.IntEnum):
    """Exit codes of the command line other than 0, which means success."""

    CHECK_FAILED = 1  # A fact does not hold, a run has no result, or a store is damaged.
    USER_ERROR = 2
    INTERRUPTED = 130


stdout_console = Console()
stderr_console = Console(stderr=True)


@contextlib.contextmanager
def report_command_errors(
    interruption_message: str = "stopped; nothing was written.",
) -> Iterator[None]:
    """Return a context manager that handles errors in a command.

    It prints an error in one sentence and ends the command with exit code 2. The exit code is 1 if
    there is no gait, and 130 after Ctrl-C.
    """
    try:
        yield
    except KeyboardInterrupt:
        print_error_sentence(interruption_message)
        raise typer.Exit(ExitCode.INTERRUPTED) from None
    except MemoryError as command_error:
        print_error_sentence(
            "this asks for more memory than there is: give smaller designs, or fewer at once."
        )
        raise typer.Exit(ExitCode.USER_ERROR) from command_error
    except NoGaitError as command_error:
        print_error_sentence(str(command_error))
        raise typer.Exit(ExitCode.CHECK_FAILED) from command_error
    except ValueError as command_error:
        print_error_sentence(str(command_error))
        raise typer.Exit(ExitCode.USER_ERROR) from command_error
    except OSError as command_error:
        print_error_sentence(_format_system_error(command_error))
        raise typer.Exit(ExitCode.USER_ERROR) from command_error


@contextlib.contextmanager
def report_stdout_errors() -> Iterator[None]:
    """Return a context manager that handles errors of standard output.

    If standard output is not writable, the command ends with exit code 2.
    """
    exit_code: Any = 0
    try:
        try:
            yield
        except SystemExit as system_exit:
            exit_code = system_exit.code
        sys.stdout.flush()
    except OSError as stdout_error:
        # Python would still write the rest of the output when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        # A broken pipe has been closed by its reader on purpose.
        if not isinstance(stdout_error, BrokenPipeError):
            print_error_sentence(
                f"standard output can't be written: {_format_system_error(stdout_error)}"
            )
        exit_code = ExitCode.USER_ERROR
    raise SystemExit(exit_code)


def print_error_sentence(error_sentence: str) -> None:
    """Print an error message on standard error."""
    stderr_console.print(
        f"[bold red]vrw:[/] {escape(error_sentence)}", highlight=False, soft_wrap=True
    )


def show_warnings_as_sentences() -> None:
    """Print the library's warnings as sentences, without their location in the source code."""
    default_show_warning = warnings.showwarning

    def show_warning(
        message: Warning | str, category: type[Warning], filename: str, *args: Any, **kwargs: Any
    ) -> None:
        if category is UserWarning and Path(filename).is_relative_to(Path(__file__).parents[1]):
            print_error_sentence(str(message))
        else:
            default_show_warning(message, category, filename, *args, **kwargs)

    warnings.showwarning = show_warning


def _format_system_error(system_error: OSError) -> str:
    file_name_text = f"{system_error.filename}: " if system_error.filename else ""
    return f"{file_name_text}{str(system_error.strerror or system_error).rstrip('.')}."


@contextlib.contextmanager
def show_computation_stages(first_stage_name: str) -> Iterator[Callable[[str], None]]:
    """Show the stage and the duration of a computation, and yield a function that sets the next
    stage.

    If stderr is not a terminal, each stage is printed on one line.
    """
    if not stderr_console.is_terminal:
        yield lambda stage_name: stderr_console.print(
            f"{stage_name} ...", highlight=False, soft_wrap=True
        )
        return
    with make_progress_bar("stages") as progress_bar:
        progress_task = progress_bar.add_task(first_stage_name, total=None)
        yield lambda stage_name: progress_bar.update(progress_task, description=stage_name)


def print_written_paths(paths: Iterable[Path]) -> None:
    """Print the paths of written files."""
    for written_path in paths:
        stdout_console.print(f"written: {written_path}", highlight=False, soft_wrap=True)


def print_text_table(
    table_title: str | None,
    table_rows: Iterable[Sequence[str]],
    column_headings: Sequence[str] = (),
    right_aligned_headings: Sequence[str] = (),
) -> None:
    """Print a table. If it has no headings, the first column is bold.

    Texts are printed literally, except in a column with the heading "", which may contain color
    markup.
    """
    rich_table = Table(
        title=table_title, title_justify="left", show_header=bool(column_headings), box=None
    )
    table_headings = column_headings or ("name", "text")
    for column_heading in table_headings:
        rich_table.add_column(
            column_heading,
            justify="right" if column_heading in right_aligned_headings else "left",
            style=None if column_headings or column_heading != "name" else "bold",
        )
    for row_cells in table_rows:
        cell_texts = [
            replace_unencodable_characters(cell_text, stdout_console.encoding)
            for cell_text in row_cells
        ]
        rich_table.add_row(
            *(
                cell_text if column_heading == "" else escape(cell_text)
                for column_heading, cell_text in zip(table_headings, cell_texts, strict=True)
            )
        )
    stdout_console.print(rich_table)


def print_paper_facts(paper_facts: "list[PaperFact]", folder: Path) -> None:
    """Print the table of facts, and how many facts hold."""
    verdict_texts = ("[bold red]does not hold[/]", "[green]holds[/]")
    print_text_table(
        None,
        (
            (
                paper_fact.claim,
                paper_fact.source,
                paper_fact.published_value,
                paper_fact.computed,
                verdict_texts[paper_fact.holds],
            )
            for paper_fact in paper_facts
        ),
        ("fact", "where", "published", "found", ""),
    )
    from vrw_jax.app.paper_reproduction import summarize_paper_facts

    stdout_console.print(
        f"{summarize_paper_facts(paper_facts)}; see the figures and {folder / 'facts.md'}."
    )


def make_progress_bar(task_name: str) -> Progress:
    """Return a progress bar on standard error. The bar for a scan counts samples and shows a
    note.
    """
    last_columns = (
        (MofNCompleteColumn(), TextColumn("{task.fields[note]}"))
        if task_name == "scan"
        else (TimeElapsedColumn(),)
    )
    os.environ[PROGRESS_VARIABLE] = "0"  # The bar replaces the notices of the library.
    task_columns = (TextColumn("{task.description}"), BarColumn(), *last_columns)
    return Progress(*task_columns, console=stderr_console)


def make_scan_progress_reporter(
    update_progress_bar: Callable, progress_task: int
) -> Callable[[ScanProgress], None]:
    """Return a function that shows the progress of a scan.

    It shows the rate, the fraction of samples without a gait, and the remaining time. The rate is
    measured from the second chunk on, because the first chunk includes compilation. The bar
    includes the samples of an earlier run; the rate and the fraction refer only to the present run.
    """
    times_and_counts: list[tuple[float, int]] = []

    def report_progress(scan_progress: ScanProgress) -> None:
        current_seconds, n_samples_done = time.monotonic(), scan_progress.n_done
        progress_bar_note = (
            f"{scan_progress.n_reused:,} from an earlier run" if scan_progress.n_reused else ""
        )
        if n_samples_done:
            times_and_counts.append((current_seconds, n_samples_done))
            first_report_seconds, n_samples_at_first_report = times_and_counts[0]
            progress_bar_note = (
                f"{100 * scan_progress.n_failed / n_samples_done:.0f} % without a gait"
            )
            if current_seconds > first_report_seconds:
                samples_per_second = (n_samples_done - n_samples_at_first_report) / (
                    current_seconds - first_report_seconds
                )
                remaining_seconds = (scan_progress.n_samples - n_samples_done) / samples_per_second
                progress_bar_note = (
                    f"{samples_per_second:,.0f} per s, {progress_bar_note}, "
                    f"{format_duration(remaining_seconds)} left"
                )
        update_progress_bar(
            progress_task,
            total=scan_progress.n_reused + scan_progress.n_samples,
            completed=scan_progress.n_reused + n_samples_done,
            description="scanning" if n_samples_done else "compiling",
            note=progress_bar_note,
        )

    return report_progress


def print_outcome_counts(scan_dataset: "xr.Dataset") -> None:
    """Print the number of samples for each outcome of a scan."""
    outcome_codes, n_samples_by_code = np.unique(scan_dataset.outcome.values, return_counts=True)
    outcomes = map(Outcome, outcome_codes.tolist())
    print_text_table(
        "Outcomes",
        (
            (
                f"{n_samples:,}",
                f"{100 * n_samples / n_samples_by_code.sum():.1f} %",
                outcome.name,
                outcome.meaning,
            )
            for n_samples, outcome in zip(n_samples_by_code, outcomes, strict=True)
        ),
        ("samples", "share", "outcome", "meaning"),
        ("samples", "share"),
    )


def print_wheel_and_gait(
    params: WheelParams,
    step_result: Any,  # `step_result` is the step of any model.
    start_state: ArrayLike,
    n_steps_walked: int,
    limit_cycle_result: LimitCycle | ReturnMapCycle,
    force_peaks: Mapping[str, Any],
) -> None:
    """Print a wheel, the last step of its walk, its limit cycle and the force peaks of the gait.

    `start_state` is the section state at the start of the last step.
    """
    parameter_texts = [
        f"{parameter_name} {float(getattr(params, parameter_name)):g} {parameter_domain.unit}"
        for parameter_name, parameter_domain in PARAMETER_DOMAINS.items()
    ]
    stdout_console.print(
        "[bold]Wheel[/]  " + ", ".join(parameter_texts) + f", {params.n_legs} legs"
    )
    step_outcome = Outcome(int(step_result.outcome))
    if step_outcome == Outcome.STEPPED:
        last_state_change = float(
            np.abs(np.asarray(step_result.section_state) - np.asarray(start_state)).max()
        )
        stdout_console.print(
            f"Walked {n_steps_walked} steps; the last changed the section state by "
            f"{last_state_change:.1e}."
        )
        shown_measures = dict(step_result.measures())
        for measure_name in ("outcome", "solver_steps", *MARGIN_MEASURES):
            shown_measures.pop(measure_name, None)
        _print_measure_table("Last step", shown_measures)
    else:
        stdout_console.print(
            f"[bold]Step {n_steps_walked + 1} ended as {step_outcome.name}:[/] "
            f"{step_outcome.meaning}"
        )
    if limit_cycle_result.found:
        spectral_radius, multiplier_texts = format_floquet_multipliers(
            np.asarray(limit_cycle_result.monodromy_value)
        )
        stdout_console.print(
            f"[bold]Limit cycle[/]  {'stable' if spectral_radius < 1.0 else 'unstable'}: "
            f"multipliers {multiplier_texts}; period {float(limit_cycle_result.period):.5f} s, "
            f"speed {float(limit_cycle_result.speed):.5f} m/s, DLS "
            f"{100 * float(limit_cycle_result.dls_fraction):.2f} %."
        )
    else:
        search_outcome = Outcome(int(limit_cycle_result.outcome))
        stdout_console.print(
            f"[bold]Limit cycle[/]  {search_outcome.name}: {search_outcome.meaning}"
        )
    if force_peaks:
        _print_measure_table("Force in the gait", force_peaks)
    # This is a cycle of the paper's model.
    if step_outcome == Outcome.STEPPED and "lambda_4_plus" in step_result.measures():
        _print_step_margins(step_result)


def _print_measure_table(table_title: str, measure_values: Mapping[str, Any]) -> None:
    measure_table_rows = (
        (
            measure_description.long_name,
            measure_description.symbol,
            f"{float(measure_values[measure_name]):.5g}",
            measure_description.display_unit,
        )
        for measure_name, measure_description in MEASURES.items()
        if measure_name in measure_values
    )
    print_text_table(
        table_title, measure_table_rows, ("quantity", "symbol", "value", "unit"), ("value",)
    )


def _print_step_margins(step_result: StepResult) -> None:
    """Print the margins of a step, and whether each of them holds."""
    margin_table_rows, n_violated_margins = [], 0
    for margin_name, margin_description in MARGIN_MEASURES.items():
        margin_values = np.atleast_1d(np.asarray(getattr(step_result.margins, margin_name)))
        lowest_margin, margin_label = float(margin_values.min()), margin_description.long_name
        is_violated = lowest_margin < 0.0
        n_violated_margins += is_violated
        if margin_description.leg_dimension and is_violated:
            violating_legs = np.flatnonzero(margin_values < 0.0) + 3
            margin_label += f" (broken at legs {', '.join(map(str, violating_legs))})"
        margin_table_rows.append(
            (
                "[bold red]broken[/]" if is_violated else "[green]holds[/]",
                margin_label,
                margin_description.symbol,
                f"{lowest_margin:.4g}",
                margin_description.display_unit,
            )
        )
    column_headings = ("", "margin of", "symbol", "least", "unit")
    print_text_table("Margins of the paper's model", margin_table_rows, column_headings, ("least",))
    n_margins = len(margin_table_rows)
    stdout_console.print(
        f"{n_margins - n_violated_margins} of {n_margins} margins hold, {n_violated_margins} are "
        "broken. The model walks on regardless: it measures what it does not model."
    )


def require_writable_folder(folder: Path, draws_figure: bool = False) -> None:
    """Raise a ValueError if the folder is not writable, or if figures are to be drawn and the
    requested matplotlib backend does not exist. No folder is created.
    """
    existing_folder = next(filter(Path.exists, (folder, *folder.parents)))
    try:
        with tempfile.TemporaryDirectory(dir=existing_folder):
            pass
    except OSError as write_error:
        raise ValueError(
            f"nothing can be written to {folder} ({write_error.strerror}): give a place of your "
            "own."
        ) from write_error
    if not draws_figure:
        return
    try:
        importlib.import_module("vrw_jax.plot")
    except ValueError as backend_error:
        raise ValueError(
            f"MPLBACKEND is {os.environ.get('MPLBACKEND')!r}, which matplotlib doesn't know: unset "
            "it, or set it to agg."
        ) from backend_error


def require_writable_output(
    command_config: Config, folder: Path, draws_figure: bool, tests_backend: bool = True
) -> None:
    """Raise a ValueError if a command cannot write its results or figures."""
    require_writable_folder(folder, draws_figure and tests_backend)
    if (figure_file := command_config.figures.file) is not None:
        if not draws_figure:
            raise ValueError(
                f"--no-picture is given, but the figure {figure_file} is asked for: drop one of "
                "the two."
            )
        if figure_file.is_dir():
            raise ValueError(
                f"{figure_file} is a folder, but the figure is written to a file of this name: "
                "give another name."
            )
        require_writable_folder(figure_file.parent)


def write_figures(
    figure_by_name: Mapping[str, Any], folder: Path, figure_config: FigureConfig
) -> list[Path]:
    """Write figures into `folder`, or to the file of the config, and return the paths."""
    from vrw_jax import plot

    has_one_figure = len(figure_by_name) == 1
    return [
        figure_path
        for figure_name, figure in figure_by_name.items()
        for path in figure_config.list_files(figure_name, folder, has_one_figure)
        for figure_path in plot.save(figure, path.parent, path.name)
    ]


def write_tuning_report(
    tune_result: TuneResult, folder: Path, config: Config, draws_figure: bool = True
) -> list[Path]:
    """Write the data, summary, config and figure for a tuned gait into `folder`, and return the
    paths. The written config has the tables `[model]` and `[options]` of `config`, with tuned
    values.
    """
    from vrw_jax import plot

    toml_lines = [
        f"# Tuned: {tune_result.objective} {tune_result.value:.6g}. Walk it with `vrw gait`.",
        "",
        "[wheel]",
    ]
    for parameter_name in PARAMETER_NAMES:
        parameter_unit = PARAMETER_DOMAINS[parameter_name].unit
        parameter_value = float(getattr(tune_result.params, parameter_name))
        unit_comment = f" # {parameter_unit}" if parameter_unit else ""
        toml_lines.append(f"{parameter_name} = {parameter_value!r}{unit_comment}")
    toml_lines += [f"n_legs = {tune_result.params.n_legs}", ""]
    model, settings = tune_result.model, tomllib.loads(config.source_text)
    tables = {name: dict(settings[name]) for name in ("model", "options") if name in settings}
    for name in model.own_parameter_domains:
        value = float(model.get_parameter(tune_result.params, name))
        setting = name.replace("hub.torque", "hub_torque")
        if setting in tables.get("model", ()):
            tables["model"][setting] = value
        else:
            toml_lines += [f"# In the file of the law: {name} = {value!r}", ""]
    for name, table in tables.items():
        toml_lines += [f"[{name}]", *itertools.starmap(_format_setting, table.items()), ""]
    written_paths = _write_dataset_and_texts(
        folder,
        "path.zarr",
        tune_result.path,
        {"wheel.toml": "\n".join(toml_lines), "tuning.md": format_tuning_summary(tune_result)},
    )
    if draws_figure:
        figure = plot.tuning_figure(tune_result, width=config.figures.width)
        written_paths += write_figures({"tuning": figure}, folder, config.figures)
    return written_paths


def _format_setting(name: str, value: Any) -> str:
    """Return a line of TOML. Texts and truth values are written as in JSON."""
    if isinstance(value, str | bool):
        return f"{name} = {json.dumps(value, ensure_ascii=False)}"
    return f"{name} = {value!r}"


def write_branch_report(
    branch: Branch, folder: Path, figure_config: FigureConfig | None
) -> list[Path]:
    """Write the data, table, summary and figure for a branch into `folder`, and return the
    paths. No figure is drawn if `figure_config` is None.
    """
    from vrw_jax import plot

    csv_buffer = io.StringIO(newline="")
    csv_writer = csv.writer(csv_buffer)
    csv_writer.writerow([branch.parameter, "kind", "name", "ends_branch", "spectral_radius"])
    for special_point in branch.special_points:
        csv_writer.writerow(
            [
                f"{special_point.value:.12g}",
                special_point.kind,
                special_point.name,
                special_point.ends_branch,
                f"{special_point.point.spectral_radius:.9g}",
            ]
        )
    written_paths = _write_dataset_and_texts(
        folder,
        "branch.zarr",
        branch.dataset,
        {"borders.csv": csv_buffer.getvalue(), "branch.md": format_branch_summary(branch)},
    )
    if figure_config is not None and branch.values.size:
        figure = plot.branch_figure(branch, width=figure_config.width)
        written_paths += write_figures({"branch": figure}, folder, figure_config)
    return written_paths


def write_special_point_map(
    special_point_map: SpecialPointMap, folder: Path, figure_config: FigureConfig
) -> list[Path]:
    """Write the text, table and figure for a map of special points into `folder`.

    Return the paths.
    """
    from vrw_jax import plot

    scan_dataset, special_point_curves, _ = special_point_map
    csv_lines = [",".join(("border", *map(str, scan_dataset.outcome.dims)))]
    for special_point_curve in special_point_curves:
        csv_lines += [
            f"{special_point_curve.name},{x:.12g},{y:.12g}" for x, y in special_point_curve.values
        ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "map.csv").write_text("\n".join([*csv_lines, ""]), encoding="utf-8")
    (folder / "map.md").write_text(f"{special_point_map}\n", encoding="utf-8")
    measure_name = next(
        variable_name for variable_name in scan_dataset if variable_name in DIFFERENTIABLE_MEASURES
    )
    figure = plot.map_figure(
        scan_dataset, str(measure_name), special_point_curves, width=figure_config.width
    )
    figure_paths = write_figures({"map": figure}, folder, figure_config)
    return [folder / "map.csv", folder / "map.md", *figure_paths]


def _write_dataset_and_texts(
    folder: Path, store_name: str, dataset: "xr.Dataset", text_by_file_name: Mapping[str, str]
) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    dataset.to_zarr(folder / store_name, mode="w", zarr_format=2)
    for file_name, file_name_text in text_by_file_name.items():
        (folder / file_name).write_text(file_name_text, encoding="utf-8", newline="")
    return [folder / file_name for file_name in (store_name, *text_by_file_name)]


def format_tuning_summary(tune_result: TuneResult) -> str:
    """Return a Markdown summary of a tuning run."""
    active_constraint_rows = [
        (
            active_constraint.name,
            get_measure(active_constraint.name).format_with_unit(active_constraint.limit),
            active_constraint.describe_price(),
        )
        for active_constraint in tune_result.active
    ]
    parameter_table_rows = [
        (parameter_name, f"{float(tune_result.path[parameter_name][0]):.6g}",
        f"{float(getattr(tune_result.params, parameter_name)):.6g}",
         MEASURES[parameter_name].display_unit)
        for parameter_name in tune_result.path.free_parameter.values
    ]  # fmt: skip
    return "\n".join([
        f"# Tuned: {tune_result.objective}",
        "",
        *(f"- **{summary_label}**: {described_text}" for summary_label,
        described_text in tune_result.describe().items()),
        "",
        *format_markdown_table(("held by", "limit", "objective gained per unit given up"),
                     active_constraint_rows or [("nothing", "", "")]),
        "",
        f"First-order condition met to {tune_result.kkt_residual:.1e} of the objective's gradient.",
        "",
        *format_markdown_table(("parameter", "start", "tuned", "unit"), parameter_table_rows),
        "",
    ])  # fmt: skip


def format_branch_summary(branch: Branch) -> str:
    """Return a Markdown summary of a branch."""
    heading_line, *further_lines = str(branch).split("\n")
    summary_lines = [f"# Branch along {branch.parameter}", "", heading_line, ""]
    if not branch.values.size:
        return "\n".join(summary_lines)
    spectral_radius = branch.dataset.spectral_radius.values
    dls_fraction = branch.dataset.dls_fraction.values
    special_point_rows = []
    for special_point in branch.special_points:
        special_point_kind = special_point.kind.replace("_", " ")
        special_point_kind += " (ends the branch)" * special_point.ends_branch
        violation_text = describe_violation(special_point.name)
        special_point_rows.append(
            (f"{special_point.value:.9f}", special_point_kind, special_point.name, violation_text)
        )
    return "\n".join([
        *summary_lines,
        *(f"- {line.strip()}" for line in further_lines if line.startswith("  at ")),
        f"- spectral radius {spectral_radius.min():.4f} to {spectral_radius.max():.4f}, DLS "
        f"fraction {dls_fraction.min():.4f} to {dls_fraction.max():.4f}",
        f"- walked, every gait repeats within {np.max(branch.dataset.closure.values):.1e}",
        "",
        *format_markdown_table((branch.parameter, "kind", "name", "what happens there"),
        special_point_rows),
        "",
    ])  # fmt: skip


def format_duration(seconds: float) -> str:
    """Return a text that states a duration in s, min or h.

    - `seconds`: the duration, s.
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
