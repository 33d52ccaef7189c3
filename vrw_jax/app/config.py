"""Configs: TOML files that define a wheel, samples and measures.

An error in a file is reported in one sentence: what was given, what is allowed and what to do.
"""

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vrw_jax.models import (
    AbstractWheel,
    LadderWheel,
    RigidWheel,
    UnilateralWheel,
    ViscoelasticWheel,
)
from vrw_jax.numerics import Options, solver_named
from vrw_jax.scans import LONGEST, OFFERS, TO_TOLERANCE, check_measures
from vrw_jax.scans import design as designs
from vrw_jax.wheel import DOMAINS, FRICTION, PARAMETER_NAMES, WheelParams
from vrw_jax.wording import nearest, range_of, require_known

DRAWN = {"sobol": designs.sobol, "uniform": designs.uniform, "saltelli": designs.saltelli}
DESIGNS = ("grid", "samples", *DRAWN)
TABLES = ("wheel", "model", "options", "gait", "scan", "tune", "branch", *DESIGNS)
RUNGS: dict[str, type[AbstractWheel]] = {
    "viscoelastic": ViscoelasticWheel,
    "unilateral": UnilateralWheel,
    "rigid": RigidWheel,
    "auto": LadderWheel,
}
"""Model classes by the name in a config."""
_OPTION_KEYS = tuple(Options.__dataclass_fields__)
_AXIS_KEYS = ("from", "to", "count")


@dataclass(frozen=True)
class ScanConfig:
    """Table `[scan]`: measures of a scan, and number of samples that are written at a time.

    - `measures`: names of measures and derivatives; by default DLS fraction, speed and the like;
    - `chunk`: number of samples that are written at a time; 4,096 by default;
    - `tol`: permitted error of each measure with unilateral contact (`rung = "unilateral"`), in its
      unit. Each sample uses the simplest model that permits it.
    """

    measures: tuple[str, ...] | None = None
    chunk: int | None = None
    tol: float | None = None


@dataclass(frozen=True)
class GaitConfig:
    """Table `[gait]`: length and start of a walk.

    - `steps`: number of steps;
    - `start`: section state before the first touchdown, [rad, rad/s, m/s]; by default that of the
      model.
    """

    steps: int = 30
    start: tuple[float, float, float] | None = None


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
    largest_step: float | None = None


@dataclass(frozen=True)
class Config:
    """A config as checked values, with the text that it was read from."""

    wheel: Mapping[str, float | int] = field(default_factory=dict)
    rung: str = "viscoelastic"
    model: Mapping[str, float | int | str | bool] = field(default_factory=dict)
    options: Mapping[str, float | int | str | bool] = field(default_factory=dict)
    scan: ScanConfig = ScanConfig()
    gait: GaitConfig = GaitConfig()
    tune: TuneConfig | None = None
    branch: BranchConfig | None = None
    design: designs.AbstractDesign | None = None
    text: str = ""
    name: str = ""

    def params(self, changed: Mapping[str, float | int] | None = None) -> WheelParams:
        """Return the wheel: Table 1 with the values of the config, and then with `changes`."""
        values: dict[str, Any] = {**self.wheel, **(changed or {})}
        return WheelParams(**values)

    def wheel_model(self) -> AbstractWheel:
        """Return the model with its settings."""
        return RUNGS[self.rung](**self.model)

    def numerical_options(self) -> Options:
        """Return the numerical options of the steps."""
        options: dict[str, Any] = {**self.options}
        return Options(**options)


def load(path: str | Path) -> Config:
    """Read and check a config file; raise if it is invalid."""
    path = Path(path)
    if not path.exists():
        near = nearest(path.name, (beside.name for beside in path.parent.glob("*.toml")))
        raise ValueError(
            f"there is no config file {path}{near}: give the path of a TOML file, "
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
    return parse(text, path.name)


def parse(text: str, name: str = "config") -> Config:
    """Parse and check the text of a config; `name` begins every message about an error."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{name}: this is not valid TOML ({error}): mend that line.") from error
    try:
        return _config(tables, text, name)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _config(tables: Mapping[str, object], text: str, name: str) -> Config:
    """Return the config of the tables of a file; raise if a table is invalid."""
    _only(tables, TABLES, "the file", "tables")
    for key, table in tables.items():
        if not isinstance(table, dict):
            must = f"a table: write [{key}] on a line of its own and its settings below"
            raise _wrong(f"[{key}]", table, must)
    given = [kind for kind in DESIGNS if kind in tables]
    if len(given) > 1:
        raise ValueError(
            f"[{given[0]}] and [{given[1]}] are both given, but a scan has one design: keep one."
        )
    rung, model = _model(_table(tables, "model"))
    names = RUNGS[rung].parameter_names
    design = _design(given[0], _table(tables, given[0]), names) if given else None
    wheel = _wheel(_table(tables, "wheel"))
    both = [key for key in wheel if design is not None and key in design.names]
    if both:
        raise ValueError(
            f"{both[0]} is fixed in [wheel] and swept in [{given[0]}], but it can only be one: "
            "drop one of the two."
        )
    config = Config(
        wheel=wheel,
        rung=rung,
        model=model,
        options=_options(_table(tables, "options")),
        scan=_scan(_table(tables, "scan"), RUNGS[rung].rung),
        gait=_gait(_table(tables, "gait")),
        tune=_tune(_table(tables, "tune")) if "tune" in tables else None,
        branch=_branch(_table(tables, "branch"), names) if "branch" in tables else None,
        design=design,
        text=text,
        name=name,
    )
    config.params()
    config.wheel_model()
    options = config.numerical_options()
    options.require_reachable(np.dtype(float))
    solver_named(options.solver, options)
    return config


def _table(tables: Mapping[str, object], key: str) -> dict[str, object]:
    """Return a table of the file, empty if it is missing."""
    table = tables.get(key, {})
    assert isinstance(table, dict)
    return table


def assignment(text: str) -> tuple[str, float | int]:
    """Return a parameter and its value from `name=value` of the command line."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not equals:
        raise ValueError(f"--set {text} has no '=': write a parameter and its value, damping=150.")
    try:
        number = int(value) if name == "n_legs" else float(value)
    except ValueError:
        number = value  # type: ignore[assignment]  # the check below reports the error
    return name, _wheel({name: number})[name]


def _wheel(table: Mapping[str, object]) -> dict[str, float | int]:
    """Return the parameters of `[wheel]`."""
    _only(table, (*PARAMETER_NAMES, "n_legs"), "[wheel]", "parameters")
    values: dict[str, float | int] = {}
    for name, value in table.items():
        if name == "n_legs":
            values[name] = _whole(value, name, 5)
        else:
            values[name] = _in_domain(name, value)
    return values


def _model(table: Mapping[str, object]) -> tuple[str, dict[str, float | int | str | bool]]:
    """Return the name and the settings of the model of `[model]`."""
    rung = table.get("rung", Config.rung)
    require_known(rung, tuple(RUNGS), "rung")
    assert isinstance(rung, str)
    settings = RUNGS[rung].__dataclass_fields__
    _only(table, ("rung", *settings), f"[model] of the rung {rung}", "settings")
    given = {name: value for name, value in table.items() if name != "rung"}
    return rung, _like(given, {name: settings[name].default for name in settings})


def _options(table: Mapping[str, object]) -> dict[str, float | int | str | bool]:
    """Return the options of `[options]`."""
    _only(table, _OPTION_KEYS, "[options]", "options")
    defaults = Options()
    return _like(table, {key: getattr(defaults, key) for key in _OPTION_KEYS})


def _like(
    table: Mapping[str, object], defaults: Mapping[str, object]
) -> dict[str, float | int | str | bool]:
    """Return settings of the types of their defaults: flags, names, whole or positive numbers."""
    values: dict[str, float | int | str | bool] = {}
    for key, value in table.items():
        default = defaults[key]
        if isinstance(default, bool):
            if not isinstance(value, bool):
                raise _wrong(key, value, "true or false")
            values[key] = value
        elif isinstance(default, str):
            if not isinstance(value, str):
                raise _wrong(key, value, f'a name, "{default}"')
            values[key] = value
        elif isinstance(default, int):
            values[key] = _whole(value, key, 1)
        elif key == FRICTION and value == math.inf:
            values[key] = math.inf  # feet do not slip
        else:
            values[key] = _number(value, key, positive=True)
    return values


def _scan(table: Mapping[str, object], rung: str) -> ScanConfig:
    """Return the settings of `[scan]`; raise if the model does not have a measure."""
    _only(table, ScanConfig.__dataclass_fields__, "[scan]", "settings")
    measures = table.get("measures")
    if measures is not None:
        if not (isinstance(measures, list) and all(isinstance(m, str) for m in measures)):
            must = 'a list of names: write measures = ["dls_fraction", "speed"]'
            raise _wrong("measures", measures, must)
        offer = OFFERS.get(rung, OFFERS["viscoelastic"]) if "tol" not in table else TO_TOLERANCE
        check_measures(measures, offer)
        measures = tuple(measures)
    chunk = table.get("chunk")
    tol = table.get("tol")
    return ScanConfig(
        measures,
        None if chunk is None else _whole(chunk, "chunk", 1),
        None if tol is None else _number(tol, "tol", positive=True),
    )


def _gait(table: Mapping[str, object]) -> GaitConfig:
    """Return the settings of `[gait]`."""
    _only(table, GaitConfig.__dataclass_fields__, "[gait]", "settings")
    steps = _whole(table.get("steps", GaitConfig.steps), "steps", 1)
    start = table.get("start")
    if start is None:
        return GaitConfig(steps)
    if not (isinstance(start, list) and len(start) == 3):
        must = "the section state before touchdown, three numbers: angle in rad, angular rate in "
        raise _wrong("start", start, must + "rad/s, rate of Leg 1 in m/s")
    theta, dtheta, dL1 = (_number(value, "start") for value in start)
    return GaitConfig(steps, (theta, dtheta, dL1))


def _tune(table: Mapping[str, object]) -> TuneConfig:
    """Return the settings of `[tune]` and its tables."""
    _only(table, TuneConfig.__dataclass_fields__, "[tune]", "settings")
    objective = table.get("objective", TuneConfig.objective)
    if isinstance(objective, dict):
        objective = {name: _number(value, name) for name, value in objective.items()}
    elif not isinstance(objective, str):
        must = 'a measure or weights of several: write objective = "dls_fraction" or objective = '
        raise _wrong("objective", objective, must + "{ dls_fraction = 1.0, speed = 0.1 }")
    bounds = table.get("bounds")
    if not isinstance(bounds, dict) or not bounds:
        raise ValueError(
            "[tune] has no free parameter, but it needs at least one: add [tune.bounds] with lines "
            "such as damping = [20.0, 215.0]."
        )
    _only(bounds, PARAMETER_NAMES, "[tune.bounds]", "parameters")
    constraints = table.get("constraints")
    if constraints is not None:
        if not isinstance(constraints, dict):
            must = "a table: write [tune.constraints] and below it lines such as "
            raise _wrong("constraints", constraints, must + "clearance_sls1 = 0.001")
        constraints = {name: _number(value, name) for name, value in constraints.items()}
    return TuneConfig(
        objective=objective,
        bounds={name: _range(name, value) for name, value in bounds.items()},
        constraints=constraints,
        evaluations=_whole(table.get("evaluations", TuneConfig.evaluations), "evaluations", 1),
    )


def _branch(table: Mapping[str, object], names: tuple[str, ...]) -> BranchConfig:
    """Return the settings of `[branch]` along one of the parameters `names`."""
    _only(table, BranchConfig.__dataclass_fields__, "[branch]", "settings")
    parameter = table.get("parameter")
    require_known(parameter, names, "parameter that a branch of this rung runs along")
    assert isinstance(parameter, str)
    if "bounds" not in table:
        raise ValueError("[branch] has no bounds: write bounds = [4.0, 230.0], say.")
    bounds = range_of("bounds", _range("bounds of " + parameter, table["bounds"], parameter))
    step = table.get("largest_step")
    if step is not None and _number(step, "largest_step", positive=True) > 1.0:
        raise ValueError(
            f"largest_step is {step:g}, but it is a share of the range: give 0.02, say."
        )
    return BranchConfig(
        parameter=parameter,
        bounds=bounds,
        period=_whole(table.get("period", BranchConfig.period), "period", 1),
        largest_step=None if step is None else _number(step, "largest_step", positive=True),
    )


def _design(
    kind: str, table: Mapping[str, object], names: tuple[str, ...]
) -> designs.AbstractDesign:
    """Return the design of a table that sweeps some of the parameters `names`."""
    own = ("n", "seed") if kind in DRAWN else ()
    if FRICTION in table and FRICTION not in names:
        raise ValueError(
            f"[{kind}] sweeps friction, which does not affect this model: write [model] "
            'and below it rung = "unilateral" or rung = "auto".'
        )
    _only(table, (*own, *names), f"[{kind}]", "settings")
    swept = {name: value for name, value in table.items() if name not in own}
    if own:
        if "n" not in table:
            raise ValueError(f"[{kind}] has no number of samples: write n = 4096, say.")
        n, seed = _whole(table["n"], "n", 1), _whole(table.get("seed", 0), "seed", 0)
        ranges = {name: _range(name, value) for name, value in swept.items()}
        return DRAWN[kind](ranges, n, seed)
    if kind == "grid":
        return designs.grid(**{name: _axis(name, value) for name, value in swept.items()})
    return designs.samples({name: _list(name, value) for name, value in swept.items()})


def _axis(name: str, value: object) -> np.ndarray:
    """Return the values of a grid's axis, given as a list or as from, to and count."""
    if not isinstance(value, dict):
        return _list(name, value, " or { from = ..., to = ..., count = ... }")
    _only(value, _AXIS_KEYS, f"the axis of {name}", "keys")
    missing = [key for key in _AXIS_KEYS if key not in value]
    if missing:
        raise ValueError(
            f"the axis of {name} has no '{missing[0]}': "
            f"write {name} = {{ from = ..., to = ..., count = ... }}."
        )
    first, last = (_in_domain(name, value[key]) for key in ("from", "to"))
    count = _whole(value["count"], f"count of {name}", 1)
    if count > LONGEST:
        raise ValueError(
            f"the axis of {name} has {count:,} values, but {LONGEST:,} is the most: give fewer."
        )
    return np.linspace(first, last, count)


def _list(name: str, value: object, otherwise: str = "") -> np.ndarray:
    """Return a list of values in the domain of the parameter `name`."""
    if not isinstance(value, list):
        raise _wrong(name, value, f"a list of numbers{otherwise}")
    return np.asarray([_in_domain(name, item) for item in value])


def _range(name: str, value: object, parameter: str = "") -> tuple[float, float]:
    """Return two values in the domain of `parameter`, by default `name` itself."""
    if not (isinstance(value, list) and len(value) == 2):
        raise _wrong(name, value, f"a range of two numbers: write {name} = [lower, upper]")
    lower, upper = (_in_domain(parameter or name, item) for item in value)
    return lower, upper


def _in_domain(name: str, value: object) -> float:
    """Return a value as a number; raise if it is not in the domain of the parameter."""
    number = _number(value, name, positive=name == FRICTION)
    if name != FRICTION:
        DOMAINS[name].require(name, number)
    return number


def _number(value: object, name: str, positive: bool = False) -> float:
    """Return a value as a finite number; raise if it is not one."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _wrong(name, value, "a finite number")
    if positive and not value > 0:
        raise ValueError(f"{name} is {value:g}, but it must be positive.")
    return float(value)


def _whole(value: object, name: str, least: int) -> int:
    """Return a value as a whole number of at least `minimum`; raise if it is not one."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise _wrong(name, value, f"a whole number of at least {least}")
    return value


def _only(table: Mapping[str, object], allowed: Iterable[str], where: str, kind: str) -> None:
    """Raise if a table has a key that is not allowed."""
    allowed = tuple(allowed)
    for key in table:
        if key not in allowed:
            raise ValueError(
                f"{where} has the unknown key '{key}'{nearest(key, allowed)}: "
                f"its {kind} are {', '.join(allowed)}."
            )


def _wrong(name: str, value: object, must: str) -> ValueError:
    """Return the error about a value that does not satisfy a requirement."""
    return ValueError(f"{name} is {_shown(value)}, but it must be {must}.")


def _shown(value: object) -> str:
    """Return a value as it is written in TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value).replace("'", '"') if isinstance(value, str) else repr(value)
