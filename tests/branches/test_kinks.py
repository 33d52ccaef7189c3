"""Branches on unilateral contact go on where contacts change their order, and end at tan(slope)."""

from dataclasses import dataclass

import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.branches.arclength import (
    AbstractContinuationProblem,
    ArclengthOptions,
    NewtonStep,
)
from vrw_jax.branches.branch_continuation import Continuation
from vrw_jax.branches.branch_location import continue_and_locate_special_points, find_state_jumps

TAN = float(np.tan(0.3))


@dataclass(frozen=True)
class Bent(AbstractContinuationProblem):
    """x = p/2 for p < 0, else x = slope p: a branch with a kink at 0."""

    slope: float
    has_kinks = True

    def linearize(self, wheels, z, p):
        slope = np.where(p[:, None] < 0.0, 0.5, self.slope)
        return NewtonStep(slope * p[:, None] - z, slope, np.zeros((len(z), 1, 1)))


@pytest.mark.parametrize("slope", [-0.3, -2.0])
def test_a_branch_passes_a_kink_at_which_no_step_is_short_enough(slope):
    """Its tangent turns there by 76 or 121 degrees; an option forbids more than 0.2 rad."""
    run = Continuation(Bent(slope), ArclengthOptions(), np.array([-1.0, 1.0]), np.zeros(1))
    begin = np.array([[-0.25]]), np.array([-0.5])
    (strand,) = continue_and_locate_special_points(run, *begin, np.array([True]))
    p, x = np.asarray(strand.points.p), np.asarray(strand.points.z)[:, 0]
    assert p[[0, -1]].tolist() == [-1.0, 1.0]
    np.testing.assert_allclose(x, np.where(p < 0.0, 0.5 * p, slope * p), atol=1e-12)


def continue_friction(damping, friction, lowest_friction, highest_friction):
    return vrw.continue_branch(
        vrw.WheelParams(damping=damping),
        "friction",
        (lowest_friction, highest_friction),
        model=vrw.UnilateralWheel(friction=friction),
    )


def down_to_the_slope(damping, friction, highest_friction):
    return continue_friction(damping, friction, 0.30, highest_friction)


def assert_ends_at_the_slope(branch, highest_friction):
    """Friction below the tangent of the slope can't carry the weight along it over a period."""
    assert abs(branch.values[0] - TAN) < 1e-6
    assert "tangent of the slope" in branch.ends[0]
    assert branch.values[-1] == highest_friction
    end = branch.special_points[0]
    assert end.ends_branch
    assert abs(end.value - TAN) < 1e-6
    assert branch.stable.all()
    assert branch.dataset.closure.max() < 1e-8


def assert_goes_on_at_the_kink(branch):
    changes = [b for b in branch.special_points if b.kind == "order_of_contacts_changes"]
    (kink,) = [b for b in changes if abs(b.value - 0.3293878) < 1e-6]
    assert not kink.ends_branch
    assert str(kink) == f"{kink.value:.9g}: order of contacts changes"
    i = int(np.searchsorted(branch.values, kink.value))
    state = branch.dataset.section_state.values
    assert state[i - 1, 20] != state[i, 20]  # the foot slides before the landing, or rests
    # Without a jump, the states change between both points as slowly as beside the kink.
    changes = np.max(np.abs(np.diff(state[:, :20], axis=0)), axis=1) / np.diff(branch.values)
    assert changes[i - 1] < 1.1 * max(changes[i - 2], changes[i])


@pytest.mark.slow
def test_a_branch_goes_on_where_contacts_change_their_order():
    branch = continue_friction(250.0, 0.3296, 0.3292, 0.3296)
    assert branch.values[[0, -1]].tolist() == [0.3292, 0.3296]
    assert_goes_on_at_the_kink(branch)


@pytest.mark.slow
def test_from_either_side_of_the_kink_the_branch_is_the_same():
    from_above, below = (down_to_the_slope(250.0, mu, 0.331) for mu in (0.331, 0.325))
    for branch in (from_above, below):
        assert_ends_at_the_slope(branch, 0.331)
        assert_goes_on_at_the_kink(branch)
    ours, theirs = ([b.value for b in branch.special_points] for branch in (from_above, below))
    np.testing.assert_allclose(theirs, ours, atol=1e-8)
    speeds = np.interp([0.315, 0.3293, 0.3295], below.values, below.dataset.speed)
    again = np.interp([0.315, 0.3293, 0.3295], from_above.values, from_above.dataset.speed)
    np.testing.assert_allclose(speeds, again, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [230.0, 300.0, 350.0])
def test_slow_gaits_of_other_dampings_reach_the_slope_too(damping):
    assert_ends_at_the_slope(down_to_the_slope(damping, 0.34, 0.34), 0.34)


@pytest.mark.slow  # its branch takes more than a minute
def test_the_shipped_branch_on_unilateral_contact_reaches_both_ends_of_its_range():
    """At 0.5201 a leg meets its stopper as its foot lands: the two impacts do not commute."""
    branch = vrw.continue_branch(
        vrw.WheelParams(), "friction", (0.5, 1.0), model=vrw.UnilateralWheel(friction=0.7)
    )
    assert branch.values[[0, -1]].tolist() == [0.5, 1.0]
    assert all("range ended" in end for end in branch.ends)
    first = branch.special_points[0]
    assert first.kind == "order_of_contacts_changes"
    assert first.value == pytest.approx(0.5201063, abs=1e-6)
    assert branch.stable.all()
    known = vrw.limit_cycle(
        vrw.WheelParams(), model=vrw.UnilateralWheel(friction=0.51), which="slowest"
    )
    period = np.interp(0.51, branch.values, branch.dataset.period)
    assert period == pytest.approx(float(known.period), rel=1e-3)


def test_only_a_state_that_departs_from_both_tangents_jumps():
    """Neighbors on the unit circle do not jump, nor do points on both sides of a fold."""
    angles = np.linspace(0.3, 2.9, 9)
    states, shares = np.cos(angles)[:, None], np.sin(angles)
    pairs = [(i, i + 1) for i in range(8)]
    assert find_state_jumps(states, shares, np.cos(angles), pairs) == []
    across_fold = np.array([[0.1], [-0.1]]), np.array([0.995, 0.995]), np.array([0.1, -0.1])
    assert find_state_jumps(*across_fold, [(0, 1)]) == []
    across_jump = np.array([[0.0], [0.1]]), np.array([0.0, 1e-4]), np.array([0.6, 0.6])
    assert find_state_jumps(*across_jump, [(0, 1)]) == [(0, 1)]


@pytest.mark.slow
def test_a_fold_with_unilateral_contact_is_located_with_long_steps_too():
    """At c = 205 the slow gait needs friction 0.852084: docs/figures/ground_atlas_branches.csv."""
    branch = vrw.continue_branch(
        vrw.WheelParams(damping=205.0),
        "friction",
        (0.8, 1.0),
        model=vrw.UnilateralWheel(friction=1.0),
        options=ArclengthOptions(initial_ds=0.02, max_ds=0.06),
    )
    (fold,) = [point for point in branch.special_points if point.kind == "fold"]
    assert fold.value == pytest.approx(0.85208448, abs=1e-7)
