"""Pages that are generated from the sources: keys of a config, and every measure."""

import dataclasses
import inspect
import json
import re
from collections.abc import Iterable
from typing import Any

from vrw_jax.app.config import (
    RANDOM_DESIGN_FUNCTIONS,
    BranchConfig,
    FigureConfig,
    GaitConfig,
    ScanConfig,
    TuneConfig,
)
from vrw_jax.base import StepOptions, format_markdown_table
from vrw_jax.models import MODEL_CLASSES, list_model_config_names
from vrw_jax.models.measures import (
    CONTACT_MEASURES,
    FORCE_PEAK_MEASURES,
    GAIT_SENSITIVITY_MEASURES,
    LIMIT_CYCLE_MEASURES,
    MARGIN_MEASURES,
    PARAMETER_MEASURES,
    PASSAGE_MEASURES,
    STEP_MEASURES,
    STOPPER_MARGIN_MEASURES,
    TRAJECTORY_MEASURES,
    UNILATERAL_STEP_MEASURES,
    Measure,
)
from vrw_jax.studies import scan_design as designs
from vrw_jax.wheel import PARAMETER_DOMAINS, WheelParams

FIELD = re.compile(r"^ *- ((?:`\w+`(?:, )?)+): (.*(?:\n +[^ -].*)*)", re.MULTILINE)


def describe_fields(settings_class: type) -> dict[str, str]:
    """Return the description of each field from the list in a class's docstring."""
    descriptions = {}
    for names, text in FIELD.findall(settings_class.__doc__ or ""):
        descriptions |= dict.fromkeys(
            re.findall(r"`(\w+)`", names), " ".join(text.split()).rstrip(";.")
        )
    return descriptions


def toml_page() -> str:
    """Return the page of every table and key of a config."""
    lines = [_OPENING]
    lines += _section(
        "wheel",
        "The table `[wheel]` contains the parameters that are the same in all samples. Missing "
        "keys have the values of Table 1 of the paper.",
    )
    wheel = [(f"`{n}`", f"{_DEFAULTS[n]:g}", d.unit, str(d).split(")")[0] + ")", d.description)
             for n, d in PARAMETER_DOMAINS.items()]  # fmt: skip
    wheel.append(("`n_legs`", "8", "", "5 and more", "number of legs, a whole number"))
    lines += format_markdown_table(("key", "default", "unit", "allowed", "meaning"), wheel)
    lines += _section("model", "The table `[model]` contains the model and its settings.")
    model_names = list_model_config_names()
    choices = ", ".join(f'`"{name}"`' for name in model_names)
    rows = [("`name`", "", '`"viscoelastic"`', f"one of {choices}")]
    for model_name in model_names:
        rows += [
            (f"`{n}`", f'`"{model_name}"`', v, text)
            for n, v, text in _settings(MODEL_CLASSES[model_name])
        ]
    lines += format_markdown_table(("key", "model", "default", "meaning"), rows)
    for name, kind, what in _TABLES:
        lines += _section(name, what)
        lines += format_markdown_table(
            _HEADER, [(f"`{n}`", v, text) for n, v, text in _settings(kind)]
        )
    lines += _section("grid", _first_line(designs.grid), *_GRID)
    lines += _section("samples", _first_line(designs.samples), *_SAMPLES)
    for name, design in RANDOM_DESIGN_FUNCTIONS.items():
        lines += _section(name, _first_line(design), *_DRAWN_KEYS)
    return "\n".join(lines) + "\n"


_OPENING = """# Keys of a config

A config is a TOML file for `vrw gait`, `scan`, `continue` and `tune`. `vrw init` writes examples.
An unknown key, or a value outside its domain, raises an error before the computation
starts. `python -m website --pages` generates this page from the sources.
"""
_HEADER = ("key", "default", "meaning")
_DEFAULTS = {name: float(getattr(WheelParams(), name)) for name in PARAMETER_DOMAINS}
_TABLES = (
    ("options", StepOptions, "The table `[options]` contains the numerical options of a step."),
    ("gait", GaitConfig, "The table `[gait]` contains the options for the walk by `vrw gait`."),
    (
        "scan",
        ScanConfig,
        "The table `[scan]` lists the measures that `vrw scan` computes, and contains the options "
        "of the scan. A separate table contains the design.",
    ),
    ("branch", BranchConfig, "The table `[branch]` defines the branch of `vrw continue`."),
    (
        "tune",
        TuneConfig,
        "The table `[tune]` contains the objective, bounds and constraints of `vrw tune`.",
    ),
    ("figures", FigureConfig, "The table `[figures]` contains the width and files of figures."),
)
_GRID = (
    "`parameter = [1.0, 2.0]` lists values, and `parameter = { from = 1.0, to = 2.0, count = 5 }` "
    "defines equally spaced values. The parameters are those of `[wheel]`, and `friction` for "
    "models with friction. A config has at most one design.",
)
_SAMPLES = (
    "`parameter = [1.0, 2.0]` lists values. All lists have equal length and one sample per index.",
)
_DRAWN_KEYS = (
    "`n = 512` is the number of samples, a power of two (for `saltelli`, the number of groups of "
    "samples). `seed = 0` selects the sequence. `parameter = [lower, upper]` is the range of each "
    "parameter.",
)


def _section(name: str, *paragraphs: str) -> list[str]:
    return ["", f"## `[{name}]`", *(line for text in paragraphs for line in ("", text)), ""]


def _settings(settings_class: Any) -> Iterable[tuple[str, str, str]]:
    """Yield name, default and meaning of each field of a settings class."""
    descriptions = describe_fields(settings_class)
    for field in dataclasses.fields(settings_class):
        yield field.name, _format_default(field), descriptions.get(field.name, "")


def _format_default(field: dataclasses.Field[Any]) -> str:
    """Return the default as TOML writes it; an empty text if there is none."""
    value = field.default
    if value is dataclasses.MISSING or value is None:
        return ""
    return f"`{json.dumps(list(value) if isinstance(value, tuple) else value)}`"


def _first_line(function: Any) -> str:
    return str(inspect.getdoc(function)).split("\n\n")[0]


def measures_page() -> str:
    """Return the page of every measure of `vrw.MEASURES`."""
    lines = [_ON_MEASURES]
    for title, table, what in _GROUPS:
        lines += ["", f"## {title}", "", what, ""]
        rows = [
            (f"`{m.name}`", f"${m.mathtext.strip()}$", m.unit, _meaning(m)) for m in table.values()
        ]
        lines += format_markdown_table(("name", "symbol", "unit", "meaning"), rows)
    return "\n".join(lines) + "\n"


_ON_MEASURES = """# Measures

Every quantity has one name, symbol and unit in steps, cycles, trajectories, scans, branches and
figures: `vrw.MEASURES["speed"].unit`. Scans and tuning accept the names of measures of steps and
cycles, and of margins. Scans also accept derivatives of measures of cycles, as in
`"d speed / d damping"`.
`python -m website --pages` generates this page from the sources.
"""
_GROUPS = (
    ("Of a step", STEP_MEASURES,
        "Scans and `vrw.step` report the measures of this table. Gaits report some of them; "
        "`vrw.step` from the section state of a gait reports all."),
    ("Margins", MARGIN_MEASURES, "A margin is positive if its condition holds. "
        "`step.margins` and scans contain the margins of the table."),
    ("Of a step with unilateral contact", UNILATERAL_STEP_MEASURES, "Steps with unilateral "
        "contact report the measures of this table in addition to those of a step."),
    ("Margins of stoppers with unilateral contact", STOPPER_MARGIN_MEASURES,
        "Steps with stoppers that hold legs in the air report the margins of this table."),
    ("Of a gait", LIMIT_CYCLE_MEASURES | GAIT_SENSITIVITY_MEASURES,
        "The table lists measures that limit cycles report."),
    ("Of the force in a gait", FORCE_PEAK_MEASURES, "Limit cycles of the paper's model and "
        "limit cycles with unilateral contact report the measures of this table. Except for the "
        "impulse, `vrw.force_peaks` returns the same measures for walks."),
    ("Of walks over random slopes", PASSAGE_MEASURES,
        "Scans with `slope_sd` compute the measures of this table that are requested."),
    ("Of a trajectory", TRAJECTORY_MEASURES,
        "The table lists the coordinates and variables of the result of `vrw.simulate`."),
    ("Of a trajectory with unilateral contact", CONTACT_MEASURES,
        "With unilateral contact the result of `vrw.simulate` contains these variables of each "
        "leg."),
    ("Parameters", PARAMETER_MEASURES, "The parameters are the axes of scans and branches."),
)  # fmt: skip


def _meaning(measure: Measure) -> str:
    breaks = f" Below zero: {measure.violation_text}." if measure.violation_text else ""
    place = f" In the paper: {measure.equation}." if measure.equation else ""
    name = f"{measure.long_name[0].upper()}{measure.long_name[1:]}"
    return f"{name}. {measure.description}{breaks}{place}"
