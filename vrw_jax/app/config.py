"""Configs: TOML files that define a wheel, samples and measures.

pydantic checks the tables. An error in a file is reported in one sentence that states the given
value, the allowed values and the remedy.
"""

import dataclasses
import importlib.util
import math
import sys
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    Strict,
    TypeAdapter,
    ValidationError,
    WrapValidator,
)
from pydantic.dataclasses import dataclass
from pydantic_core import PydanticCustomError

from vrw_jax.base.checks import (
    check_path,
    check_range,
    format_name_suggestion,
    format_value,
    require_known_name,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.gaits.cycle import CycleOptions
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.ladder import MODEL_CLASSES, list_model_config_names
from vrw_jax.studies import scan_design as designs
from vrw_jax.studies.measure_catalog import check_measure_names, select_measure_catalog
from vrw_jax.studies.scan_design import MAX_LISTED_SAMPLES
from vrw_jax.studies.tuning import TuneResult, tune
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
    "wheel", "model", "options", "gait", "scan", "tune", "branch", "figures", *DESIGN_TABLE_NAMES,
)  # fmt: skip
FIELDS_WITHOUT_KEY = frozenset(["uneven"])
"""Fields of models that are no keys of a config."""
PARAMETER_SET_KEY = "parameter_set"
"""Key of `[wheel]` that names a parameter set. Other keys of the table replace values of this
set.
"""
ConfigTable = Mapping[str, Any]
"""Table of a config, as read from TOML."""

MAX_CONFIG_INTEGER = 2**53
"""Largest integer in a config, chosen because floats represent all integers up to it."""

MAX_CONFIG_LEGS = 1_000
"""Largest number of legs in a config, chosen because results have one value per leg and sample."""


def _must_be(requirement: str) -> WrapValidator:
    """Return a validator with the error that a value must be `requirement`."""

    def check(value: Any, validate: Any) -> Any:
        try:
            return validate(value)
        except ValidationError as error:
            if _find_explained_error(error):
                raise
            raise PydanticCustomError("requirement", "{text}", {"text": requirement}) from error

    return WrapValidator(check)


def _find_explained_error(error: ValidationError) -> Any:
    """Return the first error with a requirement or a sentence, or None."""
    return next((e for e in error.errors() if e["type"] in ("requirement", "value_error")), None)


def _read(kind: Any, value: Any, name: str = "") -> Any:
    """Return the value as an object of a type. Raise a ValueError with one sentence otherwise."""
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        details = _find_explained_error(error)
        if details["type"] == "value_error":
            raise ValueError(str(details["ctx"]["error"])) from error
        keys = [key for key in details["loc"] if isinstance(key, str)]
        raise _make_value_error(
            name or keys[-1], details["input"], details["ctx"]["text"]
        ) from error


def _limit(minimum: int, maximum: int = MAX_CONFIG_INTEGER) -> tuple[Any, ...]:
    """Return validators of integers from `minimum` to `maximum`."""
    return (
        Strict(),
        Field(ge=minimum),
        _must_be(f"a whole number of at least {minimum}"),
        Field(le=maximum),
        _must_be(f"at most {maximum:,}"),
    )


Finite = Annotated[float, Strict(), Field(allow_inf_nan=False), _must_be("a finite number")]
Positive = Annotated[Finite, Field(gt=0.0), _must_be("positive")]
Whole = Annotated[int, *_limit(1)]
Range = Annotated[tuple[Finite, Finite], _must_be("a range of two numbers: write [lower, upper]")]
Values = Annotated[tuple[Finite, ...], _must_be("a list of numbers")]
AxisValues = Annotated[
    tuple[Finite, ...], _must_be("a list of numbers or { from = ..., to = ..., count = ... }")
]
Measures = Annotated[tuple[str, ...], _must_be('a list of names: write ["dls_fraction", "speed"]')]
MeshIntervals = Annotated[
    tuple[Whole, Whole, Whole],
    _must_be("three whole numbers, the intervals of DLS, SLS-I and SLS-II: write [10, 8, 3]"),
]
SectionState = Annotated[
    tuple[Finite, Finite, Finite],
    _must_be(
        "the section state before touchdown, three numbers: angle in rad, angular rate in rad/s, "
        "rate of Leg 1 in m/s"
    ),
]
Objective = Annotated[
    str | dict[str, Finite],
    _must_be(
        'a measure or weights of several: write objective = "dls_fraction" or objective = '
        "{ dls_fraction = 1.0, speed = 0.1 }"
    ),
]
Constraints = Annotated[
    dict[str, Finite],
    _must_be("a table: write [tune.constraints] and below it lines such as clearance_sls1 = 0.001"),
]


def _read_bounds(bounds: Any) -> Any:
    if not isinstance(bounds, dict) or not bounds:
        raise ValueError(
            "[tune] has no free parameter, but it needs at least one: add [tune.bounds] "
            "with lines such as damping = [20.0, 215.0]."
        )
    _require_known_keys(bounds, PARAMETER_NAMES, "[tune.bounds]", "parameters")
    return _read_parameters(bounds, Range)


Bounds = Annotated[Mapping[str, tuple[float, float]], BeforeValidator(_read_bounds)]


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

    measures: Measures | None = None
    chunk: Whole | None = None
    tol: Positive | None = None
    slope_sd: Positive | None = None
    mesh_intervals: MeshIntervals | None = None

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

    steps: Whole = 30
    start: SectionState | None = None

    def make_start(self, params: WheelParams, model: AbstractWheel) -> jax.Array:
        """Return the section state of the model from which a walk begins."""
        start = model.compute_default_start(params) if self.start is None else self.start
        return model.complete_section_state(params, jnp.asarray(start))


@dataclass(frozen=True)
class TuneConfig:
    """Table `[tune]`: objective, bounds and constraints of a tuning run.

    - `objective`: name of a measure, or weights of measures, { dls_fraction = 1.0, speed = 0.1 };
    - `bounds`: table [tune.bounds] of the free parameters, such as damping = [20.0, 215.0];
    - `constraints`: table [tune.constraints] with the smallest allowed values of measures; by
      default every margin that the model can satisfy;
    - `evaluations`: largest number of evaluated gaits.
    """

    objective: Objective = "dls_fraction"
    bounds: Bounds = dataclasses.field(default_factory=dict)
    constraints: Constraints | None = None
    evaluations: Whole = 200

    def tune_wheel(self, params: WheelParams, **arguments: Any) -> TuneResult:
        """Return the tuned wheel. The other arguments are those of `vrw.tune`."""
        return tune(
            params,
            self.objective,
            tuple(self.bounds),
            self.bounds,
            self.constraints,
            max_evaluations=self.evaluations,
            **arguments,
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
    bounds: Range
    period: Whole = 1
    max_ds: (
        Annotated[Positive, Field(le=1.0), _must_be("a share of the range, at most 1: give 0.02")]
        | None
    ) = None


FIGURE_FORMATS = ("svg", "png", "pdf")
"""File formats in which commands write figures."""


def is_figure_file(path: Path) -> bool:
    """Return whether a path is the path of a figure.

    Raise a ValueError for formats of images that are not supported.
    """
    if path.suffix.lower() in (".eps", ".ps", ".jpg", ".jpeg", ".tif", ".tiff", ".gif"):
        raise ValueError(
            f"{path} has the suffix {path.suffix}, but figures are written as .pdf, .svg or .png: "
            "give one of these suffixes, or a folder."
        )
    return path.suffix[1:].lower() in FIGURE_FORMATS


def _check_width(width: Any) -> Any:
    from vrw_jax.app import figure_style as style

    try:
        style.find_width_inches(width, 1.0)
    except TypeError as width_error:
        raise ValueError(str(width_error)) from width_error
    return width


def _check_figure_file(path: Path) -> Path:
    if not is_figure_file(path):
        raise AssertionError  # pydantic catches it.
    return path.expanduser()


@dataclass(frozen=True)
class FigureConfig:
    """Table `[figures]`: width and files of the figures.

    - `width`: "column" (86 mm), "page" (175 mm), or a number of mm; by default the usual width of
      each figure;
    - `formats`: file formats in the folder of the result, of "svg", "png" and "pdf";
    - `file`: path of the figure, such as "fig3.pdf", instead of files in the folder of the result.
      If there are several figures, their names follow the name of the file.
    """

    width: Annotated[Any, AfterValidator(_check_width)] = None
    formats: Annotated[
        tuple[Annotated[str, Field(pattern="^(svg|png|pdf)$")], ...],
        Field(min_length=1),
        _must_be('a list of "svg", "png" and "pdf"'),
    ] = ("svg", "png")
    file: (
        Annotated[Path, AfterValidator(_check_figure_file), _must_be('a path, such as "fig3.pdf"')]
        | None
    ) = None

    def list_files(self, figure_name: str, folder: Path, is_only_figure: bool) -> list[Path]:
        """Return the files of a figure, which are in `folder` unless the config names a file."""
        if self.file is None:
            return [folder / f"{figure_name}.{figure_format}" for figure_format in self.formats]
        return [
            self.file if is_only_figure else self.file.with_stem(f"{self.file.stem}_{figure_name}")
        ]


@dataclasses.dataclass(frozen=True)
class Config:
    """Validated settings from a config, and the text of the file."""

    wheel_values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    model_name: str = "viscoelastic"
    model_settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    step_option_values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    scan: ScanConfig = dataclasses.field(default_factory=ScanConfig)
    gait: GaitConfig = dataclasses.field(default_factory=GaitConfig)
    tune: TuneConfig | None = None
    branch: BranchConfig | None = None
    figures: FigureConfig = dataclasses.field(default_factory=FigureConfig)
    design: designs.SampleDesign | None = None
    source_text: str = ""
    file_name: str = ""

    def make_wheel(self, changed_values: Mapping[str, float | int] | None = None) -> WheelParams:
        """Return the wheel of Table 1 of the paper with the parameters of the config.

        `changed_values` replaces parameters of the config.
        """
        return WheelParams(**{**self.wheel_values, **(changed_values or {})})

    def make_model(self) -> AbstractWheel:
        """Return the model with the settings from the config."""
        return MODEL_CLASSES[self.model_name](**self.model_settings)

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
    _require_known_keys(config_tables, CONFIG_TABLE_NAMES, "the file", "tables")
    for name, table in config_tables.items():
        remedy = f"a table: write [{name}] on a line of its own and its settings below"
        _read(Annotated[dict, _must_be(remedy)], table, f"[{name}]")
    design_kinds = [kind for kind in DESIGN_TABLE_NAMES if kind in config_tables]
    if len(design_kinds) > 1:
        raise ValueError(
            f"[{design_kinds[0]}] and [{design_kinds[1]}] are both given, but a scan has one "
            "design: keep one."
        )
    tables: dict[str, Any] = {name: {} for name in CONFIG_TABLE_NAMES} | dict(config_tables)
    wheel_values = _parse_wheel_table(tables["wheel"])
    model_table = {"name": Config.model_name, **tables["model"]}
    require_known_name(model_name := model_table.pop("name"), list_model_config_names(), "model")
    model_class = MODEL_CLASSES[model_name]
    defaults = {
        field.name: field.default
        for field in dataclasses.fields(model_class)
        if field.name not in FIELDS_WITHOUT_KEY
    }
    _require_known_keys(
        model_table, ("name", *defaults), f'[model] with name = "{model_name}"', "settings"
    )
    laws = {
        name: _load_law(model_class, name, model_table.pop(name))
        for name in LAW_NAMES
        if name in model_table
    }
    model = model_class(**laws)
    design = None
    for kind in design_kinds:
        design = _parse_design_table(kind, tables[kind], model.parameter_names)
        for name in set(design.swept_parameters) & set(tables["wheel"]):
            raise ValueError(
                f"{name} is fixed in [wheel] and swept in [{kind}], but it can only be one: drop "
                "one of the two."
            )
    scan = _read_table(ScanConfig, tables["scan"], "[scan]")
    check_measure_names(scan.measures or (), select_measure_catalog(model, scan.tol, scan.slope_sd))
    default_options = vars(StepOptions())
    _require_known_keys(tables["options"], default_options, "[options]", "options")
    config = Config(
        wheel_values=wheel_values,
        model_name=model_name,
        model_settings=laws | _read_like_defaults(model_table, defaults),
        step_option_values=_read_like_defaults(tables["options"], default_options),
        scan=scan,
        gait=_read_table(GaitConfig, tables["gait"], "[gait]"),
        tune=_read_table(TuneConfig, {"bounds": {}, **tables["tune"]}, "[tune]")
        if "tune" in config_tables
        else None,
        branch=_read_branch(tables["branch"], model.parameter_names)
        if "branch" in config_tables
        else None,
        figures=_read_table(FigureConfig, tables["figures"], "[figures]"),
        design=design,
        source_text=config_text,
        file_name=file_name,
    )
    config.make_wheel()
    config.make_model()
    config.make_options().check_tolerances(np.dtype(float))
    return config


def parse_assignments(assignment_texts: Iterable[str]) -> dict[str, float | int]:
    """Return the parameters that texts such as "damping=150" assign, as in `[wheel]`."""
    table: dict[str, Any] = {}
    for text in assignment_texts:
        name, equals_separator, value_text = (part.strip() for part in text.partition("="))
        if not equals_separator:
            raise ValueError(
                f"--set {text} has no '=': write a parameter and its value, damping=150."
            )
        try:
            table[name] = int(value_text) if name == "n_legs" else float(value_text)
        except ValueError:
            table[name] = value_text  # The check below reports the error.
    return _parse_wheel_table(table)


def _parse_wheel_table(table: ConfigTable) -> dict[str, float | int]:
    _require_known_keys(
        table, (*PARAMETER_NAMES, "n_legs", PARAMETER_SET_KEY), "[wheel]", "parameters"
    )
    values = dict(table)
    set_values: Mapping[str, float] = {}
    if (set_name := values.pop(PARAMETER_SET_KEY, None)) is not None:
        require_known_name(set_name, tuple(parameter_sets), "parameter set")
        set_values = parameter_sets[set_name].values
    return {**set_values, **_read_parameters(values, Finite)}


def _load_law(model_class: type[AbstractWheel], law_name: str, location: object) -> Any:
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
    module_name = f"law_in_{Path(file_name).stem}"  # shared with no installed module
    module_spec = importlib.util.spec_from_file_location(module_name, file_name)
    assert module_spec is not None
    assert module_spec.loader is not None  # The name of the file ends in .py.
    module = importlib.util.module_from_spec(module_spec)
    writes_no_bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    # Dataclasses need the module. Later, it must be missing: workers of dask would import it.
    sys.modules[module_name] = module
    try:
        module_spec.loader.exec_module(module)
        if hasattr(module, name_in_file):
            law = getattr(module, name_in_file)
            law = law() if isinstance(law, type) else law
            model_class(**{law_name: law})  # checks the law
            return law
    except Exception as error:
        raise ValueError(
            f"{law_name} is {location}, but this raises {type(error).__name__} "
            f"({' '.join(str(error).split())}): mend {file_name}, where arguments of classes need "
            "default values."
        ) from error
    finally:
        del sys.modules[module_name]
        sys.dont_write_bytecode = writes_no_bytecode
    raise ValueError(
        f"{law_name} is {location}, but {file_name} does not define {name_in_file}: write "
        f"{name_in_file} = ... there."
    )


def _read_like_defaults(table: ConfigTable, defaults: ConfigTable) -> dict[str, Any]:
    """Return settings with the types of their default values. Numbers must be positive.

    The model checks numbers that have no default value.
    """

    def find_kind(default: Any) -> Any:
        if isinstance(default, bool):
            return Annotated[bool, Strict(), _must_be("true or false")]
        if isinstance(default, str):
            return Annotated[str, _must_be(f'a name, "{default}"')]
        if default is None:
            return Finite
        return Whole if isinstance(default, int) else Positive

    return {
        # Infinite friction means that feet do not slip.
        name: value
        if name == FRICTION_NAME and value == math.inf
        else _read(find_kind(defaults[name]), value, name)
        for name, value in table.items()
    }


def _read_table(kind: Any, table: ConfigTable, location: str) -> Any:
    _require_known_keys(table, kind.__dataclass_fields__, location, "settings")
    return _read(kind, table)


def _read_branch(table: ConfigTable, allowed_parameter_names: tuple[str, ...]) -> BranchConfig:
    _require_known_keys(table, BranchConfig.__dataclass_fields__, "[branch]", "settings")
    name = table.get("parameter")
    check_parameter_name(
        name, allowed_parameter_names, "parameter that a branch of this model runs along"
    )
    if "bounds" not in table:
        raise ValueError("[branch] has no bounds: write bounds = [4.0, 230.0], say.")
    check_range("bounds", _read_parameters({str(name): table["bounds"]}, Range)[str(name)])
    return _read(BranchConfig, table)


def _read_parameters(table: ConfigTable, kind: Any) -> dict[str, Any]:
    """Return values by parameter. Raise a ValueError if a number is outside its domain."""
    kinds = {"n_legs": Annotated[int, *_limit(5, MAX_CONFIG_LEGS)]}
    values = {name: _read(kinds.get(name, kind), value, name) for name, value in table.items()}
    for name, numbers in values.items():
        for number in np.ravel(numbers).tolist():
            if name == FRICTION_NAME:
                _read(Positive, number, name)
            # A sample outside the domain of a leg force is BAD_INPUT.
            elif name in PARAMETER_DOMAINS:
                PARAMETER_DOMAINS[name].require_value_in_domain(name, number)
    return values


def _parse_design_table(
    kind: str, table: ConfigTable, allowed_parameter_names: tuple[str, ...]
) -> designs.SampleDesign:
    """Return the sample design that a table defines.

    It may sweep only parameters in `allowed_parameter_names`.
    """
    if FRICTION_NAME in table and FRICTION_NAME not in allowed_parameter_names:
        choices = [f'name = "{name}"' for name in list_model_config_names("scan", FRICTION_NAME)]
        raise ValueError(
            f"[{kind}] sweeps friction, which does not affect this model: write [model] and below "
            f"it {' or '.join(choices)}."
        )
    sizes = ("n", "seed") if kind in RANDOM_DESIGN_FUNCTIONS else ()
    _require_known_keys(table, (*sizes, *allowed_parameter_names), f"[{kind}]", "settings")
    swept = {name: value for name, value in table.items() if name not in sizes}
    if kind == "grid":
        return designs.grid({name: _read_axis(name, value) for name, value in swept.items()})
    if kind == "samples":
        return designs.samples(_read_parameters(swept, Values))
    ranges = _read_parameters(swept, Range)
    if "n" not in table:
        raise ValueError(f"[{kind}] has no number of samples: write n = 4096, say.")
    n, seed = (
        _read(Whole, table["n"], "n"),
        _read(Annotated[int, *_limit(0)], table.get("seed", 0), "seed"),
    )
    return RANDOM_DESIGN_FUNCTIONS[kind](ranges, n, seed)


def _read_axis(name: str, axis: Any) -> Any:
    """Return the values of an axis of a grid, from a list or from { from, to, count }."""
    if not isinstance(axis, dict):
        return _read_parameters({name: axis}, AxisValues)[name]
    keys = ("from", "to", "count")
    _require_known_keys(axis, keys, f"the axis of {name}", "keys")
    for key in keys:
        if key not in axis:
            raise ValueError(
                f"the axis of {name} has no '{key}': write {name} = "
                "{ from = ..., to = ..., count = ... }."
            )
    first, last = _read_parameters({name: [axis["from"], axis["to"]]}, Range)[name]
    count = _read(Whole, axis["count"], f"count of {name}")
    if count > MAX_LISTED_SAMPLES:
        raise ValueError(
            f"the axis of {name} has {count:,} values, but {MAX_LISTED_SAMPLES:,} is the most: "
            "give fewer."
        )
    return np.linspace(first, last, count)


def _require_known_keys(
    config_table: ConfigTable, allowed_keys: Iterable[str], table_location: str, key_kind: str
) -> None:
    """Raise a ValueError for an unknown key, with a similar name or the name for a symbol."""
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
    value_text = format_value(config_value).removesuffix(".0")
    if isinstance(config_value, bool):
        value_text = value_text.lower()
    elif isinstance(config_value, str):
        value_text = value_text.replace("'", '"')
    return ValueError(f"{setting_name} is {value_text}, but it must be {requirement_text}.")
