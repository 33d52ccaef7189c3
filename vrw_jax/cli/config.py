"""Configs: TOML files that define a wheel, samples and measures.

An error in a file is reported in one sentence: what was given, what is allowed and what to do.
"""

import contextlib
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from vrw_jax.hybrid import make_solver
from vrw_jax.models import AbstractWheel, GaitMethod
from vrw_jax.numerics import StepOptions
from vrw_jax.scans import (
    CATALOGS,
    MAX_LISTED_SAMPLES,
    TOLERANCE_CATALOG,
    add_passage_measures,
    check_measures,
)
from vrw_jax.scans import design as designs
from vrw_jax.selection import find_model_class, list_config_names
from vrw_jax.validation import check_known_name, check_range, format_value, suggest_name
from vrw_jax.wheel import (
    FRICTION_NAME,
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    WheelParams,
    check_parameter_name,
    parameter_sets,
    refuse_symbol,
)

RANDOM_DESIGNS = {"sobol": designs.sobol, "uniform": designs.uniform, "saltelli": designs.saltelli}
DESIGN_KINDS = ("grid", "samples", *RANDOM_DESIGNS)
TABLE_NAMES = ("wheel", "model", "options", "gait", "scan", "tune", "branch", *DESIGN_KINDS)
_OPTION_KEYS = tuple(StepOptions.__dataclass_fields__)
PARAMETER_SET_KEY = "parameter_set"
"""Key of `[wheel]` that names a set of parameters; the other keys of the table override its
values.
"""
_AXIS_KEYS = ("from", "to", "count")

MAX_CONFIG_INTEGER = 2**53
"""Largest integer of a config, chosen because floats represent all integers up to it."""

MAX_CONFIG_LEGS = 1_000
"""Largest number of legs of a config, chosen because results have a number for each leg of each
sample.
"""

RENAMED_KEYS = {
    "[model]": {"rung": "name"},
    "[options]": {
        "first_step": "dt0",
        "event_steps": "max_event_iterations",
        "monitor_steps": "max_margin_search_iterations",
    },
    "[branch]": {"largest_step": "max_ds"},
}
"""Old keys by table, with the present names that a config must use."""


@dataclass(frozen=True)
class ScanConfig:
    """Table `[scan]`: measures of a scan, and number of samples that are written at a time.

    - `measures`: names of measures and derivatives; by default DLS fraction, speed and the like;
    - `chunk`: number of samples that are written at a time; 4,096 by default;
    - `tol`: permitted error of each measure with unilateral contact (`name = "unilateral"`), in its
      unit. Each sample uses the simplest model that permits it;
    - `slope_sd`: standard deviation of random slopes, rad, for the measures of `vrw.first_passage`.
    """

    measures: tuple[str, ...] | None = None
    chunk: int | None = None
    tol: float | None = None
    slope_sd: float | None = None

    @classmethod
    def from_table(
        cls, table: Mapping[str, object], model_class: type[AbstractWheel]
    ) -> "ScanConfig":
        """Return the settings of `[scan]`; raise a ValueError if the model does not have a
        measure.
        """
        _require_known_keys(table, cls.__dataclass_fields__, "[scan]", "settings")
        measures = table.get("measures")
        slope_sd = table.get("slope_sd")
        if measures is not None:
            if not (
                isinstance(measures, list)
                and all(isinstance(measure_name, str) for measure_name in measures)
            ):
                requirement = 'a list of names: write measures = ["dls_fraction", "speed"]'
                raise _make_error("measures", measures, requirement)
            catalog = (
                CATALOGS.get(model_class.capabilities.gait_method, CATALOGS[GaitMethod.COLLOCATION])
                if "tol" not in table
                else TOLERANCE_CATALOG
            )
            if slope_sd is not None and "tol" not in table:
                catalog = add_passage_measures(catalog)
            check_measures(measures, catalog)
            measures = tuple(measures)
        chunk = table.get("chunk")
        tol = table.get("tol")
        return cls(
            measures,
            None if chunk is None else _parse_int(chunk, "chunk", 1),
            None if tol is None else _parse_number(tol, "tol", must_be_positive=True),
            None
            if slope_sd is None
            else _parse_number(slope_sd, "slope_sd", must_be_positive=True),
        )


@dataclass(frozen=True)
class GaitConfig:
    """Table `[gait]`: length and start of a walk.

    - `steps`: number of steps;
    - `start`: section state before the first touchdown, [rad, rad/s, m/s]; by default that of the
      model.
    """

    steps: int = 30
    start: tuple[float, float, float] | None = None

    @classmethod
    def from_table(cls, table: Mapping[str, object]) -> "GaitConfig":
        """Return the settings of `[gait]`."""
        _require_known_keys(table, cls.__dataclass_fields__, "[gait]", "settings")
        steps = _parse_int(table.get("steps", cls.steps), "steps", 1)
        start = table.get("start")
        if start is None:
            return cls(steps)
        if not (isinstance(start, list) and len(start) == 3):
            requirement = (
                "the section state before touchdown, three numbers: angle in rad, angular rate in "
            )
            raise _make_error("start", start, requirement + "rad/s, rate of Leg 1 in m/s")
        theta, dtheta, dL1 = (_parse_number(value, "start") for value in start)
        return cls(steps, (theta, dtheta, dL1))


@dataclass(frozen=True)
class TuneConfig:
    """Table `[tune]`: objective, bounds and constraints of a tuning run.

    - `objective`: a measure, or weights of several, { dls_fraction = 1.0, speed = 0.1 };
    - `bounds`: table [tune.bounds] of the free parameters, such as damping = [20.0, 215.0];
    - `constraints`: table [tune.constraints] of the least values of measures; by default every
      margin that the model can satisfy;
    - `evaluations`: largest number of evaluated gaits.
    """

    objective: str | Mapping[str, float] = "dls_fraction"
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    constraints: Mapping[str, float] | None = None
    evaluations: int = 200

    @classmethod
    def from_table(cls, table: Mapping[str, object]) -> "TuneConfig":
        """Return the settings of `[tune]` and its tables."""
        _require_known_keys(table, cls.__dataclass_fields__, "[tune]", "settings")
        objective = table.get("objective", cls.objective)
        if isinstance(objective, dict):
            objective = {name: _parse_number(value, name) for name, value in objective.items()}
        elif not isinstance(objective, str):
            requirement = (
                'a measure or weights of several: write objective = "dls_fraction" or objective = '
            )
            raise _make_error(
                "objective", objective, requirement + "{ dls_fraction = 1.0, speed = 0.1 }"
            )
        bounds = table.get("bounds")
        if not isinstance(bounds, dict) or not bounds:
            raise ValueError(
                "[tune] has no free parameter, but it needs at least one: add [tune.bounds] with "
                "lines such as damping = [20.0, 215.0]."
            )
        _require_known_keys(bounds, PARAMETER_NAMES, "[tune.bounds]", "parameters")
        constraints = table.get("constraints")
        if constraints is not None:
            if not isinstance(constraints, dict):
                requirement = "a table: write [tune.constraints] and below it lines such as "
                raise _make_error(
                    "constraints", constraints, requirement + "clearance_sls1 = 0.001"
                )
            constraints = {name: _parse_number(value, name) for name, value in constraints.items()}
        return cls(
            objective=objective,
            bounds={name: _parse_range(name, value) for name, value in bounds.items()},
            constraints=constraints,
            evaluations=_parse_int(table.get("evaluations", cls.evaluations), "evaluations", 1),
        )


@dataclass(frozen=True)
class BranchConfig:
    """Table `[branch]`: parameter and range of a branch of gaits.

    - `parameter`: name of the parameter;
    - `bounds`: range of the parameter, [lower, upper];
    - `period`: number of steps until the gait repeats;
    - `max_ds`: largest distance between points, as a share of the range; 0.02 by default.
    """

    parameter: str
    bounds: tuple[float, float]
    period: int = 1
    max_ds: float | None = None

    @classmethod
    def from_table(cls, table: Mapping[str, object], names: tuple[str, ...]) -> "BranchConfig":
        """Return the settings of `[branch]`; its parameter is one of `names`."""
        _raise_for_renamed_keys(table, "[branch]")
        _require_known_keys(table, cls.__dataclass_fields__, "[branch]", "settings")
        parameter = table.get("parameter")
        check_parameter_name(parameter, names, "parameter that a branch of this model runs along")
        assert isinstance(parameter, str)
        if "bounds" not in table:
            raise ValueError("[branch] has no bounds: write bounds = [4.0, 230.0], say.")
        bounds = check_range(
            "bounds", _parse_range("bounds of " + parameter, table["bounds"], parameter)
        )
        max_ds = None
        if "max_ds" in table:
            max_ds = _parse_number(table["max_ds"], "max_ds", must_be_positive=True)
            if max_ds > 1.0:
                raise ValueError(
                    f"max_ds is {max_ds:g}, but it is a share of the range: give 0.02, say."
                )
        return cls(
            parameter=parameter,
            bounds=bounds,
            period=_parse_int(table.get("period", cls.period), "period", 1),
            max_ds=max_ds,
        )


@dataclass(frozen=True)
class Config:
    """A config as checked values, with the text from which it was read."""

    wheel_values: Mapping[str, float | int] = field(default_factory=dict)
    model_name: str = "viscoelastic"
    model_settings: Mapping[str, float | int | str | bool] = field(default_factory=dict)
    option_values: Mapping[str, float | int | str | bool] = field(default_factory=dict)
    scan: ScanConfig = ScanConfig()
    gait: GaitConfig = GaitConfig()
    tune: TuneConfig | None = None
    branch: BranchConfig | None = None
    design: designs.AbstractDesign | None = None
    source_text: str = ""
    file_name: str = ""

    def make_wheel(self, changes: Mapping[str, float | int] | None = None) -> WheelParams:
        """Return the wheel: Table 1 with the values of the config, and then with `changes`."""
        values: dict[str, Any] = {**self.wheel_values, **(changes or {})}
        return WheelParams(**values)

    def make_model(self) -> AbstractWheel:
        """Return the model with its settings."""
        return find_model_class(self.model_name)(**self.model_settings)

    def make_options(self) -> StepOptions:
        """Return the numerical options of the steps."""
        options: dict[str, Any] = {**self.option_values}
        return StepOptions(**options)


def load_config(path: str | Path) -> Config:
    """Return the config of a file after checks; raise a ValueError if it is invalid."""
    path = Path(path)
    if not path.exists():
        suggestion = suggest_name(
            path.name, (neighbor.name for neighbor in path.parent.glob("*.toml"))
        )
        raise ValueError(
            f"there is no config file {path}{suggestion}: give the path of a TOML file, "
            "such as configs/quickstart.toml, which `vrw init` writes."
        )
    if path.is_dir():
        raise ValueError(f"{path} is a folder, but a config is a TOML file: give its path.")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path} can't be read ({error}): give a readable text file in UTF-8."
        ) from error
    return parse_config(text, path.name)


def parse_config(text: str, file_name: str = "config") -> Config:
    """Return the config of a text after checks; `file_name` begins every message about an error."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(
            f"{file_name}: this is not valid TOML ({error}): mend that line."
        ) from error
    except ValueError as error:
        raise ValueError(
            f"{file_name}: a number has more digits than any key takes: give a shorter one."
        ) from error
    except RecursionError as error:
        raise ValueError(
            f"{file_name}: lists or tables lie in each other too deeply: no key takes more than "
            f"two."
        ) from error
    try:
        return _make_config(tables, text, file_name)
    except ValueError as error:
        raise ValueError(f"{file_name}: {error}") from error


def _make_config(tables: Mapping[str, object], text: str, file_name: str) -> Config:
    """Return the config of the tables of a file; raise a ValueError if a table is invalid."""
    _require_known_keys(tables, TABLE_NAMES, "the file", "tables")
    for key, table in tables.items():
        if not isinstance(table, dict):
            requirement = f"a table: write [{key}] on a line of its own and its settings below"
            raise _make_error(f"[{key}]", table, requirement)
    design_kinds = [design_kind for design_kind in DESIGN_KINDS if design_kind in tables]
    if len(design_kinds) > 1:
        raise ValueError(
            f"[{design_kinds[0]}] and [{design_kinds[1]}] are both given, but a scan has one "
            "design: keep one."
        )
    model_name, model = _parse_model(_get_table(tables, "model"))
    model_class = find_model_class(model_name)
    names = model_class.parameter_names
    design = (
        _parse_design(design_kinds[0], _get_table(tables, design_kinds[0]), names)
        if design_kinds
        else None
    )
    wheel = _parse_wheel(_get_table(tables, "wheel"))
    doubly_given_names = [
        key for key in _get_table(tables, "wheel") if design is not None and key in design.names
    ]
    if doubly_given_names:
        raise ValueError(
            f"{doubly_given_names[0]} is fixed in [wheel] and swept in [{design_kinds[0]}], but it "
            "can only be one: drop one of the two."
        )
    option_table = _get_table(tables, "options")
    _raise_for_renamed_keys(option_table, "[options]")
    _require_known_keys(option_table, _OPTION_KEYS, "[options]", "options")
    default_options = {key: getattr(StepOptions(), key) for key in _OPTION_KEYS}
    option_values = _parse_like_defaults(option_table, default_options)
    config = Config(
        wheel_values=wheel,
        model_name=model_name,
        model_settings=model,
        option_values=option_values,
        scan=ScanConfig.from_table(_get_table(tables, "scan"), model_class),
        gait=GaitConfig.from_table(_get_table(tables, "gait")),
        tune=TuneConfig.from_table(_get_table(tables, "tune")) if "tune" in tables else None,
        branch=BranchConfig.from_table(_get_table(tables, "branch"), names)
        if "branch" in tables
        else None,
        design=design,
        source_text=text,
        file_name=file_name,
    )
    config.make_wheel()
    try:
        config.make_model()
    # The wheel has a setting that no file can contain, such as uneven ground.
    except TypeError as error:
        raise ValueError(str(error)) from error
    options = config.make_options()
    options.check_tolerances(np.dtype(float))
    make_solver(options.solver, options)
    return config


def _get_table(tables: Mapping[str, object], key: str) -> dict[str, object]:
    """Return a table of the file; an empty one if it is missing."""
    table = tables.get(key, {})
    assert isinstance(table, dict)
    return table


def parse_assignment(text: str) -> tuple[str, float | int]:
    """Return a parameter and its value from `name=value` of the command line."""
    name, equals_sign, value = (key.strip() for key in text.partition("="))
    if not equals_sign:
        raise ValueError(f"--set {text} has no '=': write a parameter and its value, damping=150.")
    try:
        number = int(value) if name == "n_legs" else float(value)
    except ValueError:
        number = value  # type: ignore[assignment]  # The check below reports the error.
    return name, _parse_wheel({name: number})[name]


def _parse_wheel(table: Mapping[str, object]) -> dict[str, float | int]:
    """Return the parameters of `[wheel]` by name."""
    known_keys = (*PARAMETER_NAMES, "n_legs", PARAMETER_SET_KEY)
    _require_known_keys(table, known_keys, "[wheel]", "parameters")
    values: dict[str, float | int] = {}
    if (set_name := table.get(PARAMETER_SET_KEY)) is not None:
        check_known_name(set_name, tuple(parameter_sets), "parameter set")
        values |= parameter_sets[str(set_name)].values
    for name, value in table.items():
        if name == PARAMETER_SET_KEY:
            continue
        if name == "n_legs":
            values[name] = _parse_int(value, name, 5)
            if values[name] > MAX_CONFIG_LEGS:
                raise _make_error(name, value, f"at most {MAX_CONFIG_LEGS:,}")
        else:
            values[name] = _parse_parameter(name, value)
    return values


def _parse_model(table: Mapping[str, object]) -> tuple[str, dict[str, float | int | str | bool]]:
    """Return the name and the settings of the model of `[model]`."""
    _raise_for_renamed_keys(table, "[model]")
    model_name = table.get("name", Config.model_name)
    check_known_name(model_name, list_config_names(), "model")
    assert isinstance(model_name, str)
    defaults = {setting.name: setting.default for setting in fields(find_model_class(model_name))}
    _require_known_keys(
        table, ("name", *defaults), f'[model] with name = "{model_name}"', "settings"
    )
    model_settings = {name: value for name, value in table.items() if name != "name"}
    return model_name, _parse_like_defaults(model_settings, defaults)


def _parse_like_defaults(
    table: Mapping[str, object], defaults: Mapping[str, object]
) -> dict[str, float | int | str | bool]:
    """Return settings with the types of their defaults; numbers must be positive."""
    values: dict[str, float | int | str | bool] = {}
    for key, value in table.items():
        default = defaults[key]
        if isinstance(default, bool):
            if not isinstance(value, bool):
                raise _make_error(key, value, "true or false")
            values[key] = value
        elif isinstance(default, str):
            if not isinstance(value, str):
                raise _make_error(key, value, f'a name, "{default}"')
            values[key] = value
        elif isinstance(default, int):
            values[key] = _parse_int(value, key, 1)
        elif key == FRICTION_NAME and value == math.inf:
            values[key] = math.inf  # Infinite friction means that feet do not slip.
        else:
            values[key] = _parse_number(value, key, must_be_positive=True)
    return values


def _parse_design(
    design_kind: str, table: Mapping[str, object], names: tuple[str, ...]
) -> designs.AbstractDesign:
    """Return the design of a table that sweeps some of the parameters `names`."""
    design_keys = ("n", "seed") if design_kind in RANDOM_DESIGNS else ()
    if FRICTION_NAME in table and FRICTION_NAME not in names:
        model_choices = [
            f'name = "{list_value}"' for list_value in list_config_names("scan", FRICTION_NAME)
        ]
        raise ValueError(
            f"[{design_kind}] sweeps friction, which does not affect this model: write [model] "
            f"and below it {' or '.join(model_choices)}."
        )
    _require_known_keys(table, (*design_keys, *names), f"[{design_kind}]", "settings")
    swept_names = {name: value for name, value in table.items() if name not in design_keys}
    if design_keys:
        if "n" not in table:
            raise ValueError(f"[{design_kind}] has no number of samples: write n = 4096, say.")
        n, seed = _parse_int(table["n"], "n", 1), _parse_int(table.get("seed", 0), "seed", 0)
        ranges = {name: _parse_range(name, value) for name, value in swept_names.items()}
        return RANDOM_DESIGNS[design_kind](ranges, n, seed)
    if design_kind == "grid":
        return designs.grid(
            **{name: _parse_axis(name, value) for name, value in swept_names.items()}
        )
    return designs.samples({name: _parse_list(name, value) for name, value in swept_names.items()})


def _parse_axis(name: str, value: object) -> np.ndarray:
    """Return the values of a grid's axis, given as a list or as from, to and count."""
    if not isinstance(value, dict):
        return _parse_list(name, value, " or { from = ..., to = ..., count = ... }")
    _require_known_keys(value, _AXIS_KEYS, f"the axis of {name}", "keys")
    missing_keys = [key for key in _AXIS_KEYS if key not in value]
    if missing_keys:
        raise ValueError(
            f"the axis of {name} has no '{missing_keys[0]}': "
            f"write {name} = {{ from = ..., to = ..., count = ... }}."
        )
    lower, upper = (_parse_parameter(name, value[key]) for key in ("from", "to"))
    count = _parse_int(value["count"], f"count of {name}", 1)
    if count > MAX_LISTED_SAMPLES:
        raise ValueError(
            f"the axis of {name} has {count:,} values, but {MAX_LISTED_SAMPLES:,} is the most: "
            "give fewer."
        )
    return np.linspace(lower, upper, count)


def _parse_list(name: str, value: object, alternative_text: str = "") -> np.ndarray:
    """Return a list of values in the domain of the parameter `name` as an array."""
    if not isinstance(value, list):
        raise _make_error(name, value, f"a list of numbers{alternative_text}")
    return np.asarray([_parse_parameter(name, list_value) for list_value in value])


def _parse_range(name: str, value: object, parameter: str = "") -> tuple[float, float]:
    """Return lower and upper bound in the domain of `parameter`, by default `name` itself."""
    if not (isinstance(value, list) and len(value) == 2):
        raise _make_error(name, value, f"a range of two numbers: write {name} = [lower, upper]")
    lower, upper = (_parse_parameter(parameter or name, bound_value) for bound_value in value)
    return lower, upper


def _parse_parameter(name: str, value: object) -> float:
    """Return a value as a number; raise a ValueError if it is not in the domain of the
    parameter.
    """
    number = _parse_number(value, name, must_be_positive=name == FRICTION_NAME)
    if name != FRICTION_NAME:
        PARAMETER_DOMAINS[name].require_inside(name, number)
    return number


def _parse_number(value: object, name: str, must_be_positive: bool = False) -> float:
    """Return a value as a finite float; raise a ValueError if it is none."""
    number = math.nan
    if isinstance(value, int | float) and not isinstance(value, bool):
        # An integer of hundreds of digits is too large for a float.
        with contextlib.suppress(OverflowError):
            number = float(value)
    if not math.isfinite(number):
        raise _make_error(name, value, "a finite number")
    if must_be_positive and not number > 0:
        raise ValueError(f"{name} is {number:g}, but it must be positive.")
    return number


def _parse_int(value: object, name: str, minimum: int) -> int:
    """Return a value as a whole number of at least `minimum`; raise a ValueError if it is none."""
    if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
        raise _make_error(name, value, f"a whole number of at least {minimum}")
    if value > MAX_CONFIG_INTEGER:
        raise _make_error(name, value, f"at most {MAX_CONFIG_INTEGER:,}")
    return value


def _require_known_keys(
    table: Mapping[str, object], allowed_keys: Iterable[str], location: str, key_kind: str
) -> None:
    """Raise a ValueError if a table has a key that is not allowed."""
    allowed_keys = tuple(allowed_keys)
    for key in table:
        refuse_symbol(key, allowed_keys)
        if key not in allowed_keys:
            raise ValueError(
                f"{location} has the unknown key '{key}'{suggest_name(key, allowed_keys)}: "
                f"its {key_kind} are {', '.join(allowed_keys)}."
            )


def _raise_for_renamed_keys(table: Mapping[str, object], location: str) -> None:
    """Raise a ValueError if a table has an old key."""
    for key, new_key in RENAMED_KEYS[location].items():
        if key in table:
            raise ValueError(f"{location} has the old key '{key}': write {new_key} in its place.")


def _make_error(name: str, value: object, requirement: str) -> ValueError:
    """Return the error about a value, written as in TOML, that does not satisfy a requirement."""
    value_text = format_value(value)
    if isinstance(value, bool):
        value_text = value_text.lower()
    elif isinstance(value, str):
        value_text = value_text.replace("'", '"')
    return ValueError(f"{name} is {value_text}, but it must be {requirement}.")
