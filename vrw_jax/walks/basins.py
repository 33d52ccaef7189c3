"""Basins of attraction: the gait that each start of a grid reaches, or how it fails."""

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
"""Names of the components of a section state just before touchdown, in rad, rad/s, m/s."""

AFTER = ("theta_post_impact", "dtheta_post_impact")
"""Names of the components of a state just after a landing on both feet, in rad, rad/s."""

Grid = Mapping[str, float | Sequence[float] | np.ndarray]
"""Values of each component of a start, by name; a single number is not an axis."""

NONE = -1
"""Index of a start that reaches no attractor."""


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
    """Return where a walk from each start of `grid` ends, as a labelled dataset.

    `grid` names all components of a start before touchdown, such as {"theta_touchdown": 0.09,
    "dtheta_touchdown": np.linspace(1.0, 2.5, 60), "dL1_touchdown": np.linspace(-0.5, 0.2, 60)}, or
    all of "theta_post_impact" and "dtheta_post_impact". Components with several values are the axes
    of the result, in this order. The variables over these axes are

    - `attractor`: index of the orbit that the walk reaches within `max_steps`, or -1;
    - `outcome`: STEPPED, or how the wheel fell; BAD_INPUT if no landing leads to the start;
    - `steps`: number of steps until the walk stays within 1e-3 of the orbit, or until the fall.

    The orbits are in `orbit_state` over (attractor_index, orbit_step), ordered by decreasing number
    of starts. Each has an `orbit_period` in steps, a DLS fraction and, for the paper's model, its
    least margins. With unilateral contact, section states are full states. "auto" means unilateral
    contact, which is valid for all starts.

    Args:
        params: the wheel.
        grid: one or more values of each component of a start, by name.
        model: the model; by default that of the paper, `ViscoelasticWheel()`.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.
        max_steps: largest number of steps of a walk.
        max_period: longest period, in steps, that is recognized.

    Returns:
        A dataset over the axes of `grid`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> starts = {"theta_touchdown": 0.09, "dtheta_touchdown": [1.4, 1.6]}
        >>> starts |= {"dL1_touchdown": -0.1}
        >>> basins = vrw.basin(vrw.WheelParams(damping=150.0), starts)
        >>> basins.attractor.values.tolist()
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
    """Return the coordinate of a component of the starts."""
    dims, told = (name, values) if is_axis else ((), values[0])
    return xr.Variable(dims, told, dict(MEASURES[name].attrs))


def _checked(
    params: WheelParams, model: ModelLike | None, options: Options | None
) -> tuple[AbstractWheel, Options]:
    """Return model and options with their defaults; raise if an argument is invalid."""
    untraced("vrw.basin", "map vrw.walk over the starts", params, options)
    one_wheel(params, "ask for one basin after the other")
    rung, options = rung_of(model).upper, options_of(options)  # valid for any start
    options.require_reachable(np.dtype(params.damping.dtype))
    return rung, options


def _values(grid: Grid) -> dict[str, np.ndarray]:
    """Return the values of each component as an array of one axis; raise for other shapes."""
    values = {name: np.asarray(reals(name, grid[name]), float) for name in _names(grid)}
    for name, value in values.items():
        if value.ndim > 1 or not value.size:
            raise ValueError(
                f"{name} has shape {value.shape}, but it is a number, or a list of at least one: "
                "give one axis of values."
            )
    return {name: np.atleast_1d(value) for name, value in values.items()}


def _names(grid: Grid) -> tuple[str, ...]:
    """Return the names of the components; raise unless the grid names all of one kind."""
    instance("grid", grid, Mapping, "write {'theta_touchdown': 0.09, 'dtheta_touchdown': ...}")
    for names in (BEFORE, AFTER):
        if set(grid) == set(names):
            return names
    raise ValueError(
        f"the grid names {', '.join(grid) or 'nothing'}, but it must name all of "
        f"{', '.join(BEFORE)}, or all of {', '.join(AFTER)}: give each a number or an axis."
    )


def _before_landing(params: WheelParams, places: np.ndarray) -> np.ndarray:
    """Return section states with dL1- = 0 whose landing leads to (theta+, dtheta+), or NaN.

    The angular rate after the landing is proportional to that before the landing.
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
    """Return states, periods, DLS fractions and least margins of the orbits."""
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
    """Return the share of starts by end: "attractor 0", ..., or the name of the outcome."""
    told = result.attractor.values.ravel()
    codes = result.outcome.values.ravel()
    names = [
        f"attractor {a}"
        if a >= 0
        else ("unsettled" if c == Outcome.STEPPED else Outcome(int(c)).name)
        for a, c in zip(told, codes, strict=True)
    ]
    return {name: names.count(name) / len(names) for name in sorted(set(names))}
