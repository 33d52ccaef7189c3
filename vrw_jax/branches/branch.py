"""Define the results of a continuation: branches with special points, and curves of special points.

Test functions are quantities that vanish, jump or change their value at special points.
`BIFURCATIONS` is the table of those that follow from the Jacobian of the return map. Each kind of
branch adds test functions for its other quantities, such as margins.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.base import small_matrices
from vrw_jax.base.results import Outcome, format_html_table
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.small_matrices import (
    LOCATED_PAIR_CIRCLE_DISTANCE,
    MAX_CLOSED_FORM_SIZE,
    MIN_IMAGINARY_PART,
    UNIT_CIRCLE_DISTANCE,
    compute_multipliers,
    list_jury_margins,
)


class TestFunction(NamedTuple):
    """What follows where a quantity of a branch vanishes or changes.

    - `kind`: kind of the `SpecialPoint`;
    - `ends_branch`: whether the branch ends, because the order of events changes;
    - `is_stepwise`: whether the quantity has integer values, of which each change is located;
    - `explains`: kind of a change that is not reported where this quantity vanishes;
    - `n_multipliers`: number of multipliers that cross the unit circle.
    """

    kind: str
    ends_branch: bool = False
    is_stepwise: bool = False
    explains: str = ""
    n_multipliers: int = 0


FOLD, BRANCH_POINT, PERIOD_DOUBLING, NEIMARK_SACKER = (
    "fold", "branch_point", "period_doubling", "neimark_sacker",
)  # fmt: skip
BIFURCATIONS: Mapping[str, TestFunction] = {
    FOLD: TestFunction(FOLD, n_multipliers=1),
    PERIOD_DOUBLING: TestFunction(PERIOD_DOUBLING, n_multipliers=1),
    NEIMARK_SACKER: TestFunction(NEIMARK_SACKER, n_multipliers=2),
}
"""Bifurcations by name."""


def evaluate_bifurcations(jacobians: np.ndarray) -> dict[str, np.ndarray]:
    """Return the test functions of `BIFURCATIONS` by name, each of shape (...).

    They are det(1 - J), det(1 + J), and the product of 1 - z_i z_j over all pairs of multipliers.
    The last is NaN if there is no pair. Up to a size of 3, they are the first Jury margins.
    """
    n = jacobians.shape[-1]
    if n <= MAX_CLOSED_FORM_SIZE:
        margins = [*list_jury_margins(jacobians), np.full(jacobians.shape[:-2], np.nan)]
        return dict(zip(BIFURCATIONS, margins, strict=False))
    first, second = np.triu_indices(n, 1)
    multipliers = compute_multipliers(jacobians)
    margins = [
        np.linalg.det(np.eye(n) - jacobians),
        np.linalg.det(np.eye(n) + jacobians),
        np.prod(1.0 - multipliers[..., first] * multipliers[..., second], -1).real,
    ]
    return dict(zip(BIFURCATIONS, margins, strict=True))


def has_unit_circle_pair(jacobian: np.ndarray) -> bool:
    """Return whether a complex pair of multipliers lies on the unit circle.

    The test function of the Neimark-Sacker bifurcation also vanishes for two real reciprocal
    multipliers. Such multipliers are no bifurcation.
    """
    multipliers = compute_multipliers(jacobian)
    is_complex_pair = np.abs(multipliers.imag) > MIN_IMAGINARY_PART
    is_on_circle = np.abs(np.abs(multipliers) - 1.0) < LOCATED_PAIR_CIRCLE_DISTANCE
    return bool(np.any(is_on_circle & is_complex_pair))


def is_multiplier_change_explained(
    previous_jacobian: np.ndarray, next_jacobian: np.ndarray, has_parameter_turned_back: bool
) -> bool:
    """Return whether bifurcations explain the change of the multipliers between two points.

    A continuation step may pass several special points, or may end on a nearby branch. Both change
    the number of multipliers outside the unit circle, or the sign of the determinant of Newton's
    equations. On a single branch that sign changes only at folds and branch points.
    """
    jacobians = np.stack([previous_jacobian, next_jacobian])
    has_sign_change = {
        name: bool(values[0] * values[1] < 0.0)
        for name, values in evaluate_bifurcations(jacobians).items()
    }
    n_explained = sum(
        test.n_multipliers for name, test in BIFURCATIONS.items() if has_sign_change[name]
    )
    moduli = np.abs(compute_multipliers(jacobians))
    (least_before, least_after), (most_before, most_after) = (
        np.sum(moduli > 1.0 + distance, -1)
        for distance in (UNIT_CIRCLE_DISTANCE, -UNIT_CIRCLE_DISTANCE)
    )
    n_changed = max(least_after - most_before, least_before - most_after)
    return has_sign_change[FOLD] == has_parameter_turned_back and bool(n_changed <= n_explained)


def classify_multipliers(
    jacobian: np.ndarray, ranks: range, has_parameter_turned: bool
) -> dict[str, int]:
    """Return the number of multipliers for each bifurcation, by the name of the bifurcation.

    - `ranks`: ranks by modulus of the multipliers on the unit circle;
    - `has_parameter_turned`: whether the parameter changes its direction at the point. A multiplier
      of 1 is then that of a fold, and otherwise that of a branch point.
    """
    multipliers = compute_multipliers(jacobian)[list(ranks)]
    is_complex = np.abs(multipliers.imag) > MIN_IMAGINARY_PART
    counts = {
        FOLD if has_parameter_turned else BRANCH_POINT: ~is_complex & (multipliers.real > 0.0),
        PERIOD_DOUBLING: ~is_complex & (multipliers.real < 0.0),
        NEIMARK_SACKER: is_complex,
    }
    return {name: int(np.sum(mask)) for name, mask in counts.items() if np.any(mask)}


MAX_PRINTED_SPECIAL_POINTS = 20
"""Largest number of special points that are printed. The value is chosen because a branch then fits
on a screen.
"""


def _describe_ends(end_reasons: tuple[str, str]) -> str:
    """Return one text with the reasons for which a branch or curve ends at its two ends."""
    if end_reasons[0] == end_reasons[1]:
        return f"At both ends: {end_reasons[0]}"
    return f"At the first point: {end_reasons[0]} At the last point: {end_reasons[1]}"


def _format_ends(first_point: str, last_point: str, end_reasons: tuple[str, str]) -> list[str]:
    """Return a line for each end of a branch or curve, or one line if the reasons are equal."""
    if end_reasons[0] == end_reasons[1]:
        return [f"  at {first_point} and at {last_point}: {end_reasons[0]}"]
    return [f"  at {first_point}: {end_reasons[0]}", f"  at {last_point}: {end_reasons[1]}"]


class FixedPoint(NamedTuple):
    """Fixed point of a return map at one value of the continued parameter.

    - `section_state`: fixed point, shape (n,);
    - `parameter`: value of the continued parameter;
    - `jacobian`: Jacobian of the return map, shape (n, n);
    - `tangent`: direction of the branch: derivatives of the fixed point and of the parameter by arc
      length, shape (n + 1,).
    """

    section_state: np.ndarray
    parameter: float
    jacobian: np.ndarray
    tangent: np.ndarray = np.zeros(0)

    @property
    def multipliers(self) -> np.ndarray:
        """Return the Floquet multipliers in the order of decreasing modulus."""
        return np.asarray(small_matrices.floquet_multipliers(jnp.asarray(self.jacobian)))

    @property
    def spectral_radius(self) -> float:
        """Return the largest modulus of the Floquet multipliers."""
        return float(np.max(np.abs(self.multipliers)))


@dataclass(frozen=True, repr=False)
class SpecialPoint:
    """Special point of a branch: a bifurcation, a border collision or an end.

    At a border collision, an indicator or a margin is zero.

    - `kind`: "fold", "branch_point", "period_doubling", "neimark_sacker", "border_collision",
      "order_of_contacts_changes" or "order_of_events_changes" (the branch continues with a kink or
      a jump),
      "number_of_force_peaks_changes" (a peak appears or disappears) or "lost" (the order of events
      changes, as `name` describes);
    - `name`: name of the bifurcation, or of the quantity that vanishes or changes its sign;
    - `value`: value of the continued parameter at the special point;
    - `point`: fixed point next to the special point, on the side that belongs to the branch;
    - `ends_branch`: whether the branch ends at the special point;
    - `find_cycle`: function that finds the gait at the special point, for the property `cycle`;
    - `n_multipliers`: number of multipliers that cross the unit circle, 0 for other kinds;
    - `period_n`: number of steps after which the gaits of the branch repeat.

    Examples:
        >>> logistic = lambda _, x, r: r * x * (1.0 - x)
        >>> branch = vrw.continue_map(logistic, [0.6], 2.5, (2.0, 3.5))
        >>> print(branch.special_points[0].kind, branch.special_points[0].ends_branch)
        period_doubling False
    """

    kind: str
    name: str
    value: float
    point: FixedPoint
    ends_branch: bool
    find_cycle: Callable[[], Any] | None = field(default=None, repr=False, compare=False)
    n_multipliers: int = 0
    period_n: int = 1

    @functools.cached_property
    def cycle(self) -> Any:
        """Return the `LimitCycle` at the special point.

        A search near a fold may find no gait, because Newton's method is singular there. If the
        special point has no `find_cycle`, return the `FixedPoint` next to it.
        """
        return self.point if self.find_cycle is None else self.find_cycle()

    def __str__(self) -> str:
        special_point_name_text = "" if self.name == self.kind else f" {self.name}"
        ends_branch_text = ", ends the branch" if self.ends_branch else ""
        expected_multiplier_count = 2 if self.kind == "neimark_sacker" else 1
        if self.n_multipliers > expected_multiplier_count:
            special_point_name_text += f" of {self.n_multipliers} multipliers at once"
        return (
            f"{self.value:.9g}: "
            f"{self.kind.replace('_', ' ')}{special_point_name_text}{ends_branch_text}"
        )

    def __repr__(self) -> str:
        return f"SpecialPoint at {self}"


@dataclass(frozen=True, repr=False)
class Branch:
    """Branch of gaits in one parameter, and its special points in the order of the branch.

    - `parameter`: name of the continued parameter;
    - `dataset`: measures over the dimension `point`, with the parameter as a coordinate. The
      parameter changes its direction at folds;
    - `special_points`: bifurcations, border collisions and ends;
    - `ends`: reasons for which the branch ends at its first and at its last point, or for which it
      has no point;
    - `outcome`: NO_CYCLE_FOUND or BAD_INPUT if there is no gait from which a branch starts;
    - `params`: parameters of the walker at the start of the branch; None for a map, or without a
      gait;
    - `period_n`: number of steps after which the gaits of the branch repeat.

    Examples:
        >>> logistic = lambda _, x, r: r * x * (1.0 - x)
        >>> branch = vrw.continue_map(logistic, [0.6], 2.5, (2.0, 3.5))
        >>> branch.parameter, branch.ends
        ('parameter', ("The parameter's range ended.", "The parameter's range ended."))
    """

    parameter: str
    dataset: xr.Dataset
    special_points: tuple[SpecialPoint, ...]
    ends: tuple[str, str]
    outcome: Outcome
    params: Any = None
    period_n: int = 1

    @property
    def values(self) -> np.ndarray:
        """Return the value of the continued parameter at each point, shape (points,)."""
        return self.dataset[self.parameter].values

    @property
    def multipliers(self) -> np.ndarray:
        """Return the complex Floquet multipliers at each point, shape (points, n).

        The multipliers of a point are in the order of decreasing modulus.
        """
        return self.dataset.multiplier_real.values + 1j * self.dataset.multiplier_imag.values

    @property
    def section_states(self) -> np.ndarray:
        """Return the section state at which the gait at each point begins, shape (points, n)."""
        dataset = self.dataset
        return dataset["section_state" if "section_state" in dataset else "x"].values

    @property
    def stable(self) -> np.ndarray:
        """Return whether the gait at each point is stable, shape (points,)."""
        return self.dataset.spectral_radius.values < 1.0

    @property
    def ending(self) -> str:
        """Return one text with the reasons for which the branch ends at its first and at its last
        point.
        """
        if not self.values.size:
            return self.ends[0] or self.outcome.meaning
        return _describe_ends(self.ends)

    def __str__(self) -> str:
        values = self.values
        if not values.size:
            return f"Branch along {self.parameter}: none. {self.ending}"
        parameter_unit = self.dataset[self.parameter].attrs.get("units", "1")
        parameter_unit = "" if parameter_unit == "1" else f" {parameter_unit}"
        is_gait_stable = self.stable
        text_lines = [
            f"Branch along {self.parameter}: {values.size} gaits from "
            f"{values.min():.6g} to {values.max():.6g}{parameter_unit}, "
            f"{int(is_gait_stable.sum())} stable, {int((~is_gait_stable).sum())} unstable.",
            *_format_ends(f"{values[0]:.6g}", f"{values[-1]:.6g}", self.ends),
            f"  special points: {len(self.special_points)}",
            *(
                f"    {special_point}"
                for special_point in self.special_points[:MAX_PRINTED_SPECIAL_POINTS]
            ),
        ]
        if len(self.special_points) > MAX_PRINTED_SPECIAL_POINTS:
            text_lines.append(
                f"    and {len(self.special_points) - MAX_PRINTED_SPECIAL_POINTS} more, "
                "in .special_points"
            )
        return "\n".join(text_lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        ends_branch_texts = ("", "ends the branch")
        return format_html_table(
            str(self).split("\n  ")[0],
            ((f"{p.value:.9g}", p.kind.replace("_", " "), p.name, ends_branch_texts[p.ends_branch])
             for p in self.special_points),
            (self.parameter, "kind", "name", ""),
        )  # fmt: skip


@dataclass(frozen=True)
class Codim2Point:
    """Point of codimension two, at which a curve of special points meets another special point."""

    name: str  # name of the other special point
    values: tuple[float, float]  # values of the two parameters
    ends_curve: bool  # whether the curve ends at this point

    def __str__(self) -> str:
        ends_branch_text = ", ends the curve" if self.ends_curve else ""
        return f"({self.values[0]:.9g}, {self.values[1]:.9g}): meets {self.name}{ends_branch_text}"


@dataclass(frozen=True, repr=False)
class SpecialPointCurve:
    """Curve of a special point in two parameters.

    - `name`: name of the special point;
    - `parameters`: names of the two parameters;
    - `dataset`: durations, spectral radius and section state at each point of the curve, over the
      dimension `point`;
    - `codim2_points`: points at which the curve meets other special points;
    - `ends`: reasons for which the curve ends at its first and at its last point; they are equal
      for a closed curve.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
        >>> curve = vrw.continue_special_point("clearance_sls1", ("damping", "stiffness"), cycle)
        >>> curve.values.shape[1], curve.parameters
        (2, ('damping', 'stiffness'))
    """

    name: str
    parameters: tuple[str, str]
    dataset: xr.Dataset
    codim2_points: tuple[Codim2Point, ...]
    ends: tuple[str, str]

    @property
    def values(self) -> np.ndarray:
        """Return the values of the two parameters at each point, shape (points, 2)."""
        return np.stack([self.dataset[name].values for name in self.parameters], -1)

    @property
    def ending(self) -> str:
        """Return one text with the reasons for which the curve ends at its first and at its last
        point.
        """
        return _describe_ends(self.ends)

    def __str__(self) -> str:
        first_parameter_name, second_parameter_name = self.parameters
        text_lines = [
            f"Curve of {self.name} over {first_parameter_name} and {second_parameter_name}: "
            f"{len(self.values)} points."
        ]
        first_point, last_point = (
            "({:.6g}, {:.6g})".format(*self.values[point_index]) for point_index in (0, -1)
        )
        text_lines += _format_ends(first_point, last_point, self.ends)
        return "\n".join(
            [*text_lines, *(f"    {codim2_point}" for codim2_point in self.codim2_points)]
        )

    __repr__ = __str__
