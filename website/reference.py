"""Pages that are told by the sources: what a config may hold, and every measure."""

import dataclasses
import json
import re
from collections.abc import Iterable
from typing import Any

from vrw_jax.cli.config import (
    MODEL_CLASSES,
    RANDOM_DESIGNS,
    BranchConfig,
    GaitConfig,
    ScanConfig,
    TuneConfig,
)
from vrw_jax.measures.table import (
    CONTACT_MEASURES,
    LIMIT_CYCLE_MEASURES,
    MARGIN_MEASURES,
    PARAMETER_MEASURES,
    STEP_MEASURES,
    TRAJECTORY_MEASURES,
    UNILATERAL_STEP_MEASURES,
    Measure,
)
from vrw_jax.numerics import StepOptions
from vrw_jax.printing import format_markdown_table
from vrw_jax.scans import design as designs
from vrw_jax.wheel import PARAMETER_DOMAINS, WheelParams

FIELD = re.compile(r"^ *- ((?:`\w+`(?:, )?)+): (.*(?:\n +[^ -].*)*)", re.MULTILINE)


def fields_told(kind: type) -> dict[str, str]:
    """What the list in a class's docstring says of each field."""
    told = {}
    for names, text in FIELD.findall(kind.__doc__ or ""):
        told |= dict.fromkeys(re.findall(r"`(\w+)`", names), " ".join(text.split()).rstrip(";."))
    return told


def toml_page() -> str:
    """Every table and key of a config."""
    lines = [_OPENING]
    lines += _section("wheel", "What is not swept; what is left out has the value of Table 1.")
    wheel = [(f"`{n}`", f"{_DEFAULTS[n]:g}", d.unit, str(d).split(")")[0] + ")", d.description)
             for n, d in PARAMETER_DOMAINS.items()]  # fmt: skip
    wheel.append(("`n_legs`", "8", "", "5 and more", "number of legs, a whole number"))
    lines += format_markdown_table(("key", "default", "unit", "allowed", "meaning"), wheel)
    lines += _section("model", "Which rung of the ladder, and its settings.")
    rungs = ", ".join(f'`"{rung}"`' for rung in MODEL_CLASSES)
    rows = [("`rung`", "", '`"viscoelastic"`', f"one of {rungs}")]
    for rung, kind in MODEL_CLASSES.items():
        rows += [(f"`{n}`", f'`"{rung}"`', v, text) for n, v, text in _settings(kind)]
    lines += format_markdown_table(("key", "of the rung", "default", "meaning"), rows)
    for name, kind, what in _TABLES:
        lines += _section(name, what)
        lines += format_markdown_table(
            _HEADER, [(f"`{n}`", v, text) for n, v, text in _settings(kind)]
        )
    lines += _section("grid", _first_line(designs.grid), *_GRID)
    lines += _section("samples", _first_line(designs.samples), *_SAMPLES)
    for name, design in RANDOM_DESIGNS.items():
        lines += _section(name, _first_line(design), *_DRAWN_KEYS)
    return "\n".join(lines) + "\n"


_OPENING = """# Keys of a config

A config is a TOML file for `vrw gait`, `scan`, `continue` and `tune`. `vrw init` writes examples. A
key that is none, or a value out of its domain, is refused in one sentence before anything is
computed. This page is told by the sources.
"""
_HEADER = ("key", "default", "meaning")
_DEFAULTS = {name: float(getattr(WheelParams(), name)) for name in PARAMETER_DOMAINS}
_TABLES = (
    ("options", StepOptions, "Numerical choices of a step."),
    ("gait", GaitConfig, "How `vrw gait` walks."),
    ("scan", ScanConfig, "What `vrw scan` reports; the design stands in a table of its own."),
    ("branch", BranchConfig, "What `vrw continue` follows."),
    ("tune", TuneConfig, "What `vrw tune` seeks."),
)
_GRID = (
    "`parameter = [1.0, 2.0]` lists values, `parameter = { from = 1.0, to = 2.0, count = 5 }` "
    "spaces them evenly. Parameters are those of `[wheel]`; `friction` too, where motion feels it. "
    "A config has one design at most.",
)
_SAMPLES = ("`parameter = [1.0, 2.0]`: lists of one length, a sample for each place.",)
_DRAWN_KEYS = (
    "`n = 512`: samples (rows, for `saltelli`), a power of two; `seed = 0`, which sequence; "
    "`parameter = [lower, upper]` for each that is drawn.",
)


def _section(name: str, *paragraphs: str) -> list[str]:
    return ["", f"## `[{name}]`", *(line for text in paragraphs for line in ("", text)), ""]


def _settings(kind: Any) -> Iterable[tuple[str, str, str]]:
    """Name, default and meaning of each field of a settings class."""
    told = fields_told(kind)
    for name, field in kind.__dataclass_fields__.items():
        yield name, _shown(field), told.get(name, "")


def _shown(field: dataclasses.Field[Any]) -> str:
    """The default as TOML would write it; nothing where there is none."""
    value = field.default
    if value is dataclasses.MISSING or value is None:
        return ""
    return f"`{json.dumps(list(value) if isinstance(value, tuple) else value)}`"


def _first_line(function: Any) -> str:
    return str(function.__doc__).split("\n\n")[0].strip()


def measures_page() -> str:
    """Every measure of `vrw.MEASURES`."""
    lines = [_ON_MEASURES]
    for title, table, what in _GROUPS:
        lines += ["", f"## {title}", "", what, ""]
        rows = [
            (f"`{m.name}`", f"${m.mathtext.strip()}$", m.unit, _meaning(m), m.equation)
            for m in table.values()
        ]
        lines += format_markdown_table(("name", "symbol", "unit", "meaning", "in the paper"), rows)
    return "\n".join(lines) + "\n"


_ON_MEASURES = """# Measures

Every quantity has one name, symbol and unit, in steps, cycles, trajectories, scans, branches and
figures alike: `vrw.MEASURES["speed"].unit`. Scans and tuning take the names of steps, margins and
cycles, and scans derivatives too, as `"d speed / d damping"`. This page is generated from the
sources.
"""
_GROUPS = (
    ("Of a step", STEP_MEASURES, "Measures of `vrw.step`, gaits and scans."),
    ("Margins", MARGIN_MEASURES, "Positive while the condition holds: "
        "`step.margins`, scans."),
    ("Of a step with unilateral contact", UNILATERAL_STEP_MEASURES, "Beside those of a step "
        "that every model has."),
    ("Of a gait", LIMIT_CYCLE_MEASURES, "Of a limit cycle."),
    ("Of a trajectory", TRAJECTORY_MEASURES, "Coordinates and variables of `vrw.simulate`."),
    ("Of a trajectory with unilateral contact", CONTACT_MEASURES, "Variables of each leg."),
    ("Parameters", PARAMETER_MEASURES, "Axes of scans and branches."),
)  # fmt: skip


def _meaning(measure: Measure) -> str:
    breaks = f" Below zero: {measure.violation}." if measure.violation else ""
    return f"{measure.long_name[0].upper()}{measure.long_name[1:]}. {measure.description}{breaks}"
