"""Compare gaits with and without double support at equal slope and at equal speed.

    python -m experiments.gaits.double_support [--only PART ...] [--redraw]

Wheels are drawn from a box of damping, stiffness and natural length that contains Table 1. Their
gaits are limit cycles of the paper's model. One comparison is between gaits on equal slopes. The
other is between gaits of equal speed, for which the slope of each wheel is solved. The energy lost
per metre is M g sin(slope) in every gait. Gaits on equal slopes therefore differ in its parts only.
Rigid wheels are the baseline without compliance.

Further parts: mean numbers of steps on random slopes, the same wheels with unilateral contact,
fronts of energy against double support by `vrw.tune`, and Sobol' indices over the part of the box
in which gaits exist (`experiments/shared/region_indices.py`).

The command writes five tables to `docs/figures/` and two figures, and fills the blocks of
docs/studies/double_support.md. It takes a quarter of an hour on one core. The fronts take two
minutes of it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from scipy import stats
from scipy.optimize import brentq

import vrw_jax as vrw
from experiments.gaits.force_peak_wheels import GAIT_OPTIONS
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.region_indices import RegionIndices, estimate_region_indices
from experiments.shared.tables import (
    DOCS,
    FIGURES,
    Row,
    describe_run,
    format_markdown,
    read_column,
    read_table,
    replace_block,
    shorten_number,
    write_named_rows,
)
from vrw_jax import plot as plots
from vrw_jax.wheel import transitions

BOX = {
    "damping": (20.0, 215.0),
    "stiffness": (400.0, 2500.0),
    "natural_length": (1.0, 1.03),
    "slope": (0.04, 0.32),
}
"""Ranges in SI units, chosen because they contain Table 1 and the two-peak wheel."""
WHEEL_NAMES = ("damping", "stiffness", "natural_length")
MARKED_SETS = {"table_1": ("D", "Table 1"), "two_peaks": ("*", "two-peak wheel")}
"""Marker and label of the parameter sets that are added to the random wheels."""

EQUAL_SLOPES = (0.1, 0.2, 0.3)
"""Slopes, rad, of which the last is that of Table 1."""
EQUAL_SPEED = 0.8
"""Speed, m/s, chosen because rigid and compliant wheels walk at it."""
SLOPE_GRID = np.array([0.04, 0.06, *EQUAL_SLOPES[:1], 0.15, EQUAL_SLOPES[1], 0.25, EQUAL_SLOPES[2]])
"""Slopes on which gaits are searched, and between which those of equal speed lie, rad."""

SPEED_TOLERANCE = 1e-3
"""Largest deviation of a gait from `EQUAL_SPEED`, m/s, chosen far below differences of speed."""
MAX_SPEED_ITERATIONS = 8

GAITS_TABLE = FIGURES / "double_support_gaits.csv"
LIVES_TABLE = FIGURES / "double_support_lives.csv"
CONTACT_TABLE = FIGURES / "double_support_contact.csv"
FRONTS_TABLE = FIGURES / "double_support_fronts.csv"
INDICES_TABLE = FIGURES / "double_support_indices.csv"
PAGE = DOCS / "studies/double_support.md"

HAS_HELD_LANDING = {"rigid, classic landing": False, "rigid, held landing": True}
"""Whether each rigid wheel has the held landing, by the label of the wheel."""
CONTACT_FRICTION = 0.8
COMPARED_COLUMNS = {
    "slope": "slope, rad",
    "speed": "speed, m/s",
    "energy_per_meter": "energy lost, J/m",
    "damper_share": "share of dampers in it",
    "peak_force": "peak force, weights",
    "landing_impulse": "landing impulse, N s",
    "spectral_radius": "spectral radius",
    "period_sensitivity": "period sensitivity, 1/rad",
    "friction_needed": "friction needed",
}
"""Labels of the compared columns of `double_support_gaits.csv`."""


@dataclass(frozen=True)
class StudySize:
    """Sizes of the study.

    - `n_wheels`: number of random wheels;
    - `n_lives`: number of gaits with a mean number of steps on random slopes;
    - `n_contact`: number of gaits that are compared with unilateral contact;
    - `n_rows`: number of rows of the Sobol' indices;
    - `front_levels`: least DLS fractions of the fronts;
    - `n_front_starts`: number of random wheels from which searches for each of them start;
    - `n_front_restarts`: number of best ends from which further searches start.
    """

    n_wheels: int = 62
    n_lives: int = 8
    n_contact: int = 8
    n_rows: int = 128
    front_levels: tuple[float, ...] = (0.1, 0.25, 0.4, 0.55, 0.7)
    n_front_starts: int = 24
    n_front_restarts: int = 4


LIFE_SLOPE_SD = 0.01
"""Standard deviation of the random slopes, rad."""
LIFE_SLOPE = 0.1
"""Mean of the random slopes, rad, chosen because rigid wheels walk on it too."""
N_CONTACT_STEPS = 150
"""Steps of a walk with unilateral contact, chosen because most walks repeat after 100."""

Columns = dict[str, np.ndarray]


def select(columns: Mapping[str, np.ndarray], selection: Any) -> Columns:
    """Return the selected entries of each column."""
    return {name: values[selection] for name, values in columns.items()}


def make_wheels(columns: Mapping[str, np.ndarray]) -> vrw.WheelParams:
    """Return the wheels of the columns of `BOX`, with all other parameters of Table 1."""
    n = len(columns["slope"])
    params = vrw.WheelParams(**{name: jnp.asarray(columns[name]) for name in BOX})
    return jax.tree.map(lambda x: jnp.broadcast_to(x, n), params)


def find_gaits(columns: Mapping[str, np.ndarray]) -> Columns:
    """Return section states and measures of the stable gaits; NaN for wheels without one."""
    gaits = vrw.limit_cycles(make_wheels(columns), options=GAIT_OPTIONS)
    radius = np.abs(np.linalg.eigvals(np.asarray(gaits.monodromy_value))).max(1)
    is_stable = np.asarray(gaits.found) & (radius < 1.0)
    durations = np.where(is_stable[:, None], np.asarray(gaits.durations), np.nan)
    period = durations.sum(1)
    return {
        "section_state": np.asarray(gaits.section_state),
        "dls_fraction": durations[:, 0] / period,
        "speed": np.asarray(gaits.step_length) / period,
        "period": period,
        "spectral_radius": radius,
    }


def draw_wheels(n: int) -> tuple[list[str], Columns]:
    """Return labels and parameters of the marked parameter sets and of `n` random wheels."""
    box = {name: BOX[name] for name in WHEEL_NAMES}
    design = vrw.sobol(box, n)
    marked = [vrw.parameter_sets[name].params for name in MARKED_SETS]
    columns = {
        name: np.concatenate([[float(getattr(p, name)) for p in marked], sampled_values])
        for name, sampled_values in design.values_by_parameter.items()
    }
    return [*MARKED_SETS, *map(str, range(n))], columns


def solve_equal_speed(wheels: Columns, grid_speeds: np.ndarray) -> Columns:
    """Return the wheels that have `EQUAL_SPEED` on some slope, with the gentlest such slope.

    Regula falsi starts from two neighboring slopes of the grid. `index` is the index of the wheel.

    - `grid_speeds`: speeds on `SLOPE_GRID`, shape (wheels, slopes), NaN without a gait.
    """
    excess = grid_speeds - EQUAL_SPEED
    is_bracket = excess[:, :-1] * excess[:, 1:] <= 0.0  # False if one of the two is NaN
    index = np.flatnonzero(is_bracket.any(1))
    j = is_bracket[index].argmax(1)
    ends = np.stack([SLOPE_GRID[j], SLOPE_GRID[j + 1]])
    excess_at_ends = np.stack([excess[index, j], excess[index, j + 1]])
    for _ in range(MAX_SPEED_ITERATIONS):
        share = excess_at_ends[0] / (excess_at_ends[0] - excess_at_ends[1])
        slope = ends[0] + share * (ends[1] - ends[0])
        residual = find_gaits(select(wheels, index) | {"slope": slope})["speed"] - EQUAL_SPEED
        if np.nanmax(np.abs(residual)) < SPEED_TOLERANCE:
            break
        side = np.where(residual * excess_at_ends[0] > 0.0, 0, 1)
        ends[side, np.arange(len(index))] = slope
        excess_at_ends[side, np.arange(len(index))] = residual
        # Half the value of an end that stays accelerates the convergence (Illinois).
        excess_at_ends[1 - side, np.arange(len(index))] *= 0.5
    is_solved = np.abs(residual) < SPEED_TOLERANCE
    return select(wheels, index[is_solved]) | {
        "slope": slope[is_solved],
        "index": index[is_solved],
    }


def measure_step(
    params: vrw.WheelParams, section_state: Any, model: vrw.AbstractWheel | None = None
) -> dict[str, float]:
    """Return energies, forces and friction of one step of a gait of the paper's or a rigid model.

    The peak force is the largest of 100 samples per phase, both ends included.
    """
    step = vrw.step(params, section_state, model=model)
    walk = vrw.simulate(params, section_state, 1, model=model)
    s, margins = params.symbols(), step.margins
    length, energy = float(step.step_length), step.energy
    losses = {name: float(getattr(energy, name)) for name in ("damping", "landing", "stopper")}
    total = sum(losses.values())
    weight = float(s.Mt * s.g)
    # Friction margins are those of the coefficient 1.
    least_margin = min(
        float(getattr(margins, name))
        for name in ("friction_fore", "friction_rear", "landing_friction_fore",
                     "landing_friction_rear")
    )  # fmt: skip
    return {
        "energy_per_meter": total / length,
        "imbalance": abs(total / (weight * length * float(s.sin_phi)) - 1.0),
        "damper_share": losses["damping"] / total,
        "landing_share": losses["landing"] / total,
        "stopper_share": losses["stopper"] / total,
        "peak_force": float(walk.lambda_2.max()) / weight,
        "friction_needed": 1.0 - least_margin,
        "friction_in_support": 1.0 - float(margins.friction_fore),
        "clearance": min(float(margins.clearance_sls1), float(margins.clearance_sls2)),
    }


def measure_gaits(
    labels: Sequence[str], columns: Columns, gaits: Columns, comparison: str
) -> list[Row]:
    """Return a row of the table for each wheel of the columns that has a gait."""
    rows = []
    for i in np.flatnonzero(np.isfinite(gaits["speed"])):
        values = {name: float(columns[name][i]) for name in BOX}
        params, state = vrw.WheelParams(**values), gaits["section_state"][i]
        values |= {name: float(x[i]) for name, x in gaits.items() if name != "section_state"}
        landing = transitions.resolve_landing(params.symbols(), *map(jnp.asarray, state))
        values["landing_impulse"] = float(landing.fore_impulse.normal)
        values |= measure_step(params, state)
        rows.append(format_row(comparison, labels[i], values))
    return rows


def format_row(comparison: str, label: str, values: Mapping[str, float]) -> Row:
    """Return a row of the table with six significant digits."""
    return {"comparison": comparison, "wheel": label} | {
        name: f"{value:.6g}" for name, value in values.items()
    }


def make_rigid_model(label: str, stop_at_lift_off: bool = True) -> vrw.RigidWheel:
    """Return the model of the rigid wheel with this label, one of `HAS_HELD_LANDING`."""
    return vrw.RigidWheel(stop_at_lift_off=stop_at_lift_off, held_landing=HAS_HELD_LANDING[label])


def measure_rigid(label: str, slope: float, comparison: str) -> Row | None:
    """Return a row of a rigid wheel on a slope, or None if it has no gait there."""
    model, params = make_rigid_model(label), vrw.WheelParams(slope=slope)
    gait = vrw.limit_cycle(params, model=model)
    if not bool(gait.found):
        return None
    s, state = params.symbols(), gait.section_state
    # The hub's velocity turns by the angle between the legs. The impulse on both feet is the change
    # of the momentum normal to the slope.
    rates = float(state[1]) + float(gait.post_impact[1])
    both_feet = float(s.Mt * s.L0) * np.sin(0.5 * float(s.alpha)) * rates
    rear_foot = float(vrw.step(params, state, model=model).indicators.lambda_I4)
    sensitivity = float(vrw.gait_sensitivity(params, "period", model=model).norm[0])
    values = {
        "slope": slope, "dls_fraction": 0.0, "speed": float(gait.speed),
        "period": float(gait.period), "spectral_radius": float(gait.spectral_radius),
        "period_sensitivity": sensitivity / float(gait.period),
        "landing_impulse": both_feet - (rear_foot if model.held_landing else 0.0),
    }  # fmt: skip
    return format_row(comparison, label, values | measure_step(params, state, model))


def solve_rigid_speed(label: str, speed: float) -> float | None:
    """Return the slope on which a rigid wheel has this speed, rad, or None if there is none."""

    def compute_excess(slope: float) -> float:
        gait = vrw.limit_cycle(vrw.WheelParams(slope=slope), model=make_rigid_model(label))
        return float(gait.speed) - speed if bool(gait.found) else -speed

    steepest = 0.16
    if compute_excess(steepest) < 0.0:
        return None
    slope = brentq(compute_excess, 0.02, steepest, xtol=1e-10)
    return slope if abs(compute_excess(slope)) < 1e-6 else None


def add_sensitivities(rows: Sequence[Row]) -> None:
    """Add the gait sensitivity norm of the period, relative to the period, to compliant wheels."""
    for row in select_compliant(rows):
        sensitivity = vrw.gait_sensitivity(make_wheel(row), "period", options=GAIT_OPTIONS)
        row["period_sensitivity"] = f"{float(sensitivity.norm[0]) / float(row['period']):.6g}"


def compute_gaits(size: StudySize) -> list[Row]:
    """Return the rows of all comparisons."""
    labels, wheels = draw_wheels(size.n_wheels)
    n = len(labels)
    grid = {name: np.repeat(values, len(SLOPE_GRID)) for name, values in wheels.items()}
    grid["slope"] = np.tile(SLOPE_GRID, n)
    gaits = find_gaits(grid)
    rows = []
    for slope in EQUAL_SLOPES:
        comparison, is_at_slope = f"slope {slope:g} rad", grid["slope"] == slope
        rows += measure_gaits(
            labels, select(grid, is_at_slope), select(gaits, is_at_slope), comparison
        )
        rows += filter(
            None, (measure_rigid(label, slope, comparison) for label in HAS_HELD_LANDING)
        )
    comparison = f"speed {EQUAL_SPEED:g} m/s"
    columns = solve_equal_speed(wheels, gaits["speed"].reshape(n, -1))
    rows += measure_gaits(
        [labels[i] for i in columns["index"]], columns, find_gaits(columns), comparison
    )
    for label in HAS_HELD_LANDING:
        rigid_slope = solve_rigid_speed(label, EQUAL_SPEED)
        if rigid_slope is not None:
            rows += filter(None, [measure_rigid(label, rigid_slope, comparison)])
    return rows


def select_evenly(rows: Sequence[Row], n: int) -> list[Row]:
    """Return `n` rows at equal distances in the order of their DLS fractions."""
    ordered = sorted(rows, key=lambda row: float(row["dls_fraction"]))
    indices = np.unique(np.linspace(0, len(ordered) - 1, min(n, len(ordered))).round().astype(int))
    return [ordered[i] for i in indices]


def make_wheel(row: Row) -> vrw.WheelParams:
    """Return the compliant wheel of a row."""
    return vrw.WheelParams(**{name: float(row[name]) for name in BOX})


GAIT_COLUMNS = ("comparison", "wheel", "damping", "stiffness", "natural_length", "slope",
                "dls_fraction", "spectral_radius")  # fmt: skip
"""Columns of `double_support_gaits.csv` that the tables of lives and of contact repeat."""


def copy_gait_columns(row: Row) -> Row:
    """Return the wheel and the gait of a row."""
    return {name: row[name] for name in GAIT_COLUMNS}


def compute_lives(rows: Sequence[Row], size: StudySize) -> list[Row]:
    """Return mean numbers of steps on random slopes of selected wheels and of rigid wheels."""
    at_slope = [row for row in rows if row["comparison"] == f"slope {LIFE_SLOPE:g} rad"]
    chosen = select_evenly(select_compliant(at_slope), size.n_lives)
    chosen += [row for row in at_slope if row["wheel"] in HAS_HELD_LANDING]
    lines = []
    for row in chosen:
        if row["wheel"] in HAS_HELD_LANDING:
            model = make_rigid_model(row["wheel"], stop_at_lift_off=False)
            passage = vrw.first_passage(
                vrw.WheelParams(slope=LIFE_SLOPE), LIFE_SLOPE_SD, model=model
            )
        else:
            passage = vrw.first_passage(
                make_wheel(row), LIFE_SLOPE_SD, tol=0.1, n_walkers=2048, max_steps=400_000
            )
        most_frequent = int(np.argmax(passage.end_fractions)) if len(passage.end_names) else None
        lines.append(copy_gait_columns(row) | {
            "mean_steps": f"{float(passage.mean_steps):.4g}",
            "mean_steps_error": f"{float(passage.error):.2g}",
            "walk_end": "none" if most_frequent is None else passage.end_names[most_frequent],
        })  # fmt: skip
    return lines


CONTACT_MEASURES = ("contact_dls_fraction", "contact_speed", "contact_damper_share",
                    "contact_friction_share")  # fmt: skip


def compute_contact(rows: Sequence[Row], size: StudySize) -> list[Row]:
    """Return measures with unilateral contact of evenly selected wheels and of the marked sets.

    The walk begins in the gait of the paper's model. Its last step counts, and the walk repeats if
    the step before has the same period.
    """
    compliant = [
        row for row in select_compliant(rows) if row["comparison"] == f"slope {LIFE_SLOPE:g} rad"
    ]
    chosen = select_evenly(compliant, size.n_contact)
    marked_comparison = f"slope {EQUAL_SLOPES[-1]:g} rad"
    marked = [
        row for row in rows
        if row["wheel"] == "table_1" and row["comparison"] == marked_comparison
    ]  # fmt: skip
    # The model contains 64-bit numbers only if vrw.start_jax() was called.
    contact_model = vrw.UnilateralWheel(friction=CONTACT_FRICTION)
    lines = []
    for row in [*chosen, *marked]:
        params = make_wheel(row)
        start = vrw.limit_cycle(params, options=GAIT_OPTIONS).section_state
        walk = vrw.walk(params, start, N_CONTACT_STEPS, model=contact_model)
        outcomes = np.asarray(walk.steps.outcome)
        line = copy_gait_columns(row) | {"friction_needed": row["friction_needed"],
                                         "speed": row["speed"]}  # fmt: skip
        is_failure = outcomes != vrw.Outcome.STEPPED
        contact_measures: dict[str, float | None] = dict.fromkeys(CONTACT_MEASURES)
        if is_failure.any():
            end = vrw.Outcome(int(outcomes[is_failure.argmax()])).name
        else:
            periods = np.asarray(walk.steps.durations).sum(-1)
            end = "repeats" if abs(periods[-1] - periods[-2]) < 1e-6 else "varies"
            step = vrw.step(params, walk.steps.section_state[-2], model=contact_model)
            loss = float(row["energy_per_meter"]) * float(step.step_length)
            contact_measures = {
                "contact_dls_fraction": float(step.dls_fraction),
                "contact_speed": float(step.speed),
                "contact_damper_share": float(step.energy_damping) / loss,
                "contact_friction_share": float(step.energy_friction) / loss,
            }
        line["contact_end"] = end
        for name, value in contact_measures.items():
            line[name] = "" if value is None else f"{value:.4g}"
        lines.append(line)
        print(line, flush=True)
    return lines


def select_compliant(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of compliant wheels."""
    return [row for row in rows if row["wheel"] not in HAS_HELD_LANDING]


def compute_energy_gain(cycle: Any, step: Any) -> jax.Array:
    """Return the negative energy lost per metre, J/m: the objective of the fronts."""
    energy = step.energy
    return -(energy.damping + energy.landing + energy.stopper) / step.step_length


FRONTS = {
    "any foot path": {},
    "foot above ground": {
        "takeoff_acceleration": 0.0,
        "clearance_sls1": 0.0,
        "clearance_sls2": 0.0,
    },
}
"""Constraints of the fronts besides speed and DLS fraction."""


def search_least_energy(
    params: vrw.WheelParams, constraints: Mapping[str, float]
) -> list[vrw.TuneResult]:
    """Return the end of a search from one wheel; no end if the wheel has no gait."""
    try:
        return [
            vrw.tune(
                params, compute_energy_gain, list(BOX), BOX, constraints,
                cycle_options=GAIT_OPTIONS, max_evaluations=60, tolerance=1e-4,
            )
        ]  # fmt: skip
    except ValueError as error:  # the single search found no gait of this wheel
        print(error, flush=True)
        return []


CONSTRAINT_TOLERANCES = {"speed": 1e-3, "dls_fraction": 1e-3, "takeoff_acceleration": 1e-3,
                         "clearance_sls1": 1e-6, "clearance_sls2": 1e-6}  # fmt: skip
"""Violations that count as satisfied, in SI units, chosen above those of converged searches."""


def select_best_ends(
    ends: Sequence[vrw.TuneResult], constraints: Mapping[str, float], n: int
) -> list[vrw.TuneResult]:
    """Return the `n` ends of least energy that satisfy all constraints.

    A search that ends early may violate its constraints.
    """
    satisfying = []
    for tuned in ends:
        measures = tuned.step.measures()
        if all(
            float(measures[name]) > bound - CONSTRAINT_TOLERANCES[name]
            for name, bound in constraints.items()
        ):
            satisfying.append(tuned)
    return sorted(satisfying, key=lambda tuned: -tuned.value)[:n]


def compute_fronts(rows: Sequence[Row], size: StudySize) -> list[Row]:
    """Return the gait of least energy per metre for each front and each least DLS fraction.

    Searches start from the random wheels of least energy that satisfy the DLS fraction, or else
    have the most double support. Further searches start from the best ends of all levels. The
    result is the best end of all levels that satisfies the constraints.
    """
    wheels = [
        row for row in select_compliant(rows) if row["comparison"] == f"speed {EQUAL_SPEED:g} m/s"
    ]
    lines: list[Row] = []
    for front, foot_constraints in FRONTS.items():
        constraints = {
            level: {"speed": EQUAL_SPEED, "dls_fraction": level} | foot_constraints
            for level in size.front_levels
        }
        ends: dict[float, list[vrw.TuneResult]] = {}
        for level in size.front_levels:

            def rank_start(row: Row, level: float = level) -> tuple[float, float]:
                missing = max(level - float(row["dls_fraction"]), 0.0)
                return missing, float(row["energy_per_meter"])

            ends[level] = []
            for row in sorted(wheels, key=rank_start)[: size.n_front_starts]:
                ends[level] += search_least_energy(make_wheel(row), constraints[level])
        for level in size.front_levels:
            all_ends = [tuned for level_ends in ends.values() for tuned in level_ends]
            for tuned in select_best_ends(all_ends, constraints[level], size.n_front_restarts):
                ends[level] += search_least_energy(tuned.params, constraints[level])
        for level in size.front_levels:
            all_ends = [tuned for level_ends in ends.values() for tuned in level_ends]
            (best,) = select_best_ends(all_ends, constraints[level], 1)
            values = {name: float(getattr(best.params, name)) for name in BOX}
            values |= {"dls_fraction": float(best.cycle.dls_fraction),
                       "speed": float(best.cycle.speed), "energy_per_meter": -best.value,
                       "spectral_radius": float(best.cycle.spectral_radius)}  # fmt: skip
            n_converged = sum(tuned.status.name == "CONVERGED" for tuned in ends[level])
            lines.append(
                {"front": front, "least_dls_fraction": f"{level:g}",
                 "converged_searches": f"{n_converged} of {len(ends[level])}",
                 "status": best.status.name}
                | {name: f"{value:.6g}" for name, value in values.items()}
            )  # fmt: skip
            print(lines[-1], flush=True)
    return lines


def scale_to_box(points: np.ndarray) -> Columns:
    """Return the parameters of points in the unit cube, shape (points, 4)."""
    return {
        name: lower + (upper - lower) * points[:, i]
        for i, (name, (lower, upper)) in enumerate(BOX.items())
    }


INDEX_MEASURES = ("dls_fraction", "speed")


def compute_indices(size: StudySize) -> list[Row]:
    """Return Sobol' indices of two measures over the region with gaits, and of its indicator."""

    def evaluate_gaits(points: np.ndarray) -> np.ndarray:
        gaits = find_gaits(scale_to_box(points))
        return np.stack([gaits[name] for name in INDEX_MEASURES], 1)

    def evaluate_existence(points: np.ndarray) -> np.ndarray:
        return np.isfinite(evaluate_gaits(points)[:, :1]).astype(float)

    cases: tuple[tuple[Callable, Sequence[str]], ...] = (
        (evaluate_gaits, INDEX_MEASURES),
        (evaluate_existence, ("gait exists",)),
    )
    lines = []
    for evaluate, names in cases:
        indices = estimate_region_indices(evaluate, len(BOX), size.n_rows, np.random.default_rng(0))
        lines += list(format_indices(indices, names))
    return lines


def format_indices(indices: RegionIndices, names: Sequence[str]) -> Iterator[Row]:
    """Yield one row per measure and parameter."""
    for j, measure in enumerate(names):
        for i, parameter in enumerate(BOX):
            yield {
                "measure": measure,
                "parameter": parameter,
                "first_order": f"{indices.first_order[i, j]:.2f}",
                "first_order_95": describe_bounds(indices.first_order_bounds[:, i, j]),
                "total": f"{indices.total[i, j]:.2f}",
                "total_95": describe_bounds(indices.total_bounds[:, i, j]),
                "region_share": f"{indices.region_share:.2f}",
                "gaits_searched": str(indices.n_evaluations),
            }


def describe_bounds(bounds: np.ndarray) -> str:
    """Return an interval as text."""
    return f"{bounds[0]:.2f} to {bounds[1]:.2f}"


def summarize_comparisons(rows: Sequence[Row]) -> str:
    """Return a table in Markdown: indices of gaits of equal speed.

    It lists rigid wheels, medians of the thirds of the gaits with the least and the largest DLS
    fraction, and rank correlations.
    """
    group = group_by_comparison(rows)[f"speed {EQUAL_SPEED:g} m/s"]
    gaits = sorted(select_compliant(group), key=lambda row: float(row["dls_fraction"]))
    third = len(gaits) // 3
    rigid = {row["wheel"]: row for row in group if row["wheel"] in HAS_HELD_LANDING}
    dls, lines = read_column(gaits, "dls_fraction"), []
    for name, label in {"dls_fraction": "DLS fraction", **COMPARED_COLUMNS}.items():
        if name in ("speed", "damper_share"):
            continue
        values = read_column(gaits, name)
        correlation = stats.spearmanr(dls, values).statistic
        lines.append([
            label, *(shorten_number(rigid[model][name]) for model in HAS_HELD_LANDING),
            f"{np.median(values[:third]):.3g}", f"{np.median(values[-third:]):.3g}",
            "–" if name == "dls_fraction" else f"{correlation:+.2f}",
        ])  # fmt: skip
    header = ("index", *HAS_HELD_LANDING, "median, least DLS", "median, most DLS",
              "rank correlation with DLS")  # fmt: skip
    return format_markdown(header, lines)


def group_by_comparison(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the rows by comparison, in order of first appearance."""
    names = dict.fromkeys(row["comparison"] for row in rows)
    return {name: [row for row in rows if row["comparison"] == name] for name in names}


LIFE_COLUMNS = ("wheel", "dls_fraction", "spectral_radius", "mean_steps")
CONTACT_COLUMNS = (
    "wheel", "friction_needed", "dls_fraction", "speed", "contact_dls_fraction", "contact_speed",
)  # fmt: skip


def format_lives(rows: Sequence[Row]) -> list[Row]:
    """Return the wheels whose mean number of steps has an error, with this error."""
    return [
        row | {"mean_steps": f"{float(row['mean_steps']):.3g} ± {float(error):.1g}"}
        for row in rows
        if np.isfinite(float(error := row["mean_steps_error"]))
    ]


def summarize_table(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """Return the columns as a table in Markdown, in the order of the DLS fraction."""
    ordered = sorted(rows, key=lambda row: float(row["dls_fraction"]))
    return format_markdown(
        [name.replace("_", " ") for name in columns],
        [[shorten_number(row[name] or "–") for name in columns] for row in ordered],
    )


def make_blocks() -> dict[str, tuple[str, str]]:
    """Return the part that computes each block of the page, and its text from stored tables."""
    lives = format_lives(read_table(LIVES_TABLE))
    return {
        "double_support_gaits": ("gaits", summarize_comparisons(read_table(GAITS_TABLE))),
        "double_support_lives": ("lives", summarize_table(lives, LIFE_COLUMNS)),
        "double_support_contact": (
            "contact", summarize_table(read_table(CONTACT_TABLE), CONTACT_COLUMNS)
        ),
    }  # fmt: skip


PANELS = (
    ("slope 0.1 rad", "speed"),
    ("slope 0.1 rad", "damper_share"),
    ("slope 0.1 rad", "period_sensitivity"),
    ("speed 0.8 m/s", "energy_per_meter"),
    ("speed 0.8 m/s", "peak_force"),
    ("speed 0.8 m/s", "spectral_radius"),
)


def compute_marker_areas(stiffness: np.ndarray) -> np.ndarray:
    """Return areas of dots in square points, proportional to the stiffness."""
    return 0.012 * stiffness


def draw_comparisons() -> None:
    """Draw six indices over the DLS fraction, with the rigid wheels.

    Colors show the damping, and areas of the dots the stiffness.
    """
    rows = group_by_comparison(read_table(GAITS_TABLE))
    figure, axes = plt.subplots(2, 3, figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 4.4), sharex=True)
    for axis, (comparison, name) in zip(axes.ravel(), PANELS, strict=True):
        gaits = select_compliant(rows[comparison])
        points = axis.scatter(
            read_column(gaits, "dls_fraction"), read_column(gaits, name),
            s=compute_marker_areas(read_column(gaits, "stiffness")),
            c=read_column(gaits, "damping"), cmap="viridis", vmin=BOX["damping"][0],
            vmax=BOX["damping"][1],
        )  # fmt: skip
        for row in rows[comparison]:
            if row["wheel"] in MARKED_SETS:
                marker, label = MARKED_SETS[row["wheel"]]
                axis.plot(float(row["dls_fraction"]), float(row[name]), marker, color="white",
                          markeredgecolor="black", markersize=7, label=label)  # fmt: skip
        draw_rigid_wheels(axis, rows[comparison], name)
        if name == "period_sensitivity":
            axis.set_yscale("log")
            axis.set_yticks([4, 6, 10, 20], ["4", "6", "10", "20"])
            axis.minorticks_off()
        axis.set_ylabel(COMPARED_COLUMNS[name].replace("in it", "in the loss"))
        axis.set_title(comparison.replace("slope", "at slope").replace("speed", "at"))
    for axis in axes[-1]:
        axis.set_xlabel("DLS fraction")
    figure.colorbar(points, ax=axes, label="damping [N·s/m]", shrink=0.7)
    handles = {
        label: handle
        for axis in axes.ravel()
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    for stiffness in (500.0, 1000.0, 2000.0):
        area = float(compute_marker_areas(np.array(stiffness)))
        handles[f"stiffness {stiffness:g} N/m"] = plt.scatter([], [], s=area, color="0.4")
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    plots.save(figure, FIGURES, "double_support_gaits")


def draw_rigid_wheels(axis: Axes, rows: Sequence[Row], column: str) -> None:
    """Draw a horizontal line for each rigid wheel, solid for the classic landing."""
    for row in rows:
        if row["wheel"] in HAS_HELD_LANDING:
            style = "-" if "classic" in row["wheel"] else "--"
            axis.axhline(float(row[column]), color=plots.DARK_GRAY_COLOR, linestyle=style,
                         linewidth=0.8, label=row["wheel"])  # fmt: skip


def draw_fronts() -> None:
    """Draw the tuned gaits beside all gaits of that speed, and the Sobol' indices."""
    figure, (front_axis, index_axis) = plt.subplots(
        1, 2, figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 3.4), width_ratios=(1, 1.2)
    )
    draw_tuned_gaits(front_axis)
    draw_indices(index_axis)
    plots.save(figure, FIGURES, "double_support_fronts")


def draw_tuned_gaits(axis: Axes) -> None:
    """Draw the tuned gaits that satisfy their constraints, and all gaits of the same speed."""
    columns = ("dls_fraction", "energy_per_meter")
    rows = group_by_comparison(read_table(GAITS_TABLE))[f"speed {EQUAL_SPEED:g} m/s"]
    axis.plot(*(read_column(select_compliant(rows), name) for name in columns), ".", color="0.6",
              label="random wheels")  # fmt: skip
    draw_rigid_wheels(axis, rows, "energy_per_meter")
    for front, marker, color in (("any foot path", "o", plots.LEG_1_COLOR),
                                 ("foot above ground", "s", plots.LEG_2_COLOR)):  # fmt: skip
        for is_converged, label in ((True, "local optimum"), (False, "search ended early")):
            tuned = [
                row for row in read_table(FRONTS_TABLE)
                if row["front"] == front and (row["status"] == "CONVERGED") == is_converged
                and float(row["speed"]) > EQUAL_SPEED - SPEED_TOLERANCE
            ]  # fmt: skip
            if tuned:
                axis.plot(*(read_column(tuned, name) for name in columns), marker, color=color,
                          markersize=5, markerfacecolor=color if is_converged else "none",
                          label=f"{front}: {label}")  # fmt: skip
    axis.set_xlabel("DLS fraction")
    axis.set_ylabel("energy lost, J/m")
    axis.set_title(f"random: {EQUAL_SPEED:g} m/s; tuned: {EQUAL_SPEED:g} m/s or more")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, fontsize=7)


def draw_indices(axis: Axes) -> None:
    """Draw the Sobol' indices with their confidence intervals."""
    indices = read_table(INDICES_TABLE)
    labels = {"damping": "$c$", "stiffness": "$k$", "natural_length": "$L^*$", "slope": "$\\phi$"}
    titles = {"dls_fraction": "DLS fraction", "speed": "speed", "gait exists": "a gait exists"}
    ticks = []
    for j, (measure, title) in enumerate(titles.items()):
        for i, row in enumerate(row for row in indices if row["measure"] == measure):
            x = j * (len(BOX) + 1) + i
            ticks.append((x, labels[row["parameter"]]))
            for shift, name, color in ((-0.2, "first_order", plots.LEG_1_COLOR),
                                       (0.2, "total", plots.LEG_2_COLOR)):  # fmt: skip
                lower, upper = map(float, row[f"{name}_95"].split(" to "))
                axis.bar(x + shift, float(row[name]), 0.4, color=color,
                         label=f"{name.replace('_', ' ')} index" if x == 0 else None)  # fmt: skip
                axis.plot([x + shift] * 2, [lower, upper], color="black", linewidth=0.8)
        axis.text(j * (len(BOX) + 1) + 1.5, 1.12, title, ha="center", fontsize=8)
    axis.axhline(0.0, color="black", linewidth=0.6)
    axis.set_xticks(*zip(*ticks, strict=True))
    axis.set_ylabel("Sobol' index, 95 % interval")
    axis.set_ylim(-0.3, 1.25)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, fontsize=7)


def compute_part(part: str, size: StudySize) -> None:
    """Compute one part, and write its table; all but the first two parts read the gaits."""
    if part == "gaits":
        rows = compute_gaits(size)
        add_sensitivities(rows)
        write_named_rows(GAITS_TABLE, rows)
    elif part == "indices":
        write_named_rows(INDICES_TABLE, compute_indices(size))
    else:
        table, compute_rows = PARTS_OF_GAITS[part]
        write_named_rows(table, compute_rows(read_table(GAITS_TABLE), size))


PARTS_OF_GAITS: dict[str, tuple[Path, Callable[[Sequence[Row], StudySize], list[Row]]]] = {
    "lives": (LIVES_TABLE, compute_lives),
    "contact": (CONTACT_TABLE, compute_contact),
    "fronts": (FRONTS_TABLE, compute_fronts),
}
PARTS = ("gaits", "indices", *PARTS_OF_GAITS)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART",
                        help="compute these parts alone: " + ", ".join(PARTS))  # fmt: skip
    parser.add_argument(
        "--redraw", action="store_true", help="draw the stored tables without computing"
    )
    arguments = parse_and_start_jax(parser)
    computed_parts = [] if arguments.redraw else arguments.only
    for part in computed_parts:
        compute_part(part, StudySize())
    run = describe_run("experiments.gaits.double_support")
    for name, (part, text) in make_blocks().items():
        replace_block(PAGE, name, text, run if part in computed_parts else None)
    with plots.figure_style():
        draw_comparisons()
        draw_fronts()


if __name__ == "__main__":
    main()
