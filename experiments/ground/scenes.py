"""Walk scenes with unilateral contact in which the paper's model ends or is not valid.

    python -m experiments.ground.scenes [--redraw]

The scenes are scuffing, bouncing, the gait beyond λ4⁺ = 0 and early touchdown. Each walk starts at
the paper's gait with the nearest damping. The figures show ground forces and foot heights of the
last good step, with the step of the paper's model from the same start, and the time in each pair of
contact modes.
"""

import math

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Patch

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, read_column, read_table, write_table
from vrw_jax import plot as plots
from vrw_jax.models import compute_foot_heights, compute_leg_directions, unpack_state

NO_SLIP, FINITE_FRICTION = math.inf, 0.7
GAIT_RANGE = (8.0, 215.0)
"""Dampings, N s/m, at which the paper's gait is the start."""
FAST_START = (0.1, 2.0, -0.1)
SCENES = [
    *((f"bouncing, c = {c:g}", NO_SLIP, c, None) for c in (1.0, 2.0, 3.0, 4.0)),
    *((f"scuffing, c = {c:g}", NO_SLIP, c, None) for c in (50.0, 100.0)),
    *((f"lost gait, c = {c:g}", NO_SLIP, c, None) for c in (220.0, 225.0, 250.0, 280.0, 300.0)),
    ("early touchdown, c = 200", NO_SLIP, 200.0, FAST_START),
    *(
        (f"friction 0.7, c = {c:g}", FINITE_FRICTION, c, None)
        for c in (4.0, 50.0, 100.0, 200.0, 250.0, 300.0)
    ),
]
"""Label, friction, damping and start. A start of None means the paper's gait at the nearest
damping."""
SHOWN_SCENES = (
    "bouncing, c = 4",
    "scuffing, c = 50",
    "lost gait, c = 225",
    "friction 0.7, c = 250",
)
N_STEPS, N_SAMPLES = 60, 40
OPTIONS = {"solver": "Tsit5", "rtol": 1e-9, "atol": 1e-9}
MODES = ("air", "rest", "down", "up")
MODE_LABELS = {"air": "air", "rest": "rest", "down": "slides down", "up": "slides up"}
MODE_COLORS = {"air": "#FFFFFF", "rest": "#56B4E9", "down": "#E69F00", "up": "#CC79A7"}
MODE_HATCHES = {"air": "", "rest": "..", "down": "\\\\", "up": "//"}
SCENE_TABLE = FIGURES / "unilateral_scenes.csv"


def make_starts() -> np.ndarray:
    """Return the start of each scene as a section state with unilateral contact."""
    _, friction, damping, given = zip(*SCENES, strict=True)
    x = []
    for mu, c, start in zip(friction, damping, given, strict=True):
        params = vrw.WheelParams(damping=float(np.clip(c, *GAIT_RANGE)))
        start = vrw.limit_cycle(params).section_state if start is None else jnp.asarray(start)
        x.append(
            np.asarray(
                vrw.UnilateralWheel(
                    friction=mu, infinite_friction_rule="paper"
                ).complete_section_state(params, start)
            )
        )
    return np.stack(x)


@jax.jit
@jax.vmap
def compute_step(friction: jax.Array, damping: jax.Array, x: jax.Array) -> vrw.UnilateralStep:
    """Return the step from a section state."""
    params = vrw.WheelParams(damping=damping)
    wheel = vrw.UnilateralWheel(friction=friction, infinite_friction_rule="paper")
    return wheel.take_step(params, x, vrw.StepOptions(**OPTIONS))


def walk_scene(friction: np.ndarray, damping: np.ndarray, x: np.ndarray) -> tuple:
    """Return outcomes, starts of the last good steps, these steps, all periods, and numbers of
    steps."""
    params = vrw.WheelParams(damping=damping)
    model = vrw.UnilateralWheel(friction=friction, infinite_friction_rule="paper")
    outcome, last_start, periods = np.zeros(len(x), int), x, []
    count = np.zeros(len(x), int)
    for _ in range(N_STEPS):
        batch_result = vrw.step_batch(params, x, model=model, options=vrw.StepOptions(**OPTIONS))
        has_stepped = (outcome == 0) & (np.asarray(batch_result.outcome) == 0)
        outcome = np.where(outcome == 0, np.asarray(batch_result.outcome), outcome)
        last_start = np.where(has_stepped[:, None], x, last_start)
        x = np.asarray(batch_result.section_state)
        periods.append(np.asarray(batch_result.durations).sum(-1))
        count += has_stepped
    step = compute_step(jnp.asarray(friction), jnp.asarray(damping), jnp.asarray(last_start))
    return outcome, last_start, step, np.stack(periods, 1), count


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--redraw", action="store_true", help="draw the stored mode durations without walking"
    )
    if not parse_and_start_jax(parser).redraw:
        compute()
    with plots.figure_style():
        draw_modes()


def compute() -> None:
    """Walk the scenes, write their table, and draw the last steps of some scenes."""
    labels, friction, damping, _ = zip(*SCENES, strict=True)
    outcome, last_starts, step, periods, count = walk_scene(
        np.array(friction), np.array(damping), make_starts()
    )
    header = ("scene", "friction", "damping", "steps", "outcome", "period_s", "period_spread_s")
    measure_columns = (
        "dls_fraction",
        "flight_fraction",
        "speed_m_s",
        "slip_m",
        "events",
        "solutions",
    )
    pairs, rows = [f"share_{a}_{b}" for a in MODES for b in MODES], []
    for i, label in enumerate(labels):
        n, period = int(count[i]), float(step.period[i])
        spread = float(np.ptp(np.asarray(periods[i, max(n - 5, 0) : n]))) if n else 0.0
        name = vrw.Outcome(int(outcome[i])).name
        numbers = [
            step.dls_fraction[i],
            step.durations[i, 2] / max(period, 1e-9),
            step.speed[i],
            step.slip[i],
            int(step.events[i]),
            int(step.most_solutions[i]),
            *(np.asarray(step.mode_durations[i]).ravel() / max(period, 1e-9)),
        ]
        row = [label, friction[i], damping[i], n, name, f"{period:.6f}", f"{spread:.1e}"]
        rows.append([*row, *(f"{float(v):.5g}" for v in numbers)])
    write_table(SCENE_TABLE, (*header, *measure_columns, *pairs), rows)
    with plots.figure_style():
        draw([labels.index(name) for name in SHOWN_SCENES], labels, friction, damping, last_starts)


def draw(chosen: list[int], labels: tuple, friction: tuple, damping: tuple, x: np.ndarray) -> None:
    """Draw ground forces and foot heights of the last steps, and those of the paper's model."""
    figure, axes = plt.subplots(2, len(chosen), figsize=(1.9 * len(chosen), 4.2), sharey="row")
    paper = vrw.ViscoelasticWheel(stop_at_lift_off=False)
    for column, i in enumerate(chosen):
        params = vrw.WheelParams(damping=damping[i])
        wheel = vrw.UnilateralWheel(friction=friction[i], infinite_friction_rule="paper")
        trace = wheel.sample_step(params, jnp.asarray(x[i]), vrw.StepOptions(), N_SAMPLES)
        s, force_axis, height_axis = params.symbols(), axes[0, column], axes[1, column]
        heights = jax.vmap(
            jax.vmap(
                lambda y, s=s: compute_foot_heights(
                    unpack_state(y)[0], compute_leg_directions(s, unpack_state(y)[0].theta)
                )
            )
        )(trace.state)
        active_parts = np.flatnonzero(np.asarray(trace.duration) > 0.0)
        time = np.concatenate([np.asarray(trace.time[k]) for k in active_parts])
        paper_start = x[i][[0, 1, 4 + params.n_legs]]
        paper_step = vrw.simulate(params, paper_start, 1, model=paper, n_samples=N_SAMPLES)
        for leg, (name, color) in enumerate((("fore foot", "C0"), ("rear foot", "C1"))):
            concatenate_parts = lambda values, leg=leg, active_parts=active_parts: np.concatenate(
                [np.asarray(values[k])[:, leg] for k in active_parts]
            )
            force_axis.plot(time, concatenate_parts(trace.normal), color, label=f"{name}, normal")
            force_axis.plot(
                time, concatenate_parts(trace.tangential), color + "--", label=f"{name}, tangential"
            )
            height_axis.plot(time, 1e3 * concatenate_parts(heights), color, label=name)
            grey = {"color": "0.6", "lw": 1.0, "zorder": 0, "ls": "-" if leg == 0 else "-."}
            label = f"{name}, paper's model"
            force_axis.plot(
                paper_step.time, paper_step[f"lambda_{2 * leg + 2}"], **grey, label=label
            )
            if leg == 1:
                height_axis.plot(paper_step.time, 1e3 * paper_step.foot_2_z, **grey, label=label)
        force_axis.set_title(add_unit(labels[i]).replace(", ", "\n"))
        height_axis.set(xlabel="time since landing [s]", ylim=(-25.0, 60.0))
    axes[0, 0].set_ylabel("ground force [N]")
    axes[1, 0].set_ylabel("foot height [mm]")
    axes[0, 0].legend(fontsize=5)
    axes[1, 0].legend(fontsize=5)
    plots.save(figure, FIGURES, "unilateral_scenes")


def draw_modes() -> None:
    """Draw the time in each pair of contact modes; colors are the front foot, and hatches the rear
    foot."""
    rows = read_table(SCENE_TABLE)
    figure, axis = plt.subplots(figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 4.4))
    bar_start = np.zeros(len(rows))
    for first, color in MODE_COLORS.items():
        for second, hatch in MODE_HATCHES.items():
            share = 100.0 * read_column(rows, f"share_{first}_{second}")
            style = {"color": color, "hatch": hatch, "edgecolor": "black", "linewidth": 0.4}
            axis.barh([add_unit(row["scene"]) for row in rows], share, left=bar_start, **style)
            bar_start += share
    axis.invert_yaxis()
    axis.set(xlabel="share of the step [%]", xlim=(0.0, 100.0))
    edge = {"edgecolor": "black", "linewidth": 0.4}
    feet = (
        ("fore foot: color", [
            Patch(facecolor=MODE_COLORS[m], label=MODE_LABELS[m], **edge) for m in MODES
        ]),
        ("rear foot: hatch", [
            Patch(facecolor="white", hatch=MODE_HATCHES[m], label=MODE_LABELS[m], **edge)
            for m in MODES
        ]),
    )  # fmt: skip
    for (title, handles), place in zip(feet, ("upper", "lower"), strict=True):
        figure.legend(handles=handles, title=title, loc=f"outside right {place}", handleheight=1.4)
    plots.save(figure, FIGURES, "unilateral_modes")


def add_unit(label: str) -> str:
    """Return the label of a scene with the unit of its damping."""
    name, _, damping = label.partition(", c = ")
    return f"{name}, $c$ = {damping} N·s/m"


if __name__ == "__main__":
    main()
