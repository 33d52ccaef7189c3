"""Configs: TOML files that define a wheel, samples and measures.

An error in a file is reported in one sentence that states the given value, the allowed values and
the remedy.
"""

import contextlib
import importlib.util
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vrw_jax.base.checks import (
    check_path,
    check_range,
    format_name_suggestion,
    format_value,
    require_known_name,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.registry import find_model_class, list_model_config_names
from vrw_jax.studies import scan_design as designs
from vrw_jax.studies.measure_catalog import check_measure_names, select_measure_catalog
from vrw_jax.studies.scan_design import MAX_LISTED_SAMPLES
from vrw_jax.wheel.parameter_sets import parameter_sets
from vrw_jax.wheel.params import (
    FRICTION_NAME,
    LAW_NAMES,
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    WheelParams,
    check_parameter_name,
    raise_for_parameter_symbol,
)

RANDOM_DESIGN_FUNCTIONS = {
    "sobol": designs.sobol,
    "uniform": designs.uniform,
    "saltelli": designs.saltelli,
}
DESIGN_TABLE_NAMES = ("grid", "samples", *RANDOM_DESIGN_FUNCTIONS)
CONFIG_TABLE_NAMES = (
    "wheel",
    "model",
    "options",
    "gait",
    "scan",
    "tune",
    "branch",
    "figures",
    *DESIGN_TABLE_NAMES,
)
PARAMETER_SET_KEY = "parameter_set"
"""Key of `[wheel]` that names a parameter set. Other keys of the table replace values of this
set.
"""
ConfigTable = Mapping[str, Any]
"""Table of a config, as read from TOML."""

_GRID_AXIS_KEYS = ("from", "to", "count")

MAX_CONFIG_INTEGER = 2**53
"""Largest integer in a config, chosen because floats represent all integers up to it."""

MAX_CONFIG_LEGS = 1_000
"""Largest number of legs in a config, chosen because results have one value per leg and sample."""


@dataclass(frozen=True)
class ScanConfig:
    """Table `[scan]`: measures of a scan, and number of samples per write.

    - `measures`: names of measures and derivatives; by default DLS fraction, speed and the like;
    - `chunk`: number of samples that are computed and written together; 4,096 by default;
    - `tol`: permitted error of each measure with unilateral contact (`name = "unilateral"`), in the
      unit of the measure. Each sample is computed with the simplest model that achieves this error;
    - `slope_sd`: standard deviation of random slopes, rad, for the measures of `vrw.first_passage`;
    - `mesh_intervals`: numbers of mesh intervals of DLS, SLS-I and SLS-II, for the paper's wheel.
      Stiff legs on a gentle slope need [40, 32, 16].
    """

    measures: tuple[str, ...] | None = None
    chunk: int | None = None
    tol: float | None = None
    slope_sd: float | None = None
    mesh_intervals: tuple[int, int, int] | None = None

    @classmethod
    def from_table(cls, config_table: ConfigTable, model: AbstractWheel) -> "ScanConfig":
        """Read the settings of the table `[scan]`.

        Raise a ValueError if the model does not have a requested measure.
        """
        scan_config = cls(
            **_parse_settings(
                config_table,
                "[scan]",
                measures=_parse_names,
                chunk=_parse_whole_number,
                tol=_parse_positive_number,
                slope_sd=_parse_positive_number,
                mesh_intervals=lambda _, value: CycleOptions(mesh_intervals=value).mesh_intervals,
            )
        )
        check_measure_names(
            scan_config.measures or (),
            select_measure_catalog(model, scan_config.tol, scan_config.slope_sd),
        )
        return scan_config

    def make_cycle_options(self) -> CycleOptions | None:
        """Return the options of the gait search with the mesh of the config, or None."""
        return self.mesh_intervals and CycleOptions(mesh_intervals=self.mesh_intervals)


@dataclass(frozen=True)
class GaitConfig:
    """Table `[gait]`: length and start of a walk.

    - `steps`: number of steps;
    - `start`: section state before the first touchdown, [rad, rad/s, m/s]; by default the default
      start of the model.
    """

    steps: int = 30
    start: tuple[float, float, float] | None = None

    @classmethod
    def from_table(cls, config_table: ConfigTable) -> "GaitConfig":
        """Read the settings of the table `[gait]`."""
        return cls(
            **_parse_settings(
                config_table,
                "[gait]",
                steps=_parse_whole_number,
                start=partial(
                    _parse_numbers,
                    length=3,
                    requirement_text="the section state before touchdown, three numbers: angle in "
                    "rad, angular rate in rad/s, rate of Leg 1 in m/s",
                ),
            )
        )


@dataclass(frozen=True)
class TuneConfig:
    """Table `[tune]`: objective, bounds and constraints of a tuning run.

    - `objective`: name of a measure, or weights of measures, { dls_fraction = 1.0, speed = 0.1 };
    - `bounds`: table [tune.bounds] of the free parameters, such as damping = [20.0, 215.0];
    - `constraints`: table [tune.constraints] with the smallest allowed values of measures; by
      default every margin that the model can satisfy;
    - `evaluations`: largest number of evaluated gaits.
    """

    objective: str | Mapping[str, float] = "dls_fraction"
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    constraints: Mapping[str, float] | None = None
    evaluations: int = 200

    @classmethod
    def from_table(cls, config_table: ConfigTable) -> "TuneConfig":
        """Read the settings of the table `[tune]` and of its subtables."""

        def parse_bounds(_: str, bounds_table: object) -> dict[str, tuple[float, float]]:
            if not isinstance(bounds_table, dict) or not bounds_table:
                raise ValueError(
                    "[tune] has no free parameter, but it needs at least one: add [tune.bounds] "
                    "with lines such as damping = [20.0, 215.0]."
                )
            _require_known_keys(bounds_table, PARAMETER_NAMES, "[tune.bounds]", "parameters")
            return {
                parameter_name: _parse_parameter_range(parameter_name, parameter_bounds)
                for parameter_name, parameter_bounds in bounds_table.items()
            }

        return cls(
            **_parse_settings(
                {"bounds": {}, **config_table},
                "[tune]",
                objective=lambda setting_name, value: (
                    value
                    if isinstance(value, str)
                    else _parse_numbers_by_name(
                        setting_name,
                        value,
                        "a measure or weights of several: write objective = "
                        '"dls_fraction" or objective = { dls_fraction = 1.0, speed = 0.1 }',
                    )
                ),
                bounds=parse_bounds,
                constraints=partial(
                    _parse_numbers_by_name,
                    requirement_text="a table: write [tune.constraints] and below it lines such "
                    "as clearance_sls1 = 0.001",
                ),
                evaluations=_parse_whole_number,
            )
        )


@dataclass(frozen=True)
class BranchConfig:
    """Table `[branch]`: parameter and range of a branch of gaits.

    - `parameter`: name of the parameter;
    - `bounds`: range of the parameter, [lower, upper];
    - `period`: number of steps until the gait repeats;
    - `max_ds`: largest distance between two points of the branch, as a fraction of the range; 0.02
      by default.
    """

    parameter: str
    bounds: tuple[float, float]
    period: int = 1
    max_ds: float | None = None

    @classmethod
    def from_table(
        cls, config_table: ConfigTable, allowed_parameter_names: tuple[str, ...]
    ) -> "BranchConfig":
        """Read the settings of the table `[branch]`.

        Its parameter must be one of `allowed_parameter_names`.
        """
        _require_known_keys(config_table, cls.__dataclass_fields__, "[branch]", "settings")
        branch_parameter = config_table.get("parameter")
        check_parameter_name(
            branch_parameter,
            allowed_parameter_names,
            "parameter that a branch of this model runs along",
        )
        if "bounds" not in config_table:
            raise ValueError("[branch] has no bounds: write bounds = [4.0, 230.0], say.")
        branch_config = cls(
            **_parse_settings(
                config_table,
                "[branch]",
                parameter=lambda _, value: value,
                bounds=lambda _, value: check_range(
                    "bounds",
                    _parse_parameter_range(
                        f"bounds of {branch_parameter}", value, str(branch_parameter)
                    ),
                ),
                period=_parse_whole_number,
                max_ds=_parse_positive_number,
            )
        )
        if branch_config.max_ds is not None and branch_config.max_ds > 1.0:
            raise ValueError(
                f"max_ds is {branch_config.max_ds:g}, but it is a share of the range: give 0.02, "
                "say."
            )
        return branch_config


FIGURE_FORMATS = ("svg", "png", "pdf")
"""File formats in which commands write figures."""


@dataclass(frozen=True)
class FigureConfig:
    """Table `[figures]`: width and files of the figures.

    - `width`: "column" (86 mm), "page" (175 mm), or a number of mm; by default the usual width of
      each figure;
    - `formats`: file formats in the folder of the result, of "svg", "png" and "pdf";
    - `file`: path of the figure, such as "fig3.pdf", instead of files in the folder of the result.
      If there are several figures, their names follow the name of the file.
    """

    width: str | float | None = None
    formats: tuple[str, ...] = ("svg", "png")
    file: Path | None = None

    @classmethod
    def from_table(cls, config_table: ConfigTable) -> "FigureConfig":
        """Read the settings of the table `[figures]`."""

        def parse_width(_: str, width: Any) -> str | float:
            from vrw_jax.app import figure_style as style

            try:
                style.find_width_inches(width, 1.0)
            except TypeError as width_error:
                raise ValueError(str(width_error)) from width_error
            return width

        def parse_formats(setting_name: str, formats: Any) -> tuple[str, ...]:
            is_nonempty_list = isinstance(formats, list) and len(formats) > 0
            if not is_nonempty_list or not all(name in FIGURE_FORMATS for name in formats):
                raise _make_value_error(setting_name, formats, 'a list of "svg", "png" and "pdf"')
            return tuple(formats)

        def parse_file(setting_name: str, path_text: object) -> Path:
            if not isinstance(path_text, str) or not is_figure_file(Path(path_text)):
                raise _make_value_error(setting_name, path_text, 'a path, such as "fig3.pdf"')
            return Path(path_text).expanduser()

        return cls(
            **_parse_settings(
                config_table, "[figures]", width=parse_width, formats=parse_formats, file=parse_file
            )
        )


def is_figure_file(path: Path) -> bool:
    """Return whether a path is the path of a figure.

    Raise a ValueError for formats of images that are not supported.
    """
    if path.suffix.lower() in (".eps", ".ps", ".jpg", ".jpeg", ".tif", ".tiff", ".gif"):
        raise ValueError(
            f"{path} has the suffix {path.suffix}, but figures are written as .pdf, .svg or .png: "
            "give one of these suffixes, or a folder."
        )
    return path.suffix[1:] in FIGURE_FORMATS


@dataclass(frozen=True)
class Config:
    """Validated settings from a config, and the text of the file."""

    wheel_values: Mapping[str, Any] = field(default_factory=dict)
    model_name: str = "viscoelastic"
    model_settings: Mapping[str, Any] = field(default_factory=dict)
    step_option_values: Mapping[str, Any] = field(default_factory=dict)
    scan: ScanConfig = ScanConfig()
    gait: GaitConfig = GaitConfig()
    tune: TuneConfig | None = None
    branch: BranchConfig | None = None
    figures: FigureConfig = FigureConfig()
    design: designs.AbstractSampleDesign | None = None
    source_text: str = ""
    file_name: str = ""

    def make_wheel(self, changed_values: Mapping[str, float | int] | None = None) -> WheelParams:
        """Return the wheel of Table 1 of the paper with the parameters of the config.

        `changed_values` replaces parameters of the config.
        """
        return WheelParams(**{**self.wheel_values, **(changed_values or {})})

    def make_model(self) -> AbstractWheel:
        """Return the model with the settings from the config."""
        return find_model_class(self.model_name)(**self.model_settings)

    def make_options(self) -> StepOptions:
        """Return the numerical options of the walking steps."""
        return StepOptions(**self.step_option_values)


def load_config(config_path: str | Path) -> Config:
    """Read and validate a config file. Raise a ValueError if the file is invalid."""
    config_path = check_path("the config", config_path, "give the path of a TOML file")
    if not config_path.exists():
        name_suggestion = format_name_suggestion(
            config_path.name,
            (neighbor_path.name for neighbor_path in config_path.parent.glob("*.toml")),
        )
        raise ValueError(
            f"there is no config file {config_path}{name_suggestion}: give the path of a TOML "
            "file, such as configs/quickstart.toml, which `vrw init` writes."
        )
    if config_path.is_dir():
        raise ValueError(f"{config_path} is a folder, but a config is a TOML file: give its path.")
    try:
        # Some editors put a byte-order mark before the text.
        config_text = config_path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as read_error:
        raise ValueError(
            f"{config_path} can't be read ({read_error}): give a readable text file in UTF-8."
        ) from read_error
    return parse_config(config_text, config_path.name)


def parse_config(config_text: str, file_name: str = "config") -> Config:
    """Parse and validate the text of a config. Every error message begins with `file_name`."""
    try:
        config_tables = tomllib.loads(config_text)
    except tomllib.TOMLDecodeError as config_error:
        raise ValueError(
            f"{file_name}: this is not valid TOML ({config_error}): mend that line."
        ) from config_error
    except ValueError as config_error:
        raise ValueError(
            f"{file_name}: a number has more digits than any key takes: give a shorter one."
        ) from config_error
    except RecursionError as config_error:
        raise ValueError(
            f"{file_name}: lists or tables lie in each other too deeply: no key takes more than "
            "two."
        ) from config_error
    try:
        return _parse_config_tables(config_tables, config_text, file_name)
    except ValueError as config_error:
        raise ValueError(f"{file_name}: {config_error}") from config_error


def _parse_config_tables(config_tables: ConfigTable, config_text: str, file_name: str) -> Config:
    """Validate the parsed tables of a file. Raise a ValueError if a table is invalid."""
    _require_known_keys(config_tables, CONFIG_TABLE_NAMES, "the file", "tables")
    for table_name, config_table in config_tables.items():
        if not isinstance(config_table, dict):
            requirement_text = (
                f"a table: write [{table_name}] on a line of its own and its settings below"
            )
            raise _make_value_error(f"[{table_name}]", config_table, requirement_text)
    design_kinds = [
        design_kind for design_kind in DESIGN_TABLE_NAMES if design_kind in config_tables
    ]
    if len(design_kinds) > 1:
        raise ValueError(
            f"[{design_kinds[0]}] and [{design_kinds[1]}] are both given, but a scan has one "
            "design: keep one."
        )
    tables: dict[str, Any] = {name: {} for name in CONFIG_TABLE_NAMES} | dict(config_tables)
    model_name = tables["model"].get("name", Config.model_name)
    require_known_name(model_name, list_model_config_names(), "model")
    model_class = find_model_class(model_name)
    default_settings = {
        model_field.name: model_field.default for model_field in fields(model_class)
    }
    _require_known_keys(
        tables["model"],
        ("name", *default_settings),
        f'[model] with name = "{model_name}"',
        "settings",
    )
    model_settings = {
        setting_name: setting_value
        for setting_name, setting_value in tables["model"].items()
        if setting_name not in ("name", *LAW_NAMES)
    }
    law_settings = {
        law_name: _load_law(law_name, tables["model"][law_name])
        for law_name in LAW_NAMES
        if law_name in tables["model"]
    }
    default_model = model_class(**law_settings)
    parameter_names = default_model.parameter_names
    sample_design = None
    if design_kinds:
        design_kind = design_kinds[0]
        sample_design = _parse_design_table(design_kind, tables[design_kind], parameter_names)
        for parameter_name in sample_design.swept_parameters:
            if parameter_name in tables["wheel"]:
                raise ValueError(
                    f"{parameter_name} is fixed in [wheel] and swept in [{design_kind}], but it "
                    "can only be one: drop one of the two."
                )
    default_options = vars(StepOptions())
    _require_known_keys(tables["options"], default_options, "[options]", "options")
    checked_config = Config(
        wheel_values=_parse_wheel_table(tables["wheel"]),
        model_name=model_name,
        model_settings=law_settings | _parse_with_default_types(model_settings, default_settings),
        step_option_values=_parse_with_default_types(tables["options"], default_options),
        scan=ScanConfig.from_table(tables["scan"], default_model),
        gait=GaitConfig.from_table(tables["gait"]),
        tune=TuneConfig.from_table(tables["tune"]) if "tune" in config_tables else None,
        branch=BranchConfig.from_table(tables["branch"], parameter_names)
        if "branch" in config_tables
        else None,
        figures=FigureConfig.from_table(tables["figures"]),
        design=sample_design,
        source_text=config_text,
        file_name=file_name,
    )
    checked_config.make_wheel()
    try:
        checked_config.make_model()
    # The wheel has a setting that no file can contain, such as uneven ground.
    except TypeError as model_error:
        raise ValueError(str(model_error)) from model_error
    checked_config.make_options().check_tolerances(np.dtype(float))
    return checked_config


def parse_assignment(assignment_text: str) -> tuple[str, float | int]:
    """Return the parameter name and the number in a text such as "damping=150"."""
    parameter_name, equals_separator, value_text = (
        assignment_part.strip() for assignment_part in assignment_text.partition("=")
    )
    if not equals_separator:
        raise ValueError(
            f"--set {assignment_text} has no '=': write a parameter and its value, damping=150."
        )
    try:
        assigned_number = int(value_text) if parameter_name == "n_legs" else float(value_text)
    except ValueError:
        assigned_number = value_text  # type: ignore[assignment]  # The check below reports the error.
    return parameter_name, _parse_wheel_table({parameter_name: assigned_number})[parameter_name]


def _parse_wheel_table(config_table: ConfigTable) -> dict[str, float | int]:
    """Return the parameters in the table `[wheel]`, by name."""
    known_wheel_keys = (*PARAMETER_NAMES, "n_legs", PARAMETER_SET_KEY)
    _require_known_keys(config_table, known_wheel_keys, "[wheel]", "parameters")
    parameter_values: dict[str, float | int] = {}
    if (parameter_set_name := config_table.get(PARAMETER_SET_KEY)) is not None:
        require_known_name(parameter_set_name, tuple(parameter_sets), "parameter set")
        parameter_values |= parameter_sets[parameter_set_name].values
    for parameter_name, config_value in config_table.items():
        if parameter_name == PARAMETER_SET_KEY:
            continue
        if parameter_name == "n_legs":
            parameter_values[parameter_name] = _parse_whole_number(
                parameter_name, config_value, 5, MAX_CONFIG_LEGS
            )
        else:
            parameter_values[parameter_name] = _parse_parameter_value(parameter_name, config_value)
    return parameter_values


def _load_law(law_name: str, location: object) -> Any:
    """Return the law that a text such as "my_leg.py:leg" names, from the Python file.

    A torque may also be a number.
    """
    if (
        law_name == "hub_torque"
        and isinstance(location, int | float)
        and not isinstance(location, bool)
    ):
        return float(location)
    file_name, _, name_in_file = str(location).rpartition(":")
    if not isinstance(location, str) or not file_name.endswith(".py") or not name_in_file:
        raise _make_value_error(
            law_name, location, 'a Python file and a name in it, as "my_leg.py:leg"'
        )
    if not Path(file_name).is_file():
        raise ValueError(
            f"{law_name} names the file {file_name}, which {Path.cwd()} does not contain: "
            "give its path from the current folder."
        )
    module_spec = importlib.util.spec_from_file_location(Path(file_name).stem, file_name)
    assert module_spec is not None
    assert module_spec.loader is not None  # The name of the file ends in .py.
    module = importlib.util.module_from_spec(module_spec)
    module_spec.loader.exec_module(module)
    if not hasattr(module, name_in_file):
        raise ValueError(
            f"{law_name} is {location}, but {file_name} does not define {name_in_file}: write "
            f"{name_in_file} = ... there."
        )
    law = getattr(module, name_in_file)
    return law() if isinstance(law, type) else law


def _parse_with_default_types(
    config_table: ConfigTable, default_setting_values: ConfigTable
) -> dict[str, Any]:
    """Return the settings, converted to the types of their default values. Numbers must be
    positive.
    """
    parsed_settings: dict[str, Any] = {}
    for setting_name, config_value in config_table.items():
        default_value = default_setting_values[setting_name]
        if isinstance(default_value, bool | str):
            if not isinstance(config_value, type(default_value)):
                requirement_text = (
                    "true or false"
                    if isinstance(default_value, bool)
                    else f'a name, "{default_value}"'
                )
                raise _make_value_error(setting_name, config_value, requirement_text)
            parsed_settings[setting_name] = config_value
        elif isinstance(default_value, int):
            parsed_settings[setting_name] = _parse_whole_number(setting_name, config_value)
        elif setting_name == FRICTION_NAME and config_value == math.inf:
            # Infinite friction means that feet do not slip.
            parsed_settings[setting_name] = math.inf
        else:
            parsed_settings[setting_name] = _parse_positive_number(setting_name, config_value)
    return parsed_settings


def _parse_design_table(
    design_kind: str, config_table: ConfigTable, allowed_parameter_names: tuple[str, ...]
) -> designs.AbstractSampleDesign:
    """Return the sample design that a table defines.

    It may sweep only parameters in `allowed_parameter_names`.
    """
    design_setting_keys = ("n", "seed") if design_kind in RANDOM_DESIGN_FUNCTIONS else ()
    if FRICTION_NAME in config_table and FRICTION_NAME not in allowed_parameter_names:
        model_choices = [
            f'name = "{config_name}"'
            for config_name in list_model_config_names("scan", FRICTION_NAME)
        ]
        raise ValueError(
            f"[{design_kind}] sweeps friction, which does not affect this model: write [model] "
            f"and below it {' or '.join(model_choices)}."
        )
    _require_known_keys(
        config_table,
        (*design_setting_keys, *allowed_parameter_names),
        f"[{design_kind}]",
        "settings",
    )
    setting_parsers: dict[str, Callable] = {"grid": _parse_grid_axis, "samples": _parse_value_list}
    parse_setting = setting_parsers.get(design_kind, _parse_parameter_range)
    swept_settings = {
        parameter_name: parse_setting(parameter_name, config_value)
        for parameter_name, config_value in config_table.items()
        if parameter_name not in design_setting_keys
    }
    if design_kind == "grid":
        return designs.grid(swept_settings)
    if design_kind == "samples":
        return designs.samples(swept_settings)
    if "n" not in config_table:
        raise ValueError(f"[{design_kind}] has no number of samples: write n = 4096, say.")
    n = _parse_whole_number("n", config_table["n"])
    random_seed = _parse_whole_number("seed", config_table.get("seed", 0), 0)
    return RANDOM_DESIGN_FUNCTIONS[design_kind](swept_settings, n, random_seed)


def _parse_grid_axis(
    parameter_name: str, grid_axis_setting: object
) -> np.ndarray | tuple[float, ...]:
    """Return the values on an axis of a grid.

    The setting is a list of values, or a table with the first value, the last value and the count.
    """
    if not isinstance(grid_axis_setting, dict):
        return _parse_value_list(
            parameter_name, grid_axis_setting, " or { from = ..., to = ..., count = ... }"
        )
    _require_known_keys(grid_axis_setting, _GRID_AXIS_KEYS, f"the axis of {parameter_name}", "keys")
    for axis_key in _GRID_AXIS_KEYS:
        if axis_key not in grid_axis_setting:
            raise ValueError(
                f"the axis of {parameter_name} has no '{axis_key}': write {parameter_name} = "
                "{ from = ..., to = ..., count = ... }."
            )
    first_axis_value, last_axis_value = (
        _parse_parameter_value(parameter_name, grid_axis_setting[grid_axis_key])
        for grid_axis_key in ("from", "to")
    )
    n_axis_values = _parse_whole_number(f"count of {parameter_name}", grid_axis_setting["count"])
    if n_axis_values > MAX_LISTED_SAMPLES:
        raise ValueError(
            f"the axis of {parameter_name} has {n_axis_values:,} values, but "
            f"{MAX_LISTED_SAMPLES:,} is the most: give fewer."
        )
    return np.linspace(first_axis_value, last_axis_value, n_axis_values)


def _parse_value_list(
    parameter_name: str, config_value_list: object, alternative_text: str = ""
) -> tuple[float, ...]:
    """Return a list of numbers as a tuple. They must lie in the domain of the parameter."""
    return _parse_numbers(
        parameter_name,
        config_value_list,
        f"a list of numbers{alternative_text}",
        parse_number=_parse_parameter_value,
    )


def _parse_parameter_range(
    range_name: str, config_range: object, parameter_name: str = ""
) -> tuple[float, float]:
    """Return the lower and the upper bound of a range. They must lie in the domain of a parameter.

    The default of `parameter_name` is `range_name`.
    """
    lower_bound, upper_bound = _parse_numbers(
        range_name,
        config_range,
        f"a range of two numbers: write {range_name} = [lower, upper]",
        2,
        lambda _, bound_value: _parse_parameter_value(parameter_name or range_name, bound_value),
    )
    return lower_bound, upper_bound


def _parse_parameter_value(parameter_name: str, config_value: object) -> float:
    """Return a value as a number.

    Raise a ValueError if it is not in the domain of the parameter.
    """
    if parameter_name == FRICTION_NAME:
        return _parse_positive_number(parameter_name, config_value)
    parameter_value = _parse_finite_number(parameter_name, config_value)
    # A sample outside the domain of a leg force is BAD_INPUT.
    if parameter_name in PARAMETER_DOMAINS:
        PARAMETER_DOMAINS[parameter_name].require_value_in_domain(parameter_name, parameter_value)
    return parameter_value


def _parse_names(setting_name: str, config_value: object) -> tuple[str, ...]:
    """Return a list of names as a tuple. Raise a ValueError if it is not a list of names."""
    if not isinstance(config_value, list) or not all(
        isinstance(name, str) for name in config_value
    ):
        requirement_text = f'a list of names: write {setting_name} = ["dls_fraction", "speed"]'
        raise _make_value_error(setting_name, config_value, requirement_text)
    return tuple(config_value)


def _parse_numbers_by_name(
    setting_name: str, config_value: object, requirement_text: str
) -> dict[str, float]:
    """Return the numbers in a table, by name. Raise a ValueError if the value is no such table."""
    if not isinstance(config_value, dict):
        raise _make_value_error(setting_name, config_value, requirement_text)
    return {name: _parse_finite_number(name, number) for name, number in config_value.items()}


def _parse_positive_number(setting_name: str, config_value: object) -> float:
    """Return a value as a float. Raise a ValueError if it is not a positive finite number."""
    positive_number = _parse_finite_number(setting_name, config_value)
    if not positive_number > 0:
        raise ValueError(f"{setting_name} is {positive_number:g}, but it must be positive.")
    return positive_number


def _parse_finite_number(setting_name: str, config_value: object) -> float:
    """Return a value as a finite float. Raise a ValueError if it is not a finite number."""
    finite_number = math.nan
    if isinstance(config_value, int | float) and not isinstance(config_value, bool):
        # An integer of hundreds of digits is too large for a float.
        with contextlib.suppress(OverflowError):
            finite_number = float(config_value)
    if not math.isfinite(finite_number):
        raise _make_value_error(setting_name, config_value, "a finite number")
    return finite_number


def _parse_numbers(
    setting_name: str,
    config_value: object,
    requirement_text: str,
    length: int | None = None,
    parse_number: Callable[[str, Any], float] = _parse_finite_number,
) -> tuple[float, ...]:
    """Return a list of numbers as a tuple. Raise a ValueError if it is no list of that length."""
    if not isinstance(config_value, list) or length not in (None, len(config_value)):
        raise _make_value_error(setting_name, config_value, requirement_text)
    return tuple(parse_number(setting_name, number) for number in config_value)


def _parse_whole_number(
    setting_name: str,
    config_value: object,
    min_value: int = 1,
    max_value: int = MAX_CONFIG_INTEGER,
) -> int:
    """Return a value as an integer. Raise a ValueError if it is not an integer from `min_value` to
    `max_value`.
    """
    if (
        isinstance(config_value, bool)
        or not isinstance(config_value, int)
        or config_value < min_value
    ):
        raise _make_value_error(
            setting_name, config_value, f"a whole number of at least {min_value}"
        )
    if config_value > max_value:
        raise _make_value_error(setting_name, config_value, f"at most {max_value:,}")
    return config_value


def _parse_settings(
    config_table: ConfigTable,
    table_location: str,
    **parser_by_key: Callable[[str, Any], Any],
) -> dict[str, Any]:
    """Return the parsed settings of a table, by key. Each parser takes the key and the value.

    Raise a ValueError if a key has no parser.
    """
    _require_known_keys(config_table, parser_by_key, table_location, "settings")
    return {
        config_key: parser_by_key[config_key](config_key, config_value)
        for config_key, config_value in config_table.items()
    }


def _require_known_keys(
    config_table: ConfigTable,
    allowed_keys: Iterable[str],
    table_location: str,
    key_kind: str,
) -> None:
    """Raise a ValueError if a table contains a key that is not allowed."""
    allowed_keys = tuple(allowed_keys)
    for config_key in config_table:
        raise_for_parameter_symbol(config_key, allowed_keys)
        if config_key not in allowed_keys:
            raise ValueError(
                f"{table_location} has the unknown key "
                f"'{config_key}'{format_name_suggestion(config_key, allowed_keys)}: "
                f"its {key_kind} are {', '.join(allowed_keys)}."
            )


def _make_value_error(setting_name: str, config_value: object, requirement_text: str) -> ValueError:
    """Return an error that states that a value does not satisfy a requirement.

    The message contains the value as written in TOML.
    """
    value_text = format_value(config_value)
    if isinstance(config_value, bool):
        value_text = value_text.lower()
    elif isinstance(config_value, str):
        value_text = value_text.replace("'", '"')
    return ValueError(f"{setting_name} is {value_text}, but it must be {requirement_text}.")
