"""Which starts end on which gait, and how the others fail: basins of attraction on a grid."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import Engine, Options
from vrw_jax.results import MARGINS, MEASURES, attrs_of, provenance
from vrw_jax.runtime import xarray as xr
from vrw_jax.walks.attractors import distinct, orbit_measures, settle
from vrw_jax.walks.stepping import ModelLike, one_wheel, options_of, rung_of
from vrw_jax.wheel import Outcome, WheelParams, transitions
from vrw_jax.wording import instance, reals, untraced, whole

BEFORE = ("theta_touchdown", "dtheta_touchdown", "dL1_touchdown")
"""The section state just before the first touchdown: rad, rad/s, m/s."""

AFTER = ("theta_post_impact", "dtheta_post_impact")
"""The state just after the first landing with both feet on the ground: rad, rad/s."""

Grid = Mapping[str, float | Sequence[float] | np.ndarray]
"""Values of each of `BEFORE`, or of each of `AFTER`; a single number is not an axis."""

NONE = -1
"""Index of no attractor."""


def basin(
    params: WheelParams,
    grid: Grid,
    *,
    model: ModelLike | None = None,
    options: Options | None = None,
    engine: Engine = "auto",
    most_steps: int = 200,
    longest_period: int = 16,
) -> xr.Dataset:
    """Where a walk from each start of `grid` ends.

    `grid` names all of `BEFORE`, such as {"theta_touchdown": 0.09, "dtheta_touchdown": np.linspace(
    1.0, 2.5, 60), "dL1_touchdown": np.linspace(-0.5, 0.2, 60)}, or all of `AFTER`; those with
    several values are the axes of the result, in this order. Each start is told by

    - `attractor`: index of the orbit that it settles on within `most_steps`, -1 for none;
    - `outcome`: STEPPED, or how it fell; BAD_INPUT where no landing leads to a state of `AFTER`;
    - `steps`: steps until it is within 1e-3 of the orbit for good, or until it fell.

    The orbits stand in `orbit_state` over (attractor_index, orbit_step), the one with most starts
    first, with their `orbit_period` in steps, DLS fraction and, on the paper's rung, least margins.
    On real ground section states are full ones; "auto" is real ground, which serves all starts.

    Args:
        params: the wheel.
        grid: a value or values for each of three coordinates of a start, by name.
        model: the rung; the paper's, `ViscoelasticWheel()`, by default.
        options: numerical choices of the steps.
        engine: who takes the steps, see `Options`.
        most_steps: that a walk may take.
        longest_period: of an orbit that is recognised, steps.

    Returns:
        A dataset over the axes of `grid`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> starts = {"theta_touchdown": 0.09, "dtheta_touchdown": [1.4, 1.6]}
        >>> starts |= {"dL1_touchdown": -0.1}
        >>> found = vrw.basin(vrw.WheelParams(damping=150.0), starts)
        >>> found.attractor.values.tolist()
        [0, 0]
    """
    model, options = _checked(params, model, options)
    options = options.by(engine)
    most_steps = whole("most_steps", most_steps)
    longest_period = whole("longest_period", longest_period)
    values = _values(grid)
    names = tuple(values)
    axes = [name for name in names if np.ndim(grid[name]) > 0]
    shape = tuple(len(values[name]) for name in axes)
    mesh = np.meshgrid(*values.values(), indexing="ij")
    places = np.stack([m.ravel() for m in mesh], -1)
    starts = places if names == BEFORE else _before_landing(params, places)
    reachable = np.isfinite(starts).all(-1)
    starts = np.where(reachable[:, None], starts, np.nan)
    full = functools.partial(model.full_section, params)
    starts = np.asarray(jax.vmap(full)(jnp.asarray(starts)))
    settled = settle(params, starts, model, options, most_steps, longest_period)
    attractors = distinct(settled)

    data = {
        "attractor": xr.Variable(
            axes,
            attractors.of_start.reshape(shape),
            {"long_name": "orbit that the walk settles on", "flag_none": NONE},
        ),
        "outcome": xr.Variable(axes, settled.outcome.reshape(shape), attrs_of("outcome")),
        "steps": xr.Variable(
            axes,
            settled.steps.reshape(shape),
            {"units": "1", "long_name": "steps until the orbit is reached, or the fall"},
        ),
    }
    labels = {name: _label(name, values[name], name in axes) for name in names}
    orbits = _orbits(params, attractors.orbits, longest_period, model, options)
    attrs = {
        "title": "Basins of attraction",
        "most_steps": most_steps,
        "starts": "before touchdown" if names == BEFORE else "after landing",
    }
    return xr.Dataset(data | orbits, labels, attrs | provenance(params, model, options))


def _label(name: str, values: np.ndarray, is_axis: bool) -> xr.Variable:
    dims, told = (name, values) if is_axis else ((), values[0])
    return xr.Variable(dims, told, dict(MEASURES[name].attrs))


def _checked(
    params: WheelParams, model: ModelLike | None, options: Options | None
) -> tuple[AbstractWheel, Options]:
    untraced("vrw.basin", "map vrw.walk over the starts", params, options)
    one_wheel(params, "ask for one basin after the other")
    rung, options = rung_of(model).upper, options_of(options)  # starts may lie anywhere
    options.require_reachable(np.dtype(params.damping.dtype))
    return rung, options


def _values(grid: Grid) -> dict[str, np.ndarray]:
    values = {name: np.asarray(reals(name, grid[name]), float) for name in _names(grid)}
    for name, value in values.items():
        if value.ndim > 1 or not value.size:
            raise ValueError(
                f"{name} has shape {value.shape}, but it is a number, or a list of at least one: "
                "give one axis of values."
            )
    return {name: np.atleast_1d(value) for name, value in values.items()}


def _names(grid: Grid) -> tuple[str, ...]:
    instance("grid", grid, Mapping, "write {'theta_touchdown': 0.09, 'dtheta_touchdown': ...}")
    for names in (BEFORE, AFTER):
        if set(grid) == set(names):
            return names
    raise ValueError(
        f"the grid names {', '.join(grid) or 'nothing'}, but it must name all of "
        f"{', '.join(BEFORE)}, or all of {', '.join(AFTER)}: give each a number or an axis."
    )


def _before_landing(params: WheelParams, places: np.ndarray) -> np.ndarray:
    """Section states with dL1- = 0 whose landing leads to (theta+, dtheta+); NaN where none does.

    The rate after the landing is proportional to that before.
    """
    s = params.symbols()

    def one(place: jax.Array) -> jax.Array:
        theta, wanted = place[0] + s.alpha, place[1]
        landing = transitions.land(s, theta, jnp.ones_like(wanted), jnp.zeros_like(wanted))
        dtheta = wanted / landing.motion.dtheta
        good = landing.stays & (dtheta > 0.0)
        return jnp.where(good, jnp.stack([theta, dtheta, 0.0 * dtheta]), jnp.nan)

    return np.asarray(jax.vmap(one)(jnp.asarray(places)))


def _orbits(
    params: WheelParams,
    orbits: list[np.ndarray],
    longest: int,
    model: AbstractWheel,
    options: Options,
) -> dict[str, xr.Variable]:
    n = len(orbits)
    states = np.full((n, longest, model.section_size(params)), np.nan)
    margins = MARGINS if model.section_size(params) == 3 else ()
    fractions, least = np.zeros(n), {name: np.zeros(n) for name in margins}
    for i, orbit in enumerate(orbits):
        states[i, : len(orbit)] = orbit
        told = orbit_measures(params, orbit, model, options)
        fractions[i] = told["duration_dls"].sum() / told["period"].sum()
        for name in margins:
            least[name][i] = told[name].min()
    return {
        "orbit_state": xr.Variable(
            ("attractor_index", "orbit_step", "component"),
            states,
            {"long_name": "section states of the orbit, lowest dtheta- first"},
        ),
        "orbit_period": xr.Variable(
            "attractor_index",
            np.array([len(orbit) for orbit in orbits], int),
            {"units": "1", "long_name": "steps until the orbit repeats"},
        ),
        "orbit_dls_fraction": xr.Variable(
            "attractor_index", fractions, dict(MEASURES["dls_fraction"].attrs)
        ),
        **{
            f"orbit_{name}": xr.Variable("attractor_index", values, dict(MARGINS[name].attrs))
            for name, values in least.items()
        },
    }


def share(result: xr.Dataset) -> dict[str, float]:
    """Share of starts by how they ended: "attractor 0", ..., or the name of the outcome."""
    told = result.attractor.values.ravel()
    codes = result.outcome.values.ravel()
    names = [
        f"attractor {a}"
        if a >= 0
        else ("unsettled" if c == Outcome.STEPPED else Outcome(int(c)).name)
        for a, c in zip(told, codes, strict=True)
    ]
    return {name: names.count(name) / len(names) for name in sorted(set(names))}
