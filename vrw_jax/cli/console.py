"""Output of commands: tables, progress, and one sentence about a user's mistake."""

import contextlib
import enum
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from vrw_jax.cli.encoding import format_for_encoding

if TYPE_CHECKING:
    import xarray as xr
    from jax.typing import ArrayLike
    from rich.progress import Progress as Bar

    from vrw_jax.cycles import LimitCycle, ReturnMapCycle
    from vrw_jax.models import AbstractStep, StepResult
    from vrw_jax.paper import Fact
    from vrw_jax.scans import ScanProgress
    from vrw_jax.wheel import WheelParams


class ExitCode(enum.IntEnum):
    """Exit code of the command line, besides 0 for success."""

    CHECK_FAILED = 1  # A fact does not hold, a run has no result, or a store is damaged.
    USER_ERROR = 2
    INTERRUPTED = 130


stdout_console = Console()
stderr_console = Console(stderr=True)


@contextlib.contextmanager
def report_errors(interruption_message: str = "stopped; nothing was written.") -> Iterator[None]:
    """Return a context that reports an error in one sentence with exit code 2, and a Ctrl-C with
    130.
    """
    try:
        yield
    except KeyboardInterrupt:
        print_error(interruption_message)
        raise typer.Exit(ExitCode.INTERRUPTED) from None
    except MemoryError as error:
        print_error(
            "this asks for more memory than there is: give smaller designs, or fewer at once."
        )
        raise typer.Exit(ExitCode.USER_ERROR) from error
    except (ValueError, OSError) as error:
        print_error(str(error) if isinstance(error, ValueError) else _format_system_error(error))
        raise typer.Exit(ExitCode.USER_ERROR) from error


@contextlib.contextmanager
def report_output_errors() -> Iterator[None]:
    """Return a context that reports, with exit code 2, that standard output cannot be written."""
    exit_code: Any = 0
    try:
        yield
    except SystemExit as end:
        exit_code = end.code
    except OSError as error:
        _abandon_output(error)
    try:
        sys.stdout.flush()
    except OSError as error:
        _abandon_output(error)
    raise SystemExit(exit_code)


def _abandon_output(error: OSError) -> None:
    """Discard the remaining output, which Python would write at the end, and exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not isinstance(error, BrokenPipeError):  # The reader has closed the pipe on purpose.
        print_error(f"standard output can't be written: {_format_system_error(error)}")
    raise SystemExit(ExitCode.USER_ERROR)


def print_error(sentence: str) -> None:
    """Print a sentence about an error on stderr."""
    stderr_console.print(f"[bold red]vrw:[/] {escape(sentence)}", highlight=False, soft_wrap=True)


def show_warnings_as_sentences() -> None:
    """Print the library's warnings as sentences, without their location in the code."""
    default_showwarning = warnings.showwarning

    def show_warning(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if category is UserWarning and Path(filename).is_relative_to(Path(__file__).parents[1]):
            print_error(str(message))
        else:
            default_showwarning(message, category, filename, lineno, file, line)

    warnings.showwarning = show_warning


def _format_system_error(error: OSError) -> str:
    """Return a sentence about an error of the operating system."""
    location = f"{error.filename}: " if error.filename else ""
    return f"{location}{str(error.strerror or error).rstrip('.')}."


@contextlib.contextmanager
def show_stages(first_stage: str) -> Iterator[Callable[[str], None]]:
    """Show the stage of a computation and its duration, and yield the function that sets the next
    stage.

    If stderr is no terminal, each stage that is passed to this function is printed as one line.
    """
    if not stderr_console.is_terminal:
        yield lambda stage: stderr_console.print(f"{stage} ...", highlight=False, soft_wrap=True)
        return
    with make_progress_bar("stages") as progress_bar:
        task = progress_bar.add_task(first_stage, total=None)
        yield lambda stage: progress_bar.update(task, description=stage)


def print_written_paths(paths: Iterable[Path]) -> None:
    """Print the paths of files that were written."""
    for path in paths:
        stdout_console.print(f"written: {path}", highlight=False, soft_wrap=True)


def print_table(
    title: str | None,
    rows: Iterable[Sequence[str]],
    headings: Sequence[str] = (),
    right_aligned: Sequence[str] = (),
) -> None:
    """Print a table; without headings the first column is bold.

    Texts are printed literally, except that a column with the heading "" may contain color markup.
    """
    table = Table(title=title, title_justify="left", show_header=bool(headings), box=None)
    for heading in headings or ("name", "text"):
        table.add_column(heading, justify="right" if heading in right_aligned else "left")
    for row in rows:
        texts = [format_for_encoding(text, stdout_console.encoding) for text in row]
        cells = [
            text if heading == "" else escape(text)
            for heading, text in zip(headings or ("name", "text"), texts, strict=True)
        ]
        table.add_row(*(cells if headings else (f"[bold]{cells[0]}[/]", *cells[1:])))
    stdout_console.print(table)


def print_facts(facts: "list[Fact]", folder: Path) -> None:
    """Print the table of facts and how many hold."""
    verdict_texts = ("[bold red]does not hold[/]", "[green]holds[/]")
    print_table(
        None,
        (
            (
                fact.claim,
                fact.source,
                fact.published_value,
                fact.computed,
                verdict_texts[fact.holds],
            )
            for fact in facts
        ),
        ("fact", "where", "published", "found", ""),
    )
    from vrw_jax.paper import summarize_facts

    stdout_console.print(f"{summarize_facts(facts)}; see the figures and {folder / 'facts.md'}.")


def make_progress_bar(task: str) -> "Bar":
    """Return a progress bar on stderr; the bar of a scan counts samples and shows a note."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        *((MofNCompleteColumn(),) if task == "scan" else ()),
        TextColumn("{task.fields[note]}") if task == "scan" else TimeElapsedColumn(),
    )
    return Bar(*columns, console=stderr_console)


def make_scan_reporter(update_bar: Callable, task: int) -> Callable[["ScanProgress"], None]:
    """Return the function that shows rate, fraction without a gait and remaining time of a scan.

    The rate is measured from the second chunk on, because the first one includes compilation. The
    bar includes the samples of an earlier run; rate and fraction are those of this run.
    """
    import time

    from vrw_jax.scans import format_seconds

    first_report: list[tuple[float, int]] = []

    def report(progress: "ScanProgress") -> None:
        """Update the bar."""
        time_now, n_done = time.monotonic(), progress.n_done
        bar_note = f"{progress.n_reused:,} from an earlier run" if progress.n_reused else ""
        if n_done:
            first_report.append((time_now, n_done))
            first_time, n_before = first_report[0]
            bar_note = f"{100 * progress.n_failed / n_done:.0f} % without a gait"
            if time_now > first_time:
                samples_per_second = (n_done - n_before) / (time_now - first_time)
                seconds_left = (progress.n_samples - n_done) / samples_per_second
                bar_note = (
                    f"{samples_per_second:,.0f} per s, {bar_note}, "
                    f"{format_seconds(seconds_left)} left"
                )
        update_bar(
            task,
            total=progress.n_reused + progress.n_samples,
            completed=progress.n_reused + n_done,
            description="scanning" if n_done else "compiling",
            note=bar_note,
        )

    return report


def print_outcomes(scan: "xr.Dataset") -> None:
    """Print the number of samples of a scan by outcome."""
    import numpy as np

    from vrw_jax.wheel import Outcome

    codes, count_by_code = np.unique(scan.outcome.values, return_counts=True)
    ending_texts = [Outcome(int(code)) for code in codes]
    print_table(
        "Outcomes",
        (
            (
                f"{count:,}",
                f"{100 * count / count_by_code.sum():.1f} %",
                ending_text.name,
                ending_text.meaning,
            )
            for count, ending_text in zip(count_by_code, ending_texts, strict=True)
        ),
        ("samples", "share", "outcome", "meaning"),
        ("samples", "share"),
    )


def print_gait(
    params: "WheelParams",
    result: Any,  # `result` is the step of any model.
    start: "ArrayLike | tuple[float, ...]",
    n_walked: int,
    cycle: "LimitCycle | ReturnMapCycle",
    peaks: "xr.Dataset | None",
) -> None:
    """Print a wheel, the last step of its walk, which began at the state `start`, its limit cycle,
    and the force peaks of the gait's first step.
    """
    import numpy as np

    from vrw_jax.wheel import PARAMETER_DOMAINS, Outcome

    parameter_texts = [
        f"{name} {float(getattr(params, name)):g} {difference.unit}"
        for name, difference in PARAMETER_DOMAINS.items()
    ]
    stdout_console.print(
        "[bold]Wheel[/]  " + ", ".join(parameter_texts) + f", {params.n_legs} legs"
    )
    outcome = Outcome(int(result.outcome))
    if outcome == Outcome.STEPPED:
        change = float(np.abs(np.asarray(result.section_state) - np.asarray(start)).max())
        stdout_console.print(
            f"Walked {n_walked} steps; the last changed the section state by {change:.1e}."
        )
        _print_step(result)
    else:
        stdout_console.print(
            f"[bold]Step {n_walked + 1} ended as {outcome.name}:[/] {outcome.meaning}"
        )
    _print_cycle(cycle)
    if peaks is not None:
        _print_measures("Force in the gait", {str(name): x.item() for name, x in peaks.items()})
    # This is a cycle of the paper's model.
    if outcome == Outcome.STEPPED and "lambda_4_plus" in result.measures():
        _print_margins(result)


def _print_step(result: "AbstractStep") -> None:
    """Print the measures of a step."""
    from vrw_jax.measures import MARGIN_MEASURES

    excluded = ("outcome", "solver_steps", *MARGIN_MEASURES)
    values = {name: value for name, value in result.measures().items() if name not in excluded}
    _print_measures("Last step", values)


def _print_measures(title: str, values: "Mapping[str, Any]") -> None:
    """Print a table of measures by name."""
    from vrw_jax.measures import MEASURES

    rows = (
        (measure.long_name, measure.symbol, f"{float(values[name]):.5g}", measure.display_unit)
        for name, measure in MEASURES.items()
        if name in values
    )
    print_table(title, rows, ("quantity", "symbol", "value", "unit"), ("value",))


def _print_cycle(cycle: "LimitCycle | ReturnMapCycle") -> None:
    """Print stability, period, speed and DLS fraction of a limit cycle."""
    import numpy as np

    from vrw_jax.cycles import format_multipliers
    from vrw_jax.wheel import Outcome

    if not bool(cycle.found):
        ending_text = Outcome(int(cycle.outcome))
        stdout_console.print(f"[bold]Limit cycle[/]  {ending_text.name}: {ending_text.meaning}")
        return
    spectral_radius, multipliers = format_multipliers(np.asarray(cycle.monodromy_value))
    stability_text = "stable" if spectral_radius < 1.0 else "unstable"
    stdout_console.print(
        f"[bold]Limit cycle[/]  {stability_text}: multipliers {multipliers}; period "
        f"{float(cycle.period):.5f} s, speed {float(cycle.speed):.5f} m/s, "
        f"DLS {100 * float(cycle.dls_fraction):.2f} %."
    )


def _print_margins(result: "StepResult") -> None:
    """Print the margins of a step."""
    import numpy as np

    from vrw_jax.measures import MARGIN_MEASURES

    rows = []
    for name, measure in MARGIN_MEASURES.items():
        values = np.atleast_1d(np.asarray(getattr(result.margins, name)))
        least_margin, label = float(values.min()), measure.long_name
        violation_mark = "[green]holds[/]" if least_margin >= 0.0 else "[bold red]broken[/]"
        if measure.dimension and least_margin < 0.0:
            legs = [str(leg + 3) for leg in np.flatnonzero(values < 0.0)]
            label += f" (broken at legs {', '.join(legs)})"
        rows.append(
            (violation_mark, label, measure.symbol, f"{least_margin:.4g}", measure.display_unit)
        )
    headings = ("", "margin of", "symbol", "least", "unit")
    print_table("Margins of the paper's model", rows, headings, ("least",))
    n_margins, n_violated = (
        len(rows),
        sum("broken[" in violation_mark for violation_mark, *_ in rows),
    )
    stdout_console.print(
        f"{n_margins - n_violated} of {n_margins} margins hold, {n_violated} are broken. The model "
        "walks on regardless: it measures what it does not model."
    )
