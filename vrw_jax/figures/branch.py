"""Figures of branches with their borders, of orbit diagrams and of basins of attraction."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vrw_jax.branches import Border, Branch
from vrw_jax.figures.scan import OUTCOMES, SYMBOLS, axis_label
from vrw_jax.figures.walk import GREY, LEG_1, LEG_2, LIGHT, PAGE, style
from vrw_jax.results import MARGINS, MEASURES
from vrw_jax.walks import BEFORE
from vrw_jax.wheel import Outcome

COLOURS = {
    "fold": "#000000",
    "branch_point": "#000000",
    "period_doubling": "#000000",
    "neimark_sacker": "#000000",
    "lost": "#D55E00",
    "border_collision": "#009E73",
}
ENDS = "#D55E00"

TEXTS = {
    "lambda_I4": "$\\lambda_{I4}$ = 0: rear foot is freed by the landing",
    "lambda_2_plus": "$\\lambda_2^+$ = 0: fore foot would pull",
    "lambda_4_plus": "$\\lambda_4^+$ = 0: rear foot lifts at once",
    "clearance_sls1": "foot 2 scuffs as it takes off",
    "clearance_sls2": "foot 2 below ground at collision II",
    "fore_foot_force": "fore foot pulls",
    "contraction": "Leg 1 passes its stopper",
    "hit_planted_impulse": "collision II pulls at the foot",
    "rear_stopper_force": "Leg 2 leaves its stopper",
    "friction_fore": "fore foot needs friction μ",
    "friction_rear": "rear foot needs friction μ",
    "landing_friction_fore": "fore foot needs μ in landing",
    "landing_friction_rear": "rear foot needs μ in landing",
}
"""What happens at the zero of an indicator or a margin."""

PANELS = (
    (("dls_fraction", LEG_1),),
    (("spectral_radius", "#000000"),),
    (("lambda_2_plus", LEG_1), ("lambda_4_plus", LEG_2)),
    (("clearance_sls1", LEG_2),),
)
NAMES = {
    "dls_fraction": "DLS fraction",
    "spectral_radius": "moduli of multipliers",
    "lambda_2_plus": "$\\lambda_2^+$",
    "lambda_4_plus": "$\\lambda_4^+$",
    "clearance_sls1": "clearance in SLS-I [mm]",
}
PLANE_LABELS = {
    "theta_touchdown": "$\\theta^-$ [rad]",
    "dtheta_touchdown": "$\\dot\\theta^-$ [rad/s]",
    "dL1_touchdown": "$\\dot L_1^-$ [m/s]",
    "theta_post_impact": "$\\theta^+$ [rad]",
    "dtheta_post_impact": "$\\dot\\theta^+$ [rad/s]",
}


def border_text(border: Border) -> str:
    """What happens at a border, in a few words."""
    base, _, leg = border.name.partition("[")
    if leg:
        return f"{MARGINS[base].long_name}, leg {leg[:-1]}"
    return TEXTS.get(base, base.replace("_", " "))


def _pieces(branch: Branch) -> list[tuple[np.ndarray, bool]]:
    """Indices of stretches of one stability; each shares its last point with the next."""
    cuts = np.flatnonzero(np.diff(branch.stable.astype(int))) + 1
    parts = np.split(np.arange(branch.values.size), cuts)
    return [
        (np.append(part, part[-1] + 1) if part[-1] + 1 < branch.values.size else part,
         bool(branch.stable[part[0]]))
        for part in parts
    ]  # fmt: skip


def branch_figure(branch: Branch) -> Figure:
    """DLS fraction, multipliers, indicators and clearance along a branch, with its borders.

    Solid: stable; dashed: unstable. Borders are numbered from left to right.
    """
    values, data = branch.values, branch.dataset
    borders = sorted(branch.borders, key=lambda border: border.value)
    with style():
        rows = -(-len(borders) // 2)
        figure = Figure(figsize=(PAGE, 4.0 + 0.16 * rows))
        panels = figure.subplots(2, 2, sharex=True)
        for axes, series, letter in zip(panels.ravel(), PANELS, "abcd", strict=True):
            axes.text(-0.12, 1.02, f"({letter})", transform=axes.transAxes, ha="right", va="bottom")
            for name, colour in series:
                scale = 1e3 if name == "clearance_sls1" else 1.0
                columns = [_broken(name, scale * data[name].values)]
                if name == "spectral_radius":
                    columns = list(np.abs(branch.multipliers).T)
                for column in columns:
                    for places, stable in _pieces(branch):
                        line = "-" if stable else "--"
                        axes.plot(values[places], column[places], line, color=colour)
            _draw_borders(axes, borders, numbered=letter in "ab")
            label = ", ".join(NAMES[name] for name, _ in series)
            axes.set_ylabel(label + (" [N]" if "lambda_2_plus" in dict(series) else ""))
        panels[0, 1].axhline(1.0, color=GREY, linewidth=0.5)
        panels[0, 1].set_ylim(0.0, None)
        panels[1, 0].axhline(0.0, color=GREY, linewidth=0.5)
        panels[1, 1].axhline(0.0, color=GREY, linewidth=0.5)
        for name, colour in PANELS[2]:
            panels[1, 0].plot([], [], color=colour, label=NAMES[name])
        panels[1, 0].legend(loc="center left")
        clearance = 1e3 * data.clearance_sls1.values
        panels[1, 1].set_yscale("symlog", linthresh=0.1)
        panels[1, 1].set_ylim(2.0 * min(clearance.min(), -0.1), 2.0 * max(clearance.max(), 0.1))
        for axes in panels[1]:
            axes.set_xlabel(_axis(branch.parameter))
        _name_borders(figure, borders, _unit(branch.parameter))
    return figure


def _broken(name: str, values: np.ndarray) -> np.ndarray:
    """A clearance with a gap where it jumps: as the dip at take-off vanishes, the end counts."""
    if name.startswith("clearance"):
        values = values.copy()
        values[1:][values[:-1] * values[1:] < 0.0] = np.nan
    return values


def _axis(name: str) -> str:
    return axis_label(name) if name in SYMBOLS and name in MEASURES else name


def _unit(name: str) -> str:
    unit = MEASURES[name].unit if name in MEASURES else "1"
    return "" if unit == "1" else f" {unit.replace(' ', '·')}"


def _draw_borders(axes: Axes, borders: list[Border], numbered: bool) -> None:
    low, high = axes.get_xlim()
    last = -np.inf
    for i, border in enumerate(borders):
        colour = ENDS if border.ends_branch else COLOURS[border.kind]
        axes.axvline(border.value, color=colour, linewidth=0.7, linestyle=(0, (3, 1.5)), zorder=0)
        if numbered:
            last = max(border.value, last + 0.03 * (high - low))
            axes.annotate(
                str(i + 1),
                (last, 1.0),
                xycoords=("data", "axes fraction"),
                ha="center",
                va="bottom",
                fontsize=7.0,
                color=colour,
            )


def _name_borders(figure: Figure, borders: list[Border], unit: str) -> None:
    handles = [
        Line2D(
            [],
            [],
            color=ENDS if border.ends_branch else COLOURS[border.kind],
            linewidth=0.9,
            linestyle=(0, (3, 1.5)),
            label=f"{i + 1}  {border.value:.6g}{unit}: {border_text(border)}"
            + (" (ends here)" if border.ends_branch else ""),
        )
        for i, border in enumerate(borders)
    ]
    handles.append(Line2D([], [], color="black", linestyle="-", label="stable"))
    handles.append(Line2D([], [], color="black", linestyle="--", label="unstable"))
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=7.5)


def orbit_figure(orbits: xr.Dataset, border: float | None = None) -> Figure:
    """Post-impact rates and periods of all that attracts over a parameter.

    Open: the foot scuffs somewhere in that step; a cross: a step without double support.
    """
    parameter = str(orbits.attrs["parameter"])
    value = orbits[parameter].values
    lifts, scuffs = orbits.duration_dls.values == 0.0, orbits.clearance.values < 0.0
    with style():
        figure = Figure(figsize=(PAGE, 3.9))
        rates, periods = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
        groups = (
            (~lifts & ~scuffs, "o", LEG_1, LEG_1, "with DLS"),
            (~lifts & scuffs, "o", LEG_1, "white", "with DLS, foot 2 scuffs"),
            (lifts, "x", LEG_2, LEG_2, "rear foot lifts at once ($\\lambda_4^+ < 0$)"),
            (lifts & scuffs, "o", LEG_2, "none", "the same, foot 2 scuffs"),
        )
        for chosen, marker, colour, fill, text in groups:
            if chosen.any():
                rates.plot(
                    value[chosen],
                    orbits.dtheta_post_impact.values[chosen],
                    marker,
                    color=colour,
                    markerfacecolor=fill,
                    markersize=2.4 if marker == "o" else 3.4,
                    markeredgewidth=0.6,
                    linestyle="none",
                    label=text,
                )
        periods.plot(value, orbits.period.values, "s", color="black", markersize=2.0)
        for axes in (rates, periods):
            if border is not None:
                axes.axvline(border, color=ENDS, linewidth=0.7, linestyle=(0, (3, 1.5)), zorder=0)
            for left, right in _empty_stretches(orbits):
                axes.axvspan(left, right, color=LIGHT, linewidth=0.0, zorder=0)
        for left, right in _empty_stretches(orbits)[-1:]:
            rates.text(0.5 * (left + right), 0.5, "falls", rotation=90, ha="center", va="center",
                       transform=rates.get_xaxis_transform(), color=GREY)  # fmt: skip
        if border is not None:
            rates.text(border, 0.4, " $\\lambda_4^+ = 0$", color=ENDS,
                       transform=rates.get_xaxis_transform())  # fmt: skip
        rates.set_ylabel("rate after landing, $\\dot\\theta^+$ [rad/s]")
        rates.legend(loc="lower left", fontsize=7.5)
        periods.set_ylabel("period [steps]")
        periods.set_ylim(0.0, 1.0 + float(orbits.period.max()))
        periods.yaxis.get_major_locator().set_params(integer=True)
        periods.set_xlabel(_axis(parameter))
    return figure


def _empty_stretches(orbits: xr.Dataset) -> list[tuple[float, float]]:
    """Stretches of the parameter where no start settled."""
    tried = np.asarray(orbits.attrs["tried"], float)
    empty = ~np.isin(tried, orbits[orbits.attrs["parameter"]].values)
    half = 0.5 * (tried[1] - tried[0])
    cuts = np.flatnonzero(np.diff(empty.astype(int))) + 1
    parts = [part for part in np.split(np.arange(len(tried)), cuts) if empty[part[0]]]
    return [(tried[part[0]] - half, tried[part[-1]] + half) for part in parts]


def basin_figure(results: list[xr.Dataset], titles: list[str]) -> Figure:
    """Which starts of a plane end where, one panel per result; crosses are the gaits' own states.

    Shades of blue count the steps until the gait is reached; other colours are the falls.
    """
    codes = sorted({int(c) for r in results for c in np.unique(r.outcome) if c != Outcome.STEPPED})
    with style():
        figure = Figure(figsize=(PAGE, 3.3))
        panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
        most = max(float(r.steps.where(r.attractor >= 0).max()) for r in results)
        for axes, result, title in zip(panels, results, titles, strict=True):
            y, x = (str(d) for d in result.attractor.dims)
            steps = result.steps.where(result.attractor >= 0)
            image = axes.pcolormesh(
                result[x], result[y], steps, cmap="Blues_r", vmin=0.0, vmax=1.6 * most
            )
            image.set_rasterized(True)
            falls = result.outcome.where(result.outcome != Outcome.STEPPED)
            if codes:
                colours = ListedColormap([OUTCOMES[Outcome(code)][1] for code in codes])
                places = np.full(falls.shape, np.nan)
                for i, code in enumerate(codes):
                    places[falls.values == code] = i
                norm = BoundaryNorm(np.arange(len(codes) + 1) - 0.5, len(codes))
                fallen = np.ma.masked_invalid(places)
                if len(codes) == 1:
                    mesh = axes.pcolormesh(result[x], result[y], fallen, cmap=colours)
                else:
                    mesh = axes.pcolormesh(result[x], result[y], fallen, cmap=colours, norm=norm)
                mesh.set_rasterized(True)
            _mark_orbits(axes, result, x, y)
            axes.set_title(title)
            axes.set_xlabel(PLANE_LABELS[x])
        panels[0].set_ylabel(PLANE_LABELS[str(results[0].attractor.dims[0])])
        bar = figure.colorbar(image, ax=list(panels), aspect=25, pad=0.01)
        bar.set_label("steps until the gait is reached")
        bar.ax.set_ylim(0.0, most)
        patches = [Patch(facecolor=OUTCOMES[Outcome(c)][1], label=OUTCOMES[Outcome(c)][0])
                   for c in codes]  # fmt: skip
        figure.legend(handles=patches, loc="outside lower center", ncols=4, fontsize=7.5)
    return figure


def _mark_orbits(axes: Axes, result: xr.Dataset, x: str, y: str) -> None:
    if not {x, y} <= set(BEFORE):
        return
    columns = [BEFORE.index(x), BEFORE.index(y)]
    states = result.orbit_state.values.reshape(-1, len(BEFORE))[:, columns]
    axes.plot(*states.T, "+", color="#F0E442", markersize=6.0, markeredgewidth=1.2)
