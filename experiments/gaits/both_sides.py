"""Gaits at 1e-9 to both sides of a border's curve, found cold, differ in the sign of what vanishes.

    python -m experiments.gaits.both_sides [folder]

The eight borders of the branch along the damping (docs/explanation/branches.md) are followed over
the damping and each of stiffness, natural length and slope; beside random points of each curve
gaits are searched for from their parameters alone. An indicator's gaits are on one side only.
Writes `both_sides.csv` to `results/` or the folder given: by curve how many points were asked, at
how many the signs are right with the gaits found cold (which may be none, or another gait of the
wheel), at how many with the curve's own gait as a guess, and at how many neither. Some minutes of
one core.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared import tables
from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax.branches.special_point_curves import (
    DEFAULT_BOUNDS,
    ParameterBounds,
    continue_special_points,
)

SPECIAL_POINT_NAMES = ("lambda_2_plus", "lambda_4_plus", "clearance_sls1", "clearance_sls2",
"friction_fore",
           "friction_rear", "landing_friction_fore", "hit_planted_impulse")  # fmt: skip
SECONDS = ("stiffness", "natural_length", "slope")
POINTS = 24
"""Of each curve."""

DISTANCE = 1e-9
"""From a curve, as a share of the ranges of the parameters."""

SAME_GAIT_DISTANCE = 1e-3
"""Distance of section states below which gaits are one; beside a fold they part like its root."""

MARGINS_OF_JURY = ("fold", "period_doubling", "neimark_sacker")


def offset_points(
    curve: vrw.SpecialPointCurve, places: np.ndarray, box: ParameterBounds
) -> np.ndarray:
    """Values of the two parameters at the distance to either side, (side, place, parameter)."""
    widths = np.array([np.ptp(box[name]) for name in curve.parameters])
    shares = curve.values / widths
    tangential_part = shares[places + 1] - shares[places - 1]
    stacked_values = np.stack([-tangential_part[:, 1], tangential_part[:, 0]], -1)
    stacked_values /= np.linalg.norm(stacked_values, axis=1, keepdims=True)
    return (
        curve.values[places]
        + np.array([-1.0, 1.0])[:, None, None] * DISTANCE * stacked_values * widths
    )


class OffsetGaits(NamedTuple):
    """Gaits at some parameters."""

    has_gait: np.ndarray  # whether there is the gait that the curve has
    test_values: np.ndarray  # what vanishes on the curve


def find_offset_gaits(
    curve: vrw.SpecialPointCurve,
    places: np.ndarray,
    values: np.ndarray,
    options: vrw.CycleOptions,
    cold: bool,
) -> OffsetGaits:
    """The gaits there, from nothing or from the curve's own."""
    params = vrw.WheelParams(**dict(zip(curve.parameters, values.T, strict=True)))
    params = jax.tree.map(lambda x: jnp.broadcast_to(x, len(values)), params)
    near = jnp.asarray(curve.dataset.section_state.values[places])
    tight = vrw.StepOptions.tight()
    if cold:
        gait = jax.vmap(lambda p: vrw.limit_cycle(p, options=options))(params)
    else:
        gait = jax.vmap(lambda p, x: vrw.limit_cycle(p, guess=x, options=options))(params, near)
    if curve.name in MARGINS_OF_JURY:
        result = gait.jury_margins[:, MARGINS_OF_JURY.index(curve.name)]
    elif curve.name.startswith("lambda_"):
        result = getattr(gait.indicators, curve.name.removesuffix("_plus"))
    elif curve.name == "clearance_sls1":
        result = gait.takeoff_acceleration
    elif curve.name == "duration_dls":
        result = jnp.where(gait.durations[..., 0] > 0.0, 1.0, -1.0)
    else:
        steps = jax.vmap(lambda p, x: vrw.step(p, x, options=tight))(params, gait.section_state)
        name, _, leg = curve.name.partition("[")
        result = getattr(steps.margins, name)
        result = result[:, int(leg[:-1]) - 3] if leg else result
    is_same = np.abs(np.asarray(gait.section_state - near)).max(1) < SAME_GAIT_DISTANCE
    return OffsetGaits(np.asarray(gait.found) & is_same, np.asarray(result))


def has_expected_sign(name: str, one: OffsetGaits, other: OffsetGaits) -> np.ndarray:
    """Whether signs differ; an indicator, with gaits on one side alone, is to vanish there."""
    if name.startswith("lambda_"):
        force = np.where(one.has_gait, one.test_values, other.test_values)
        return (one.has_gait != other.has_gait) & (force > 0.0) & (force < 1e-4)
    return one.has_gait & other.has_gait & (one.test_values * other.test_values < 0.0)


def judge_curve(
    curve: vrw.SpecialPointCurve,
    box: ParameterBounds,
    count: int,
    random: np.random.Generator,
    options: vrw.CycleOptions | None = None,
) -> dict:
    """A row of the table; by gaits of `CycleOptions.tight()`, if none are given."""
    options = vrw.CycleOptions.tight() if options is None else options
    inner = np.arange(1, len(curve.values) - 1)
    places = np.sort(random.choice(inner, min(count, len(inner)), replace=False))
    sides = offset_points(curve, places, box)
    good = {}
    for cold in (True, False):
        one, other = (find_offset_gaits(curve, places, values, options, cold) for values in sides)
        good[cold] = has_expected_sign(curve.name, one, other)
    value_at = curve.values[places][~good[True] & ~good[False]]
    return {
        "over": curve.parameters[1], "border": curve.name, "points of the curve": len(curve.values),
        "asked": len(places), "right, found cold": good[True].sum(),
        "right, from the curve's own gait": good[False].sum(),
        "neither": (~good[True] & ~good[False]).sum(),
        "where neither": " ".join(f"{v:.6g}" for v in value_at.ravel()[:4]),
    }  # fmt: skip


def main() -> None:
    folder, rows = parse_folder_and_start_jax(__doc__), []
    cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
    random, fine = np.random.default_rng(19), vrw.CycleOptions.tight().refine_mesh().refine_mesh()
    for second in SECONDS:
        for curve in continue_special_points(SPECIAL_POINT_NAMES, ("damping", second), cycle):
            rows.append(judge_curve(curve, DEFAULT_BOUNDS, POINTS, random, fine))
            print(rows[-1], flush=True)
            tables.write_named_rows(folder / "both_sides.csv", rows)


if __name__ == "__main__":
    main()
