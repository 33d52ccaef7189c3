"""Slow and fast gaits on real ground are branches with folds, in damping and in friction.

    python -m experiments.ground.branches [damping-slow ...] [--redraw]

Branches named are followed again, and the rows of others kept; without names, those still missing.

Pseudo-arclength continuation of fixed points of the step, stable or not; derivatives by central
differences, all branches and all differences side by side in the lanes of `vrw.steps`. Codes of
legs and feet are those of the last step, so that a branch goes on where the order of events
changes. Beside it: walks just beyond the fold in friction, which linger where the slow gait was.
"""

import csv
from dataclasses import dataclass, field

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D

import vrw_jax as vrw
from experiments.ground.friction_map import FIELDS, SETTLING_OPTIONS, compute_fields
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, Row, read_column, read_table, write_table
from vrw_jax import figures as plots

FRICTION, DAMPING = 0.7, 200.0  # held while the other one moves
SLOW, FAST = (0.1, 1.6, -0.1), (0.12, 2.4, -0.2)
BRANCHES = (  # along what, label, start, damping and friction there
    ("damping", "slow", SLOW, 320.0, FRICTION),
    ("damping", "fast", FAST, 200.0, FRICTION),
    ("friction", "slow", SLOW, DAMPING, 1.4),
    ("friction", "fast", FAST, DAMPING, 0.8),
)
BOUNDS = {"damping": (20.0, 400.0), "friction": (0.35, 2.5)}
N_TOWARDS = 150  # steps towards a branch's first gait
STEP = {"solver": "Tsit5", "rtol": 1e-10, "atol": 1e-10}
DIFFERENCE = 1e-5  # of central differences, of section states and of a parameter's range
FIRST, LARGEST, LEAST = 0.01, 0.05, 1e-4  # steps along a branch, in ranges
CLOSE, N_TRIES, N_POINTS = 3e-8, 6, 90
GHOSTS, N_GHOST = (0.003, 0.01, 0.03), 500  # less friction than the fold's; steps
SHOWN = {"dls_fraction": "DLS fraction", "period": "period [s]", "slip": "slip per step [m]"}
COLOURS = {"slow": plots.LEG_1_COLOR, "fast": plots.LEG_2_COLOR}
NUMBERS = 20  # of a section state move continuously, the rest are codes
TABLE, GHOST = FIGURES / "ground_branches.csv", FIGURES / "ground_ghost.csv"
HEADER = ("along", "branch", "way", "ended", "value", "spectral_radius", "slope", *FIELDS)


@dataclass
class Side:
    """One branch, followed one way."""

    along: str
    label: str
    held: dict[str, float]
    point: np.ndarray  # section numbers, and the parameter in ranges
    codes: np.ndarray
    tangent: np.ndarray
    size: float = FIRST
    rows: list = field(default_factory=list)
    ended: str = ""

    def value(self, p: float) -> float:
        low, high = BOUNDS[self.along]
        return low + p * (high - low)


def mapped(sides: list[Side], points: list[np.ndarray]) -> list[tuple]:
    """Each point's step: its result with all derivatives. Rows of `points[i]` belong to a side."""
    stencil = DIFFERENCE * np.eye(NUMBERS + 1)
    moves = np.concatenate([np.zeros((1, NUMBERS + 1)), stencil, -stencil])
    y = np.concatenate([point + moves for point in points])
    codes = np.repeat([side.codes for side in sides], len(moves), 0)
    columns = {name: [] for name in BOUNDS}
    for side, point in zip(sides, points, strict=True):
        for name, column in columns.items():
            own = side.value(point[-1] + moves[:, -1]) if name == side.along else side.held[name]
            column.append(np.broadcast_to(own, len(moves)))
    damping, friction = (np.concatenate(columns[name]) for name in ("damping", "friction"))
    found = vrw.step_batch(
        vrw.WheelParams(damping=damping),
        np.concatenate([y[:, :-1], codes], 1),
        model=vrw.UnilateralWheel(friction=friction),
        options=vrw.StepOptions(**STEP),
    )
    results = []
    for i in range(len(sides)):
        own = slice(i * len(moves), (i + 1) * len(moves))
        state, good = np.asarray(found.section_state)[own], np.asarray(found.outcome)[own] == 0
        ends = state[:, :NUMBERS]
        n = NUMBERS + 1
        jacobian = (ends[1 : 1 + n] - ends[1 + n :]).T / (2.0 * DIFFERENCE)
        results.append((ends[0], jacobian, state[0, NUMBERS:], good.all()))
    return results


def corrected(sides: list[Side], predicted: list[np.ndarray]) -> list[tuple | None]:
    """Newton's method back onto each branch, in the plane across its tangent."""
    points, done = [p.copy() for p in predicted], [None] * len(sides)
    open_ = list(range(len(sides)))
    for _ in range(N_TRIES):
        results = mapped([sides[i] for i in open_], [points[i] for i in open_])
        still = []
        for i, (end, jacobian, codes, good) in zip(open_, results, strict=True):
            side = sides[i]
            if not good:
                continue
            side.codes = codes
            matrix = jacobian - np.eye(NUMBERS, NUMBERS + 1)
            gap = np.append(end - points[i][:-1], side.tangent @ (points[i] - predicted[i]))
            if np.abs(gap).max() < CLOSE:
                done[i] = (points[i], jacobian, np.linalg.svd(matrix)[2][-1])
                continue
            points[i] = points[i] - np.linalg.lstsq(np.vstack([matrix, side.tangent]), gap)[0]
            still.append(i)
        open_ = still
        if not open_:
            break
    return done


def follow(branches: list[tuple]) -> list[Side]:
    """Branches, both ways."""
    columns = [np.array([b[k] for b in branches]) for k in (3, 4)]
    begun = vrw.step_batch(
        vrw.WheelParams(damping=columns[0]),
        np.array([b[2] for b in branches]),
        N_TOWARDS,
        model=vrw.UnilateralWheel(friction=columns[1]),
        options=vrw.StepOptions(**STEP),
    )
    sides = []
    for (along, label, _, c, mu), x in zip(branches, np.asarray(begun.section_state), strict=True):
        low, high = BOUNDS[along]
        p = ({"damping": c, "friction": mu}[along] - low) / (high - low)
        for sign in (1.0, -1.0):
            tangent = sign * np.eye(NUMBERS + 1)[-1]
            point, held = np.append(x[:NUMBERS], p), {"damping": c, "friction": mu}
            sides.append(Side(along, label, held, point, x[NUMBERS:], tangent))
    first = True
    while going := [side for side in sides if not side.ended]:
        step = [0.0 if first else side.size for side in going]
        predicted = [s.point + h * s.tangent for s, h in zip(going, step, strict=True)]
        before = [side.codes for side in going]
        for side, codes, told_ in zip(going, before, corrected(going, predicted), strict=True):
            if told_ is None:
                side.codes, side.size = codes, 0.5 * side.size
                side.ended = "lost" if first or side.size < LEAST else ""
                continue
            side.point, jacobian, tangent = told_
            side.tangent = tangent if tangent @ side.tangent > 0.0 else -tangent
            side.size = side.size if first else min(1.4 * side.size, LARGEST)
            radius = np.abs(np.linalg.eigvals(jacobian[:, :-1])).max()
            where = side.value(side.point[-1])
            state = np.append(side.point[:-1], side.codes)
            side.rows.append((where, radius, side.tangent[-1], state))
            if not 0.0 <= side.point[-1] <= 1.0:
                side.ended = "bound"
            elif len(side.rows) >= N_POINTS:
                side.ended = "points"
        first = False
    return sides


def compute(names: list[str]) -> None:
    """Follow the branches that are asked for or missing, and tell their points."""
    kept = read_table(TABLE) if TABLE.exists() else []
    asked = [b for b in BRANCHES if name_of(b) in names]
    done = {(row["along"], row["branch"]) for row in kept}
    branches = asked or [b for b in BRANCHES if b[:2] not in done]
    if not branches:
        return
    again = {b[:2] for b in branches}
    lines = [list(r.values()) for r in kept if (r["along"], r["branch"]) not in again]
    for side in follow(branches):
        print(side.along, side.label, len(side.rows), "points,", side.ended, flush=True)
        values = np.array([row[0] for row in side.rows])
        held = {name: np.full(len(values), value) for name, value in side.held.items()}
        columns = held | {side.along: values}
        if not len(values):
            continue
        fields = compute_fields(
            columns["friction"], columns["damping"], np.array([r[3] for r in side.rows])
        )
        way = "up" if side.rows[0][2] > 0.0 else "down"
        for (value, radius, slope, _), row in zip(side.rows, fields, strict=True):
            head = [side.along, side.label, way, side.ended]
            lines.append([*head, *(f"{x:.8g}" for x in (value, radius, slope, *row))])
    write_table(TABLE, HEADER, lines)


def name_of(branch: tuple) -> str:
    """As it is asked for."""
    return f"{branch[0]}-{branch[1]}"


def one_way(rows: list[Row], along: str, branch: str, way: str) -> list[Row]:
    """Points of a branch from its start up or down."""
    return [r for r in rows if (r["along"], r["branch"], r["way"]) == (along, branch, way)]


def fold(along: str) -> float:
    """Where the slow branch turns: a quartic through the seven gaits next to it, over the share of
    double support, which falls all along the branch."""
    own = one_way(read_table(TABLE), along, "slow", "down")
    value, share = (read_column(own, key) for key in ("value", "dls_fraction"))
    least = int(np.argmin(value))
    near = slice(least - 3, least + 4)
    x = share[near] - share[least]
    along_x = np.linspace(x.min(), x.max(), 100_001)
    return float(np.polyval(np.polyfit(x, value[near], 4), along_x).min())


def ghosts() -> None:
    """Walks from the slow start with a little less friction than the slow gait needs."""
    friction = fold("friction") - np.array(GHOSTS)
    params, model = vrw.WheelParams(damping=DAMPING), vrw.UnilateralWheel(friction=friction)
    x, lines = np.tile(SLOW, (len(GHOSTS), 1)), []
    options = vrw.StepOptions(**SETTLING_OPTIONS)
    for step in range(N_GHOST):
        found = vrw.step_batch(params, x, model=model, options=options)
        x = np.asarray(found.section_state)
        lines.append([step, *(f"{d:.8g}" for d in np.asarray(found.durations).sum(-1))])
    write_table(GHOST, ["step", *(f"{mu:.5f}" for mu in friction)], lines)


def draw() -> None:
    """Measures over damping and friction, stable gaits solid; walks beyond the fold."""
    rows = read_table(TABLE)
    figure, axes = plt.subplots(
        2, 4, figsize=(1.5 * plots.PAGE_WIDTH_INCHES, 4.6), width_ratios=(1.0, 1.0, 1.0, 1.1)
    )
    held = {"damping": f"friction $\\mu$ = {FRICTION}", "friction": f"$c$ = {DAMPING:g} N·s/m"}
    axis_names = {"damping": "damping $c$ [N·s/m]", "friction": "friction coefficient $\\mu$"}
    for line, (along, text) in zip(axes, held.items(), strict=True):
        for axis, (key, label) in zip(line, SHOWN.items(), strict=False):
            for branch, color in COLOURS.items():
                for way in ("up", "down"):
                    own = one_way(rows, along, branch, way)
                    x, y, radius, slope = (
                        read_column(own, k) for k in ("value", key, "spectral_radius", "slope")
                    )
                    stable = radius < 1.0
                    axis.plot(x, y, color=color, ls=":", lw=1.2)
                    axis.plot(x, np.where(stable, y, np.nan), color=color, lw=2.0)
                    for i in np.flatnonzero(slope[1:] * slope[:-1] < 0.0):
                        axis.plot(x[i + 1], y[i + 1], "k.", ms=8)
            axis.set(xlabel=axis_names[along], ylabel=label, title=text)
            if key == "slip":
                axis.set_yscale("log")
    lines = [Line2D([], [], color=c, lw=2.0, label=f"{name} gait") for name, c in COLOURS.items()]
    lines += [
        Line2D([], [], color="black", lw=2.0, label="stable"),
        Line2D([], [], color="black", ls=":", lw=1.2, label="unstable"),
        Line2D([], [], color="black", ls="", marker=".", ms=8, label="fold"),
    ]
    figure.legend(handles=lines, loc="outside lower center", ncols=5)
    with GHOST.open() as file:
        header, *lines = list(csv.reader(file))
    walks = np.array(lines, float)
    grid = axes[0, 3].get_gridspec()
    for axis in axes[:, 3]:
        axis.remove()
    beside = figure.add_subplot(grid[:, 3])
    for (column, mu), line in zip(enumerate(header[1:], 1), ("-", "--", "-."), strict=True):
        label = f"friction $\\mu$ = {float(mu):.4f}"
        beside.plot(walks[:, 0], walks[:, column], color="black", ls=line, label=label)
    title = f"walks beyond the fold, $c$ = {DAMPING:g} N·s/m"
    beside.set(xlabel="step", ylabel="period [s]", title=title)
    beside.legend()
    plots.save(figure, FIGURES, "ground_branches")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("branches", nargs="*", metavar="|".join(map(name_of, BRANCHES)), default=[])
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    chosen = parse_and_start_jax(parser)
    if not chosen.redraw:
        compute(chosen.branches)
        if not GHOST.exists():
            ghosts()
        print({along: fold(along) for along in BOUNDS})
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()
