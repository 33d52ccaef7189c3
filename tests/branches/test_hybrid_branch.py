"""Branches of gaits of a user's own walker, against values of its paper and of closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
from support.walkers import SIMPLEST_WALKER

import vrw_jax as vrw
from vrw_jax.hybrid import Guard, HybridSystem, Mode


def test_the_simplest_walker_doubles_its_period_near_the_slope_of_its_paper():
    """Garcia et al. (1998) print 0.0151 rad for the first period doubling."""
    tight = vrw.StepOptions.tight()
    gait = vrw.limit_cycle(
        {"slope": 0.009}, model=SIMPLEST_WALKER, guess=[0.2, -0.2], options=tight
    )
    branch = vrw.continue_branch(
        {"slope": 0.009},
        "slope",
        (0.006, 0.0155),
        model=SIMPLEST_WALKER,
        cycle=gait,
        step_options=tight,
    )
    (doubling,) = branch.special_points
    assert doubling.kind == "period_doubling"
    assert abs(doubling.value - 0.0151) < 5e-5  # the digits that are printed
    doubled = vrw.limit_cycle(
        {"slope": doubling.value},
        model=SIMPLEST_WALKER,
        guess=branch.dataset.x.sel(slope=doubling.value, method="nearest"),
        options=tight,
    )
    # A multiplier moves by 1e2 per unit of slope, and the slope is known to 1e-9 of its range.
    assert np.min(np.abs(np.asarray(doubled.multipliers) + 1.0)) < 1e-8


def test_a_rimless_wheel_of_a_user_has_the_speeds_of_its_closed_form_along_the_slope():
    """Drake's rimless wheel: the squared rate after a collision is c² r² + 4 g c² sin a sin s."""
    alpha = np.pi / 8
    wheel = HybridSystem(
        modes={
            "stance": Mode(
                lambda y, p: jnp.stack([y[1], p["gravity"] * jnp.sin(y[0])]),
                {
                    "touchdown": Guard(
                        lambda y, p: p["wheel"]["slope"] + alpha - y[0],
                        lambda y, p: jnp.stack(
                            [p["wheel"]["slope"] - alpha, y[1] * jnp.cos(2 * alpha)]
                        ),
                    )
                },
            )
        },
        section="touchdown",
        state=("angle", "rate"),
        project=lambda y, p: y[1:],
        embed=lambda x, p: jnp.stack([p["wheel"]["slope"] - alpha, x[0]]),
    )
    params = {"gravity": 9.81, "wheel": {"slope": 0.2}}
    gait = vrw.limit_cycle(params, model=wheel, guess=[1.5])
    branch = vrw.continue_branch(params, "wheel.slope", (0.15, 0.3), model=wheel, cycle=gait)
    slopes = branch.dataset["wheel.slope"].values
    c2 = np.cos(2 * alpha) ** 2
    rates = np.sqrt(4 * 9.81 * c2 / (1 - c2) * np.sin(alpha) * np.sin(slopes))
    np.testing.assert_allclose(branch.dataset.x.values[:, 0], rates, rtol=1e-9)
    with pytest.raises(ValueError, match="choose from gravity, wheel"):
        vrw.continue_branch(params, "incline", (0.15, 0.3), model=wheel, cycle=gait)
