"""Output of commands: tables, progress, and one sentence for a user's mistake."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    import xarray as xr
    from jax.typing import ArrayLike
    from rich.progress import Progress as Bar

    from vrw_jax.cycles import LimitCycle, WalkedCycle
    from vrw_jax.models import AbstractStep, StepResult
    from vrw_jax.paper import Fact
    from vrw_jax.scans import Progress
    from vrw_jax.wheel import WheelParams

USER_ERROR, INTERRUPTED = 2, 130
"""Exit codes of a user's mistake and of a Ctrl-C."""

out, err = Console(), Console(stderr=True)
"""Consoles of stdout and stderr."""


@contextlib.contextmanager
def sentences(stopped: str = "stopped; nothing was written.") -> Iterator[None]:
    """Report an error in one sentence on stderr with exit code 2, and a Ctrl-C with 130."""
    try:
        yield
    except KeyboardInterrupt:
        complain(stopped)
        raise typer.Exit(INTERRUPTED) from None
    except MemoryError as error:
        complain("this asks for more memory than there is: give smaller designs, or fewer at once.")
        raise typer.Exit(USER_ERROR) from error
    except (ValueError, OSError) as error:
        complain(str(error) if isinstance(error, ValueError) else _of_system(error))
        raise typer.Exit(USER_ERROR) from error


def complain(sentence: str) -> None:
    """Print a sentence about an error on stderr."""
    err.print(f"[bold red]vrw:[/] {escape(sentence)}", highlight=False, soft_wrap=True)


def _of_system(error: OSError) -> str:
    """Return the sentence about an error of the system."""
    place = f"{error.filename}: " if error.filename else ""
    return f"{place}{str(error.strerror or error).rstrip('.')}."


def tell_written(paths: Iterable[Path]) -> None:
    """Print the paths of files that were written."""
    for path in paths:
        out.print(f"written: {path}", highlight=False, soft_wrap=True)


def tell_table(
    title: str | None,
    rows: Iterable[Sequence[str]],
    headings: Sequence[str] = (),
    right: Sequence[str] = (),
) -> None:
    """Print a table; columns in `right` are right-aligned, and without headings names are bold.

    Texts are printed literally, except that a column with the heading "" may contain color markup.
    """
    table = Table(title=title, title_justify="left", show_header=bool(headings), box=None)
    for heading in headings or ("name", "text"):
        table.add_column(heading, justify="right" if heading in right else "left")
    for row in rows:
        cells = [
            text if heading == "" else escape(text)
            for heading, text in zip(headings or ("name", "text"), row, strict=True)
        ]
        table.add_row(*(cells if headings else (f"[bold]{cells[0]}[/]", *cells[1:])))
    out.print(table)


def tell_facts(facts: "list[Fact]", folder: Path) -> None:
    """Print the table of facts and how many hold."""
    verdict = ("[bold red]does not hold[/]", "[green]holds[/]")
    tell_table(
        None,
        ((f.claim, f.where, f.published, f.found, verdict[f.holds]) for f in facts),
        ("fact", "where", "published", "found", ""),
    )
    from vrw_jax.paper import held

    out.print(f"{held(facts)}; see the figures and {folder / 'facts.md'}.")


def progress_bar(what: str) -> "Bar":
    """Return a progress bar on stderr; that of a scan counts samples and shows a note."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        *((MofNCompleteColumn(),) if what == "scan" else ()),
        TextColumn("{task.fields[note]}") if what == "scan" else TimeElapsedColumn(),
    )
    return Bar(*columns, console=err)


def scan_reporter(update: Callable, task: int) -> Callable[["Progress"], None]:
    """Return the callback that shows rate, share without a gait and time left.

    The rate is measured from the second chunk on, because the first one includes compilation.
    """
    import time

    from vrw_jax.scans import in_words

    first: list[tuple[float, int]] = []

    def report(progress: "Progress") -> None:
        """Update the bar."""
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


def tell_outcomes(scan: "xr.Dataset") -> None:
    """Print the number of samples of a scan by outcome."""
    import numpy as np

    from vrw_jax.wheel import Outcome

    codes, counts = np.unique(scan.outcome.values, return_counts=True)
    ends = [Outcome(int(code)) for code in codes]
    tell_table(
        "Outcomes",
        (
            (f"{count:,}", f"{100 * count / counts.sum():.1f} %", end.name, end.meaning)
            for count, end in zip(counts, ends, strict=True)
        ),
        ("samples", "share", "outcome", "meaning"),
        ("samples", "share"),
    )


def tell_gait(
    params: "WheelParams",
    result: Any,  # the step of any model
    start: "ArrayLike | tuple[float, ...]",
    walked: int,
    cycle: "LimitCycle | WalkedCycle",
) -> None:
    """Print a wheel, the last step of its walk, from the state `start`, and its limit cycle."""
    import numpy as np

    from vrw_jax.wheel import DOMAINS, Outcome

    told = [f"{name} {float(getattr(params, name)):g} {d.unit}" for name, d in DOMAINS.items()]
    out.print("[bold]Wheel[/]  " + ", ".join(told) + f", {params.n_legs} legs")
    outcome = Outcome(int(result.outcome))
    if outcome == Outcome.STEPPED:
        change = float(np.abs(np.asarray(result.section_state) - np.asarray(start)).max())
        out.print(f"Walked {walked} steps; the last changed the section state by {change:.1e}.")
        _tell_step(result)
    else:
        out.print(f"[bold]Step {walked + 1} ended as {outcome.name}:[/] {outcome.meaning}")
    _tell_cycle(cycle)
    if outcome == Outcome.STEPPED and "lambda_4_plus" in result.measures():  # the paper's model
        _tell_premises(result)


def _tell_step(result: "AbstractStep") -> None:
    """Print the measures of a step."""
    from vrw_jax.results import MARGINS, MEASURES

    values = result.measures()
    rows = (
        (measure.long_name, measure.symbol, f"{float(values[name]):.5g}", measure.plain_unit)
        for name, measure in MEASURES.items()
        if name in values and name not in ("outcome", "solver_steps", *MARGINS)
    )
    tell_table("Last step", rows, ("quantity", "symbol", "value", "unit"), ("value",))


def _tell_cycle(cycle: "LimitCycle | WalkedCycle") -> None:
    """Print stability, period, speed and DLS fraction of a limit cycle."""
    import numpy as np

    from vrw_jax.cycles import multipliers_told
    from vrw_jax.wheel import Outcome

    if not bool(cycle.found):
        end = Outcome(int(cycle.outcome))
        out.print(f"[bold]Limit cycle[/]  {end.name}: {end.meaning}")
        return
    radius, multipliers = multipliers_told(np.asarray(cycle.matrix))
    verdict = "stable" if radius < 1.0 else "unstable"
    out.print(
        f"[bold]Limit cycle[/]  {verdict}: multipliers {multipliers}; period "
        f"{float(cycle.period):.5f} s, speed {float(cycle.speed):.5f} m/s, "
        f"DLS {100 * float(cycle.dls_fraction):.2f} %."
    )


def _tell_premises(result: "StepResult") -> None:
    """Print the margins of a step."""
    import numpy as np

    from vrw_jax.results import MARGINS

    rows = []
    for name, measure in MARGINS.items():
        values = np.atleast_1d(np.asarray(getattr(result.monitors, name)))
        least, where = float(values.min()), measure.long_name
        mark = "[green]holds[/]" if least >= 0.0 else "[bold red]broken[/]"
        if measure.axis and least < 0.0:
            legs = [str(leg + 3) for leg in np.flatnonzero(values < 0.0)]
            where += f" (broken at legs {', '.join(legs)})"
        rows.append((mark, where, measure.symbol, f"{least:.4g}", measure.plain_unit))
    headings = ("", "margin of", "symbol", "least", "unit")
    tell_table("Premises of the paper's rung", rows, headings, ("least",))
    n, broken = len(rows), sum("broken[" in mark for mark, *_ in rows)
    out.print(
        f"{n - broken} of {n} premises hold, {broken} are broken. The rung walks on regardless: "
        "it measures what it does not model."
    )
