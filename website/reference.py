"""Pages that are generated from the sources: keys of a config, and every measure."""

import dataclasses
import json
import re
from collections.abc import Iterable
from typing import Any

from vrw_jax.app.config import (
    DESIGN_TABLE_NAMES,
    FIELDS_WITHOUT_KEY,
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
    PASSAGE_MEASURES,
    STEP_MEASURES,
    STOPPER_MARGIN_MEASURES,
    TRAJECTORY_MEASURES,
    UNILATERAL_STEP_MEASURES,
    Measure,
)
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
        "Parameters that are the same in all samples. Missing keys have the values of Table 1.",
    )
    wheel = [(f"`{n}`", d.symbol, f"{_DEFAULTS[n]:g}", d.unit, str(d).split(")")[0] + ")",
              d.description) for n, d in PARAMETER_DOMAINS.items()]  # fmt: skip
    wheel.append(("`n_legs`", "n", "8", "", "5 and more", "number of legs, a whole number"))
    header = ("key", "symbol", "default", "unit", "allowed", "meaning")
    lines += format_markdown_table(header, wheel)
    lines += _section(
        "model", "The model and its settings, which [Models](models.md) describes further."
    )
    model_names = list_model_config_names()
    choices = ", ".join(f'`"{name}"`' for name in model_names)
    keys_by_model: dict[tuple[str, str], dict[str, list[str]]] = {}
    for model_name in model_names:
        for key, default, text in _settings(MODEL_CLASSES[model_name]):
            keys = keys_by_model.setdefault((default, _shorten(text)), {})
            keys.setdefault(f"`{key}`", []).append(f'`"{model_name}"`')
    rows = [("`name`", "", '`"viscoelastic"`', f"one of {choices}")]
    rows += [
        (", ".join(keys), ", ".join(next(iter(keys.values()))), default, text)
        for (default, text), keys in keys_by_model.items()
    ]
    lines += format_markdown_table(("key", "model", "default", "meaning"), rows)
    for name, kind, what in _TABLES:
        shorten = _shorten if kind is StepOptions else str
        lines += _section(name, what)
        lines += format_markdown_table(
            _HEADER, [(f"`{n}`", v, shorten(text)) for n, v, text in _settings(kind)]
        )
    lines += ["", "## Designs", "", _ON_DESIGNS, ""]
    designs = [(f"`[{name}]`", _DESIGNS[name]) for name in DESIGN_TABLE_NAMES]
    lines += format_markdown_table(("table", "design"), designs)
    return "\n".join(lines) + "\n"


_OPENING = """# Keys of a config

A config is a TOML file for `vrw gait`, `scan`, `continue` and `tune`. `vrw init` writes examples.
An unknown key, or a value outside its domain, raises an error before the computation starts.
"""
_HEADER = ("key", "default", "meaning")
_DEFAULTS = {name: float(getattr(WheelParams(), name)) for name in PARAMETER_DOMAINS}
_TABLES = (
    (
        "options",
        StepOptions,
        "Numerical options of a step, as in [`StepOptions`](walking.md). `vrw continue` has "
        "tolerances of 1e-13 by default.",
    ),
    ("gait", GaitConfig, "The walk of `vrw gait`."),
    (
        "scan",
        ScanConfig,
        "Measures and options of `vrw scan`. A separate table contains the design.",
    ),
    ("branch", BranchConfig, "The branch of `vrw continue`."),
    (
        "tune",
        TuneConfig,
        "Objective, bounds and constraints of `vrw tune`.",
    ),
    ("figures", FigureConfig, "Width and files of figures."),
)
_DESIGNS = {
    "grid": "every combination of the values of each parameter: `parameter = [1.0, 2.0]` lists "
    "values, and `parameter = { from = 1.0, to = 2.0, count = 5 }` defines equally spaced ones",
    "samples": "one sample per position in lists of equal length, `parameter = [1.0, 2.0]`",
    "sobol": "`n` samples from a scrambled Sobol' sequence, with `n` a power of two",
    "uniform": "`n` independent samples",
    "saltelli": "`n` groups of samples for `sobol_indices`, with `n` a power of two, at least 64 "
    "for a figure of the indices",
}
_ON_DESIGNS = (
    "A config has at most one design. The parameters are those of `[wheel]`, and `friction` for "
    "models with friction. In designs with `n`, `parameter = [lower, upper]` is the range of each "
    "parameter, and `seed = 0` selects the sequence."
)


def _shorten(description: str) -> str:
    """Return the first sentence, or all of a description that contains the values of the field."""
    return description if '"' in description else description.partition(". ")[0]


def _section(name: str, *paragraphs: str) -> list[str]:
    return ["", f"## `[{name}]`", *(line for text in paragraphs for line in ("", text)), ""]


def _settings(settings_class: Any) -> Iterable[tuple[str, str, str]]:
    """Yield name, default and meaning of each field of a settings class."""
    descriptions = describe_fields(settings_class)
    for field in dataclasses.fields(settings_class):
        if field.name in FIELDS_WITHOUT_KEY:
            continue
        yield field.name, _format_default(field), descriptions.get(field.name, "")


def _format_default(field: dataclasses.Field[Any]) -> str:
    """Return the default as TOML writes it; an empty text if there is none."""
    value = field.default
    if value is dataclasses.MISSING or value is None:
        return ""
    return f"`{json.dumps(list(value) if isinstance(value, tuple) else value)}`"


def measures_page() -> str:
    """Return the page of every measure of `vrw.MEASURES`."""
    lines = [_ON_MEASURES]
    for title, table, what in _GROUPS:
        lines += ["", f"## {title}", "", what, ""]
        rows = [
            (f"`{m.name}`", f"${m.mathtext.strip()}$" + f" [{m.unit}]" * bool(m.display_unit),
             _meaning(m)) for m in table.values()
        ]  # fmt: skip
        lines += format_markdown_table(("name", "symbol [unit]", "meaning"), rows)
    return "\n".join(lines) + "\n"


_ON_MEASURES = """# Measures

Every quantity has one name, symbol and unit in all results and figures:
`vrw.MEASURES["speed"].unit`. Scans and tuning accept measures of steps and cycles, and margins.
Scans also accept derivatives of measures of cycles, as in `"d speed / d damping"`. Numbers in
brackets and sections are those of the paper. [Parameters](toml.md#wheel) have their own table.
"""
_GROUPS = (
    ("Of a step", STEP_MEASURES,
        "Scans and `vrw.step` report these measures, and gaits some of them."),
    ("Margins", MARGIN_MEASURES, "A margin is positive if its condition "
        "holds. `step.margins` and scans contain these margins."),
    ("Of a step with unilateral contact", UNILATERAL_STEP_MEASURES, "Steps with unilateral "
        "contact also report these measures."),
    ("Margins of stoppers with unilateral contact", STOPPER_MARGIN_MEASURES,
        "Steps with stoppers that hold legs in the air report these margins."),
    ("Of a gait", LIMIT_CYCLE_MEASURES | GAIT_SENSITIVITY_MEASURES,
        "Limit cycles report these measures."),
    ("Of the force in a gait", FORCE_PEAK_MEASURES, "Limit cycles, except those of rigid "
        "legs, report these measures. `vrw.force_peaks` returns all but the impulse for walks."),
    ("Of walks over random slopes", PASSAGE_MEASURES,
        "Scans with `slope_sd` compute these measures."),
    ("Of a trajectory", TRAJECTORY_MEASURES,
        "Coordinates and variables of the result of `vrw.simulate`."),
    ("Of a trajectory with unilateral contact", CONTACT_MEASURES,
        "Variables of each leg in the result of `vrw.simulate`."),
)  # fmt: skip


def _meaning(measure: Measure) -> str:
    """Return the description, after the long name where it refers to that or says less."""
    text = measure.description
    if measure.violation_text and "egative if" not in text:
        text += f" Below zero: {measure.violation_text}."
    words = set(re.findall(r"[^ ().,]+", measure.long_name.lower())) - _LITTLE_WORDS
    known = set(re.findall(r"[^ ().,_]+", f"{measure.name} {text}".lower()))
    if "its" in known or "that" in known or len(words - known) > len(words) / 4:
        text = f"{measure.long_name[0].upper()}{measure.long_name[1:]}. {text}"
    return f"{text} {measure.equation}".rstrip()


_LITTLE_WORDS = {"a", "at", "by", "from", "in", "of", "the", "to"}
