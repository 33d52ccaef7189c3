"""Check special-point curves by gaits at a relative distance of 1e-9 on both sides.

    python -m experiments.gaits.both_sides [folder]

The command follows the eight special points of the branch along the damping
(docs/explanation/branches.md) over the damping and one of stiffness, natural length and slope. At
random points of each curve it searches gaits on both sides. The test function must differ in sign.
An indicator has gaits on one side only, and must vanish there.

The table `both_sides.csv` in `results/` or the given folder counts the points per curve: those with
the right sign by a cold search, those with the right sign by a search from the curve's gait, and
those with neither. A cold search may find no gait, or another gait of the wheel. The command takes
some minutes on one core.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared import tables
from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax.branches.special_point_curves import (
    DEFAULT_PARAMETER_BOUNDS,
    ParameterBounds,
    continue_special_points,
)

SPECIAL_POINT_NAMES = ("lambda_2_plus", "lambda_4_plus", "clearance_sls1", "clearance_sls2",
"friction_fore",
           "friction_rear", "landing_friction_fore", "hit_planted_impulse")  # fmt: skip
SECOND_PARAMETERS = ("stiffness", "natural_length", "slope")
"""Parameters that vary together with the damping."""
N_POINTS_PER_CURVE = 24
"""Number of random points on each curve."""

RELATIVE_DISTANCE = 1e-9
"""Distance of the gaits from the curve, as a share of the parameters' ranges."""

SAME_GAIT_DISTANCE = 1e-3
"""Distance of section states below which two gaits count as one. Near a fold the distance of the
two
gaits grows like the square root of the parameter's."""

JURY_MARGIN_NAMES = ("fold", "period_doubling", "neimark_sacker")
"""Names of the special points in the order of `jury_margins`."""


def offset_points(
    curve: vrw.SpecialPointCurve, indices: np.ndarray, box: ParameterBounds
) -> np.ndarray:
    """Return the two parameters on both sides of the curve, shape (side, point, parameter)."""
    widths = np.array([np.ptp(box[name]) for name in curve.parameters])
    shares = curve.values / widths
    tangents = shares[indices + 1] - shares[indices - 1]
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], -1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (
        curve.values[indices]
        + np.array([-1.0, 1.0])[:, None, None] * RELATIVE_DISTANCE * normals * widths
    )


class OffsetGaits(NamedTuple):
    """Gaits beside a curve: whether each is the curve's gait, and the curve's test function."""

    has_gait: np.ndarray
    test_values: np.ndarray


def find_offset_gaits(
    curve: vrw.SpecialPointCurve,
    indices: np.ndarray,
    values: np.ndarray,
    options: vrw.CycleOptions,
    cold: bool,
) -> OffsetGaits:
    """Return the gaits at parameter values, from a cold search or from the gait of the curve."""
    params = vrw.WheelParams(**dict(zip(curve.parameters, values.T, strict=True)))
    params = jax.tree.map(lambda x: jnp.broadcast_to(x, len(values)), params)
    curve_states = jnp.asarray(curve.dataset.section_state.values[indices])
    tight = vrw.StepOptions.tight()
    if cold:
        gait = jax.vmap(lambda p: vrw.limit_cycle(p, options=options))(params)
    else:
        gait = jax.vmap(lambda p, x: vrw.limit_cycle(p, guess=x, options=options))(
            params, curve_states
        )
    if curve.name in JURY_MARGIN_NAMES:
        test_values = gait.jury_margins[:, JURY_MARGIN_NAMES.index(curve.name)]
    elif curve.name.startswith("lambda_"):
        test_values = getattr(gait.indicators, curve.name.removesuffix("_plus"))
    elif curve.name == "clearance_sls1":
        test_values = gait.takeoff_acceleration
    elif curve.name == "duration_dls":
        test_values = jnp.where(gait.durations[..., 0] > 0.0, 1.0, -1.0)
    else:
        steps = jax.vmap(lambda p, x: vrw.step(p, x, options=tight))(params, gait.section_state)
        name, _, leg = curve.name.partition("[")
        test_values = getattr(steps.margins, name)
        test_values = test_values[:, int(leg[:-1]) - 3] if leg else test_values
    is_same = np.abs(np.asarray(gait.section_state - curve_states)).max(1) < SAME_GAIT_DISTANCE
    return OffsetGaits(np.asarray(gait.found) & is_same, np.asarray(test_values))


def has_expected_sign(name: str, one: OffsetGaits, other: OffsetGaits) -> np.ndarray:
    """Return whether the signs of both sides differ; an indicator must be small on its one side
    instead."""
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
    """Return a row of the table; the options are those of `CycleOptions.tight()` by default."""
    options = vrw.CycleOptions.tight() if options is None else options
    inner = np.arange(1, len(curve.values) - 1)
    indices = np.sort(random.choice(inner, min(count, len(inner)), replace=False))
    sides = offset_points(curve, indices, box)
    has_right_sign = {}
    for cold in (True, False):
        one, other = (find_offset_gaits(curve, indices, values, options, cold) for values in sides)
        has_right_sign[cold] = has_expected_sign(curve.name, one, other)
    failed_values = curve.values[indices][~has_right_sign[True] & ~has_right_sign[False]]
    return {
        "over": curve.parameters[1], "border": curve.name, "points of the curve": len(curve.values),
        "asked": len(indices), "right, found cold": has_right_sign[True].sum(),
        "right, from the curve's own gait": has_right_sign[False].sum(),
        "neither": (~has_right_sign[True] & ~has_right_sign[False]).sum(),
        "where neither": " ".join(f"{v:.6g}" for v in failed_values.ravel()[:4]),
    }  # fmt: skip


def main() -> None:
    folder, rows = parse_folder_and_start_jax(__doc__), []
    cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
    random, fine = np.random.default_rng(19), vrw.CycleOptions.tight().refine_mesh().refine_mesh()
    for second in SECOND_PARAMETERS:
        for curve in continue_special_points(SPECIAL_POINT_NAMES, ("damping", second), cycle):
            rows.append(
                judge_curve(curve, DEFAULT_PARAMETER_BOUNDS, N_POINTS_PER_CURVE, random, fine)
            )
            print(rows[-1], flush=True)
            tables.write_named_rows(folder / "both_sides.csv", rows)


if __name__ == "__main__":
    main()
