"""Draw the wheel's coordinates, legs, forces and phases at instants of Table 1's gait.

    python -m experiments.paper.coordinates [folder]

The command writes `coordinates.svg` and `.png` to `results/` or the given folder.
"""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax.app import paper_reproduction as reproduction
from vrw_jax.plot import (
    DARK_GRAY_COLOR,
    LEG_1_COLOR,
    LEG_2_COLOR,
    PAGE_FIGURE_WIDTH_INCHES,
    figure_style,
    save,
)

METERS_PER_NEWTON = 1.0 / 280.0
"""Length of a force arrow per force."""

HALO = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85}
"""Background of a label, which keeps it readable over lines."""

PHASE_CAPTIONS = (
    ("Landing", "collision I: the fore foot hits\nthe ground and stays"),
    ("DLS", "double-limb support:\nboth feet on the ground"),
    ("SLS-I", "single-limb support I:\nLeg 2 extends in the air"),
    ("Stopper", "collision II: Leg 2 reaches\nits full length"),
    ("SLS-II", "single-limb support II: Leg 2\nlocked, until the next foot lands"),
)
"""Name and description of each event and phase of a step, in the order in which they happen."""


class Instant:
    """Geometry of the wheel at one instant, in a frame with vertical gravity."""

    def __init__(self, gait: xr.Dataset, time_index: int) -> None:
        self.state = gait.isel(time=time_index)
        self.slope = float(gait.attrs["parameter_slope"])
        self.parameters = {
            name: float(gait.attrs[f"parameter_{name}"]) for name in ("locked_length", "leg_com")
        }
        self.n_legs = int(gait.attrs["parameter_n_legs"])
        self.hub = self.rotate(self.state.hub_x, self.state.hub_z)
        self.feet = [
            self.rotate(self.state[f"foot_{leg}_x"], self.state[f"foot_{leg}_z"]) for leg in (1, 2)
        ]

    def rotate(self, x: float, z: float) -> np.ndarray:
        """Return a point or direction of the slope's frame in the vertical frame."""
        sine, cosine = np.sin(self.slope), np.cos(self.slope)
        return np.array([float(x) * cosine + float(z) * sine, float(z) * cosine - float(x) * sine])

    def leg_direction(self, leg: int) -> np.ndarray:
        """Return the unit vector from the hub to the foot of a leg."""
        angle = float(self.state.theta) + (leg - 1) * 2.0 * np.pi / self.n_legs
        return self.rotate(-np.sin(angle), -np.cos(angle))

    def leg_length(self, leg: int) -> float:
        """Return the length of a leg, m."""
        if leg <= 2:
            return float(self.state[f"L{leg}"])
        return self.parameters["locked_length"]

    def forces(self, foot: int) -> tuple[float, float]:
        """Return the tangential and the normal force of the ground on a foot, N."""
        first = 2 * foot - 1
        return float(self.state[f"lambda_{first}"]), float(self.state[f"lambda_{first + 1}"])


def draw_wheel(axes: Axes, instant: Instant, scale: float = 1.0) -> None:
    """Draw the ground, the legs with their point masses, and the hub."""
    ends = [instant.feet[0] + instant.rotate(x, 0.0) for x in (-1.75, 1.2)]
    axes.plot(*np.transpose(ends), color="black", linewidth=0.9 * scale, zorder=1)
    for leg in range(instant.n_legs, 0, -1):
        color = {1: LEG_1_COLOR, 2: LEG_2_COLOR}.get(leg, "#A8A8A8")
        width = (2.4 if leg <= 2 else 1.3) * scale
        foot = instant.hub + instant.leg_length(leg) * instant.leg_direction(leg)
        mass = foot - instant.parameters["leg_com"] * instant.leg_direction(leg)
        axes.plot(*np.transpose([instant.hub, foot]), color=color, linewidth=width, zorder=3,
                  solid_capstyle="round")  # fmt: skip
        axes.plot(*mass, "o", color=color, markersize=4.2 * scale, zorder=4)
    axes.plot(*instant.hub, "o", color="black", markersize=8.5 * scale, zorder=5)


def draw_arrow(axes: Axes, start: np.ndarray, vector: np.ndarray, color: str = "black") -> None:
    """Draw an arrow from a point along a vector."""
    arrow = {"arrowstyle": "-|>", "linewidth": 1.0, "color": color, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", start + vector, start, zorder=6, arrowprops=arrow)


def draw_labels(axes: Axes, instant: Instant) -> None:
    """Draw the coordinates, the parameters and the forces of double support."""
    hub, foot_1, foot_2 = instant.hub, *instant.feet

    def write(text: str, place: np.ndarray, color: str = "black", **style: str) -> None:
        axes.text(*place, text, color=color, bbox=HALO, zorder=8,
                  **{"ha": "center", "va": "center", "fontsize": 10.0} | style)  # fmt: skip

    normal, downhill = instant.rotate(0.0, 1.0), instant.rotate(1.0, 0.0)
    axes.plot(*np.transpose([foot_1, foot_1 + 1.3 * normal]), color=DARK_GRAY_COLOR, linewidth=0.7,
              linestyle=(0, (4, 2)), zorder=2)  # fmt: skip
    write(
        "normal to the slope, $\\theta = 0$",
        foot_1 + 1.38 * normal + 0.1 * downhill,
        DARK_GRAY_COLOR,
        fontsize=7.5,
    )
    degrees = lambda vector: float(np.degrees(np.arctan2(vector[1], vector[0])))
    leg_1_up, leg_2_up = -instant.leg_direction(1), -instant.leg_direction(2)
    first, last = sorted((degrees(normal), degrees(leg_1_up)))
    axes.add_patch(Arc(foot_1, 1.24, 1.24, theta1=first, theta2=last, linewidth=0.9, zorder=6))
    middle = np.radians(0.5 * (first + last))
    write(r"$\theta$", foot_1 + 0.72 * np.array([np.cos(middle), np.sin(middle)]))
    write("$\\theta$ is negative here and\ngrows as the wheel rolls downhill",
          foot_1 + 0.66 * normal + 0.84 * downhill, DARK_GRAY_COLOR, fontsize=7.5)  # fmt: skip
    first, last = sorted((degrees(-leg_1_up), degrees(-leg_2_up)))
    axes.add_patch(Arc(hub, 0.56, 0.56, theta1=first % 360, theta2=last % 360, linewidth=0.9))
    middle = np.radians(0.5 * (first + last))
    write(r"$\alpha$", hub + 0.37 * np.array([np.cos(middle), np.sin(middle)]))

    for leg, foot, color, side in ((1, foot_1, LEG_1_COLOR, 1.0), (2, foot_2, LEG_2_COLOR, -1.0)):
        place = hub + 0.5 * (foot - hub) + side * 0.13 * downhill
        write(f"$L_{leg}$", place, color)
        name = "Leg 1 (fore)" if leg == 1 else "Leg 2 (rear)"
        write(name, foot + np.array([0.0, -0.24]) + side * 0.2 * downhill, color, fontsize=9.0)
        tangential, vertical = instant.forces(leg)
        for value, direction, index in (
            (tangential, downhill, 2 * leg - 1),
            (vertical, normal, 2 * leg),
        ):
            vector = METERS_PER_NEWTON * value * direction
            draw_arrow(axes, foot, vector)
            offset = 0.11 * vector / np.linalg.norm(vector)
            write(rf"$\lambda_{index}$", foot + vector + offset, fontsize=9.5)
    locked = hub + 0.99 * instant.leg_direction(5)
    write("Legs 3 to 8:\nlocked on their stoppers", locked + np.array([0.33, 0.13]),
        DARK_GRAY_COLOR,
          fontsize=7.5)  # fmt: skip
    write("$m_H$", hub + np.array([-0.16, 0.19]), fontsize=9.0)
    locked_foot = hub + instant.leg_length(3) * instant.leg_direction(3)
    locked_mass = locked_foot - instant.parameters["leg_com"] * instant.leg_direction(3)
    write("$m$", locked_mass + 0.13 * normal, DARK_GRAY_COLOR, fontsize=9.0)
    write("$a$", 0.5 * (locked_foot + locked_mass) - 0.1 * normal, DARK_GRAY_COLOR, fontsize=9.0)

    corner = foot_1 + instant.rotate(1.2, 0.0)
    axes.plot([corner[0] - 0.75, corner[0]], [corner[1]] * 2, color=DARK_GRAY_COLOR, linewidth=0.6)
    axes.add_patch(Arc(corner, 1.1, 1.1, theta1=180 - np.degrees(instant.slope), theta2=180,
                       linewidth=0.7))  # fmt: skip
    write(r"$\varphi$", corner + np.array([-0.66, 0.085]), fontsize=9.5)
    draw_arrow(axes, foot_1 + instant.rotate(0.72, 0.2), 0.4 * downhill, DARK_GRAY_COLOR)
    write("downhill", foot_1 + instant.rotate(0.92, 0.31), DARK_GRAY_COLOR, fontsize=7.5,
          rotation=-np.degrees(instant.slope))  # fmt: skip
    gravity = hub + np.array([-1.25, 0.75])
    draw_arrow(axes, gravity, np.array([0.0, -0.3]), DARK_GRAY_COLOR)
    write("$g$", gravity + np.array([0.1, -0.15]), DARK_GRAY_COLOR)


def draw_phase(axes: Axes, instant: Instant, caption: tuple[str, str]) -> None:
    """Draw one small picture of a phase or an event, with the forces and a caption."""
    draw_wheel(axes, instant, 0.62)
    for foot in (1, 2):
        tangential, normal = instant.forces(foot)
        if normal > 0.0:
            draw_arrow(axes, instant.feet[foot - 1],
                       METERS_PER_NEWTON * instant.rotate(tangential, normal))  # fmt: skip
    frame_axes(axes, instant, 1.28)
    axes.set_title(caption[0], fontsize=9.0, pad=2.0)
    axes.text(0.5, -0.02, caption[1], transform=axes.transAxes, ha="center", va="top",
              fontsize=6.6, color=DARK_GRAY_COLOR)  # fmt: skip


def frame_axes(axes: Axes, instant: Instant, half_width: float) -> None:
    """Center the axes on the wheel, with equal scales and no frame."""
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_xlim(instant.hub[0] - half_width, instant.hub[0] + half_width)
    axes.set_ylim(instant.hub[1] - 1.33, instant.hub[1] + 1.15)


def draw_coordinates(gait: xr.Dataset) -> Figure:
    """Return the figure: the wheel in double support above, the five parts of a step below."""
    phases = gait.phase.values
    starts = [int(np.flatnonzero(phases == phase)[0]) for phase in range(3)]
    ends = [int(np.flatnonzero(phases == phase)[-1]) for phase in range(3)]
    middles = [(start + end) // 2 for start, end in zip(starts, ends, strict=True)]
    indices = (starts[0], middles[0], middles[1], starts[2], ends[2])
    with figure_style():
        figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 5.9))
        grid = figure.add_gridspec(2, 5, height_ratios=[3.0, 1.0])
        main_axes = figure.add_subplot(grid[0, :])
        instant = Instant(gait, middles[0] // 3)
        draw_wheel(main_axes, instant)
        draw_labels(main_axes, instant)
        frame_axes(main_axes, instant, 1.95)
        for column, (index, caption) in enumerate(zip(indices, PHASE_CAPTIONS, strict=True)):
            draw_phase(figure.add_subplot(grid[1, column]), Instant(gait, index), caption)
    return figure


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    save(draw_coordinates(reproduction.simulate_table_1_gait(1)), folder, "coordinates")


if __name__ == "__main__":
    main()
