"""Configs: TOML files that define a wheel, samples and measures.

An error in a file is reported in one sentence that states the given value, the allowed values and
the remedy.
"""

import contextlib
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from vrw_jax.cycles import CycleOptions
from vrw_jax.models import AbstractWheel, GaitMethod
from vrw_jax.numerics import StepOptions
from vrw_jax.scans import (
    MAX_LISTED_SAMPLES,
    MEASURE_CATALOGS,
    TOLERANCE_MEASURE_CATALOG,
    add_passage_measures,
    check_measure_names,
)
from vrw_jax.scans import design as designs
from vrw_jax.selection import find_model_class, list_model_config_names
from vrw_jax.validation import check_range, format_name_suggestion, format_value, require_known_name
from vrw_jax.wheel import (
    FRICTION_NAME,
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    WheelParams,
    check_parameter_name,
    parameter_sets,
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
    *DESIGN_TABLE_NAMES,
)
_STEP_OPTION_KEYS = tuple(StepOptions.__dataclass_fields__)
PARAMETER_SET_KEY = "parameter_set"
"""Key of `[wheel]` that names a parameter set. Other keys of the table replace values of this
set.
"""
_GRID_AXIS_KEYS = ("from", "to", "count")

MAX_CONFIG_INTEGER = 2**53
"""Largest integer in a config, chosen because floats represent all integers up to it."""

MAX_CONFIG_LEGS = 1_000
"""Largest number of legs in a config, chosen because results have one value per leg and sample."""

RENAMED_CONFIG_KEYS = {
    "[model]": {"rung": "name"},
    "[options]": {
        "first_step": "dt0",
        "event_steps": "max_event_iterations",
        "monitor_steps": "max_margin_search_iterations",
    },
    "[branch]": {"largest_step": "max_ds"},
}
"""New names of renamed keys, by table and old key. A config with an old key raises an error."""


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
    def from_table(
        cls, config_table: Mapping[str, object], model_class: type[AbstractWheel]
    ) -> "ScanConfig":
        """Read the settings of the table `[scan]`.

        Raise a ValueError if the model does not have a requested measure.
        """
        _require_known_keys(config_table, cls.__dataclass_fields__, "[scan]", "settings")
        measure_names = config_table.get("measures")
        slope_sd = config_table.get("slope_sd")
        if measure_names is not None:
            if not (
                isinstance(measure_names, list)
                and all(isinstance(measure_name, str) for measure_name in measure_names)
            ):
                requirement_text = 'a list of names: write measures = ["dls_fraction", "speed"]'
                raise _make_value_error("measures", measure_names, requirement_text)
            measure_catalog = (
                MEASURE_CATALOGS.get(
                    model_class.capabilities.gait_method, MEASURE_CATALOGS[GaitMethod.COLLOCATION]
                )
                if "tol" not in config_table
                else TOLERANCE_MEASURE_CATALOG
            )
            if slope_sd is not None and "tol" not in config_table:
                measure_catalog = add_passage_measures(measure_catalog)
            check_measure_names(measure_names, measure_catalog)
            measure_names = tuple(measure_names)
        chunk_size = config_table.get("chunk")
        error_tolerance = config_table.get("tol")
        return cls(
            measure_names,
            None if chunk_size is None else _parse_whole_number(chunk_size, "chunk", 1),
            None
            if error_tolerance is None
            else _parse_finite_number(error_tolerance, "tol", must_be_positive=True),
            None
            if slope_sd is None
            else _parse_finite_number(slope_sd, "slope_sd", must_be_positive=True),
            None
            if "mesh_intervals" not in config_table
            else CycleOptions(mesh_intervals=config_table["mesh_intervals"]).mesh_intervals,  # type: ignore[arg-type]
        )

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
    def from_table(cls, config_table: Mapping[str, object]) -> "GaitConfig":
        """Read the settings of the table `[gait]`."""
        _require_known_keys(config_table, cls.__dataclass_fields__, "[gait]", "settings")
        n_steps = _parse_whole_number(config_table.get("steps", cls.steps), "steps", 1)
        start_state = config_table.get("start")
        if start_state is None:
            return cls(n_steps)
        if not (isinstance(start_state, list) and len(start_state) == 3):
            requirement_text = (
                "the section state before touchdown, three numbers: angle in rad, angular rate in "
            )
            raise _make_value_error(
                "start", start_state, requirement_text + "rad/s, rate of Leg 1 in m/s"
            )
        theta, dtheta, dL1 = (
            _parse_finite_number(state_component, "start") for state_component in start_state
        )
        return cls(n_steps, (theta, dtheta, dL1))


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
    def from_table(cls, config_table: Mapping[str, object]) -> "TuneConfig":
        """Read the settings of the table `[tune]` and of its subtables."""
        _require_known_keys(config_table, cls.__dataclass_fields__, "[tune]", "settings")
        objective_setting = config_table.get("objective", cls.objective)
        if isinstance(objective_setting, dict):
            objective_setting = {
                key_name: _parse_finite_number(config_value, key_name)
                for key_name, config_value in objective_setting.items()
            }
        elif not isinstance(objective_setting, str):
            requirement_text = (
                'a measure or weights of several: write objective = "dls_fraction" or objective = '
            )
            raise _make_value_error(
                "objective",
                objective_setting,
                requirement_text + "{ dls_fraction = 1.0, speed = 0.1 }",
            )
        bounds_table = config_table.get("bounds")
        if not isinstance(bounds_table, dict) or not bounds_table:
            raise ValueError(
                "[tune] has no free parameter, but it needs at least one: add [tune.bounds] with "
                "lines such as damping = [20.0, 215.0]."
            )
        _require_known_keys(bounds_table, PARAMETER_NAMES, "[tune.bounds]", "parameters")
        constraints_table = config_table.get("constraints")
        if constraints_table is not None:
            if not isinstance(constraints_table, dict):
                requirement_text = "a table: write [tune.constraints] and below it lines such as "
                raise _make_value_error(
                    "constraints", constraints_table, requirement_text + "clearance_sls1 = 0.001"
                )
            constraints_table = {
                key_name: _parse_finite_number(config_value, key_name)
                for key_name, config_value in constraints_table.items()
            }
        return cls(
            objective=objective_setting,
            bounds={
                key_name: _parse_parameter_range(key_name, config_value)
                for key_name, config_value in bounds_table.items()
            },
            constraints=constraints_table,
            evaluations=_parse_whole_number(
                config_table.get("evaluations", cls.evaluations), "evaluations", 1
            ),
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
        cls, config_table: Mapping[str, object], allowed_parameter_names: tuple[str, ...]
    ) -> "BranchConfig":
        """Read the settings of the table `[branch]`.

        Its parameter must be one of `allowed_parameter_names`.
        """
        _reject_renamed_keys(config_table, "[branch]")
        _require_known_keys(config_table, cls.__dataclass_fields__, "[branch]", "settings")
        branch_parameter = config_table.get("parameter")
        check_parameter_name(
            branch_parameter,
            allowed_parameter_names,
            "parameter that a branch of this model runs along",
        )
        assert isinstance(branch_parameter, str)
        if "bounds" not in config_table:
            raise ValueError("[branch] has no bounds: write bounds = [4.0, 230.0], say.")
        parameter_bounds = check_range(
            "bounds",
            _parse_parameter_range(
                "bounds of " + branch_parameter, config_table["bounds"], branch_parameter
            ),
        )
        max_ds = None
        if "max_ds" in config_table:
            max_ds = _parse_finite_number(config_table["max_ds"], "max_ds", must_be_positive=True)
            if max_ds > 1.0:
                raise ValueError(
                    f"max_ds is {max_ds:g}, but it is a share of the range: give 0.02, say."
                )
        return cls(
            parameter=branch_parameter,
            bounds=parameter_bounds,
            period=_parse_whole_number(config_table.get("period", cls.period), "period", 1),
            max_ds=max_ds,
        )


@dataclass(frozen=True)
class Config:
    """Validated settings from a config, and the text of the file."""

    wheel_values: Mapping[str, float | int] = field(default_factory=dict)
    model_name: str = "viscoelastic"
    model_settings: Mapping[str, float | int | str | bool] = field(default_factory=dict)
    step_option_values: Mapping[str, float | int | str | bool] = field(default_factory=dict)
    scan: ScanConfig = ScanConfig()
    gait: GaitConfig = GaitConfig()
    tune: TuneConfig | None = None
    branch: BranchConfig | None = None
    design: designs.AbstractSampleDesign | None = None
    source_text: str = ""
    file_name: str = ""

    def make_wheel(self, changed_values: Mapping[str, float | int] | None = None) -> WheelParams:
        """Return the wheel of Table 1 of the paper with the parameters of the config.

        `changed_values` replaces parameters of the config.
        """
        parameter_values: dict[str, Any] = {**self.wheel_values, **(changed_values or {})}
        return WheelParams(**parameter_values)

    def make_model(self) -> AbstractWheel:
        """Return the model with the settings from the config."""
        return find_model_class(self.model_name)(**self.model_settings)

    def make_options(self) -> StepOptions:
        """Return the numerical options of the walking steps."""
        step_option_values: dict[str, Any] = {**self.step_option_values}
        return StepOptions(**step_option_values)


def load_config(config_path: str | Path) -> Config:
    """Read and validate a config file. Raise a ValueError if the file is invalid."""
    config_path = Path(config_path)
    if not config_path.exists():
        name_suggestion = format_name_suggestion(
            config_path.name,
            (neighbor_path.name for neighbor_path in config_path.parent.glob("*.toml")),
        )
        raise ValueError(
            f"there is no config file {config_path}{name_suggestion}: give the path of a TOML "
            "file, "
            "such as configs/quickstart.toml, which `vrw init` writes."
        )
    if config_path.is_dir():
        raise ValueError(f"{config_path} is a folder, but a config is a TOML file: give its path.")
    try:
        config_text = config_path.read_text(encoding="utf-8")
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
            f"two."
        ) from config_error
    try:
        return _parse_config_tables(config_tables, config_text, file_name)
    except ValueError as config_error:
        raise ValueError(f"{file_name}: {config_error}") from config_error


def _parse_config_tables(
    config_tables: Mapping[str, object], config_text: str, file_name: str
) -> Config:
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
    model_name, model_settings = _parse_model_table(_get_config_table(config_tables, "model"))
    model_class = find_model_class(model_name)
    parameter_names = model_class.parameter_names
    sample_design = (
        _parse_design_table(
            design_kinds[0], _get_config_table(config_tables, design_kinds[0]), parameter_names
        )
        if design_kinds
        else None
    )
    wheel_values = _parse_wheel_table(_get_config_table(config_tables, "wheel"))
    duplicate_parameter_names = [
        parameter_name
        for parameter_name in _get_config_table(config_tables, "wheel")
        if sample_design is not None and parameter_name in sample_design.swept_parameters
    ]
    if duplicate_parameter_names:
        raise ValueError(
            f"{duplicate_parameter_names[0]} is fixed in [wheel] and swept in "
            f"[{design_kinds[0]}], but it can only be one: drop one of the two."
        )
    options_table = _get_config_table(config_tables, "options")
    _reject_renamed_keys(options_table, "[options]")
    _require_known_keys(options_table, _STEP_OPTION_KEYS, "[options]", "options")
    default_options = {
        option_name: getattr(StepOptions(), option_name) for option_name in _STEP_OPTION_KEYS
    }
    step_option_values = _parse_with_default_types(options_table, default_options)
    checked_config = Config(
        wheel_values=wheel_values,
        model_name=model_name,
        model_settings=model_settings,
        step_option_values=step_option_values,
        scan=ScanConfig.from_table(_get_config_table(config_tables, "scan"), model_class),
        gait=GaitConfig.from_table(_get_config_table(config_tables, "gait")),
        tune=TuneConfig.from_table(_get_config_table(config_tables, "tune"))
        if "tune" in config_tables
        else None,
        branch=BranchConfig.from_table(_get_config_table(config_tables, "branch"), parameter_names)
        if "branch" in config_tables
        else None,
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
    step_options = checked_config.make_options()
    step_options.check_tolerances(np.dtype(float))
    return checked_config


def _get_config_table(config_tables: Mapping[str, object], table_name: str) -> dict[str, object]:
    """Return a table of the file, or an empty table if the file does not contain this table."""
    config_table = config_tables.get(table_name, {})
    assert isinstance(config_table, dict)
    return config_table


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


def _parse_wheel_table(config_table: Mapping[str, object]) -> dict[str, float | int]:
    """Return the parameters in the table `[wheel]`, by name."""
    known_wheel_keys = (*PARAMETER_NAMES, "n_legs", PARAMETER_SET_KEY)
    _require_known_keys(config_table, known_wheel_keys, "[wheel]", "parameters")
    parameter_values: dict[str, float | int] = {}
    if (parameter_set_name := config_table.get(PARAMETER_SET_KEY)) is not None:
        require_known_name(parameter_set_name, tuple(parameter_sets), "parameter set")
        parameter_values |= parameter_sets[str(parameter_set_name)].values
    for parameter_name, config_value in config_table.items():
        if parameter_name == PARAMETER_SET_KEY:
            continue
        if parameter_name == "n_legs":
            parameter_values[parameter_name] = _parse_whole_number(config_value, parameter_name, 5)
            if parameter_values[parameter_name] > MAX_CONFIG_LEGS:
                raise _make_value_error(
                    parameter_name, config_value, f"at most {MAX_CONFIG_LEGS:,}"
                )
        else:
            parameter_values[parameter_name] = _parse_parameter_value(parameter_name, config_value)
    return parameter_values


def _parse_model_table(
    config_table: Mapping[str, object],
) -> tuple[str, dict[str, float | int | str | bool]]:
    """Return the name of the model in the table `[model]`, and the model's settings."""
    _reject_renamed_keys(config_table, "[model]")
    model_name = config_table.get("name", Config.model_name)
    require_known_name(model_name, list_model_config_names(), "model")
    assert isinstance(model_name, str)
    default_settings = {
        model_field_definition.name: model_field_definition.default
        for model_field_definition in fields(find_model_class(model_name))
    }
    _require_known_keys(
        config_table, ("name", *default_settings), f'[model] with name = "{model_name}"', "settings"
    )
    model_settings = {
        setting_name: setting_value
        for setting_name, setting_value in config_table.items()
        if setting_name != "name"
    }
    return model_name, _parse_with_default_types(model_settings, default_settings)


def _parse_with_default_types(
    config_table: Mapping[str, object], default_setting_values: Mapping[str, object]
) -> dict[str, float | int | str | bool]:
    """Return the settings, converted to the types of their default values. Numbers must be
    positive.
    """
    parsed_settings: dict[str, float | int | str | bool] = {}
    for setting_name, config_value in config_table.items():
        default_value = default_setting_values[setting_name]
        if isinstance(default_value, bool):
            if not isinstance(config_value, bool):
                raise _make_value_error(setting_name, config_value, "true or false")
            parsed_settings[setting_name] = config_value
        elif isinstance(default_value, str):
            if not isinstance(config_value, str):
                raise _make_value_error(setting_name, config_value, f'a name, "{default_value}"')
            parsed_settings[setting_name] = config_value
        elif isinstance(default_value, int):
            parsed_settings[setting_name] = _parse_whole_number(config_value, setting_name, 1)
        elif setting_name == FRICTION_NAME and config_value == math.inf:
            # Infinite friction means that feet do not slip.
            parsed_settings[setting_name] = math.inf
        else:
            parsed_settings[setting_name] = _parse_finite_number(
                config_value, setting_name, must_be_positive=True
            )
    return parsed_settings


def _parse_design_table(
    design_kind: str, config_table: Mapping[str, object], allowed_parameter_names: tuple[str, ...]
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
    swept_settings = {
        parameter_name: config_value
        for parameter_name, config_value in config_table.items()
        if parameter_name not in design_setting_keys
    }
    if design_setting_keys:
        if "n" not in config_table:
            raise ValueError(f"[{design_kind}] has no number of samples: write n = 4096, say.")
        n, random_seed = (
            _parse_whole_number(config_table["n"], "n", 1),
            _parse_whole_number(config_table.get("seed", 0), "seed", 0),
        )
        parameter_ranges = {
            parameter_name: _parse_parameter_range(parameter_name, config_value)
            for parameter_name, config_value in swept_settings.items()
        }
        return RANDOM_DESIGN_FUNCTIONS[design_kind](parameter_ranges, n, random_seed)
    if design_kind == "grid":
        return designs.grid(
            **{
                parameter_name: _parse_grid_axis(parameter_name, config_value)
                for parameter_name, config_value in swept_settings.items()
            }
        )
    return designs.samples(
        {
            parameter_name: _parse_value_list(parameter_name, config_value)
            for parameter_name, config_value in swept_settings.items()
        }
    )


def _parse_grid_axis(parameter_name: str, grid_axis_setting: object) -> np.ndarray:
    """Return the values on an axis of a grid.

    The setting is a list of values, or a table with the first value, the last value and the count.
    """
    if not isinstance(grid_axis_setting, dict):
        return _parse_value_list(
            parameter_name, grid_axis_setting, " or { from = ..., to = ..., count = ... }"
        )
    _require_known_keys(grid_axis_setting, _GRID_AXIS_KEYS, f"the axis of {parameter_name}", "keys")
    missing_axis_keys = [
        grid_axis_key for grid_axis_key in _GRID_AXIS_KEYS if grid_axis_key not in grid_axis_setting
    ]
    if missing_axis_keys:
        raise ValueError(
            f"the axis of {parameter_name} has no '{missing_axis_keys[0]}': "
            f"write {parameter_name} = {{ from = ..., to = ..., count = ... }}."
        )
    first_axis_value, last_axis_value = (
        _parse_parameter_value(parameter_name, grid_axis_setting[grid_axis_key])
        for grid_axis_key in ("from", "to")
    )
    n_axis_values = _parse_whole_number(grid_axis_setting["count"], f"count of {parameter_name}", 1)
    if n_axis_values > MAX_LISTED_SAMPLES:
        raise ValueError(
            f"the axis of {parameter_name} has {n_axis_values:,} values, but "
            f"{MAX_LISTED_SAMPLES:,} is the most: "
            "give fewer."
        )
    return np.linspace(first_axis_value, last_axis_value, n_axis_values)


def _parse_value_list(
    parameter_name: str, config_value_list: object, alternative_text: str = ""
) -> np.ndarray:
    """Return an array of numbers from a list. They must lie in the domain of the parameter."""
    if not isinstance(config_value_list, list):
        raise _make_value_error(
            parameter_name, config_value_list, f"a list of numbers{alternative_text}"
        )
    return np.asarray(
        [_parse_parameter_value(parameter_name, config_value) for config_value in config_value_list]
    )


def _parse_parameter_range(
    range_name: str, config_range: object, parameter_name: str = ""
) -> tuple[float, float]:
    """Return the lower and the upper bound of a range. They must lie in the domain of a parameter.

    The default of `parameter_name` is `range_name`.
    """
    if not (isinstance(config_range, list) and len(config_range) == 2):
        raise _make_value_error(
            range_name, config_range, f"a range of two numbers: write {range_name} = [lower, upper]"
        )
    lower_bound, upper_bound = (
        _parse_parameter_value(parameter_name or range_name, bound_value)
        for bound_value in config_range
    )
    return lower_bound, upper_bound


def _parse_parameter_value(parameter_name: str, config_value: object) -> float:
    """Return a value as a number.

    Raise a ValueError if it is not in the domain of the parameter.
    """
    parameter_value = _parse_finite_number(
        config_value, parameter_name, must_be_positive=parameter_name == FRICTION_NAME
    )
    if parameter_name != FRICTION_NAME:
        PARAMETER_DOMAINS[parameter_name].require_value_in_domain(parameter_name, parameter_value)
    return parameter_value


def _parse_finite_number(
    config_value: object, setting_name: str, must_be_positive: bool = False
) -> float:
    """Return a value as a finite float. Raise a ValueError if it is not a finite number."""
    finite_number = math.nan
    if isinstance(config_value, int | float) and not isinstance(config_value, bool):
        # An integer of hundreds of digits is too large for a float.
        with contextlib.suppress(OverflowError):
            finite_number = float(config_value)
    if not math.isfinite(finite_number):
        raise _make_value_error(setting_name, config_value, "a finite number")
    if must_be_positive and not finite_number > 0:
        raise ValueError(f"{setting_name} is {finite_number:g}, but it must be positive.")
    return finite_number


def _parse_whole_number(config_value: object, setting_name: str, min_value: int) -> int:
    """Return a value as an integer. Raise a ValueError if it is not an integer of at least
    `min_value`.
    """
    if (
        isinstance(config_value, bool)
        or not isinstance(config_value, int)
        or config_value < min_value
    ):
        raise _make_value_error(
            setting_name, config_value, f"a whole number of at least {min_value}"
        )
    if config_value > MAX_CONFIG_INTEGER:
        raise _make_value_error(setting_name, config_value, f"at most {MAX_CONFIG_INTEGER:,}")
    return config_value


def _require_known_keys(
    config_table: Mapping[str, object],
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


def _reject_renamed_keys(config_table: Mapping[str, object], table_location: str) -> None:
    """Raise a ValueError if a table contains a key that has a new name."""
    for old_key, new_key in RENAMED_CONFIG_KEYS[table_location].items():
        if old_key in config_table:
            raise ValueError(
                f"{table_location} has the old key '{old_key}': write {new_key} in its place."
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
