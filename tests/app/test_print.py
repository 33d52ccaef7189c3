"""Figures have the width of a printed column or page, readable texts, and embedded fonts."""

import itertools
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

import vrw_jax as vrw
import vrw_jax.continuation
import vrw_jax.hybrid
from vrw_jax.app import _walk_figures as _contact
from vrw_jax.branches import Branch, SpecialPoint
from vrw_jax.branches.branch import FixedPoint
from vrw_jax.plot import ground_forces, style
from vrw_jax.wheel import ContactMode

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def paper_walk() -> xr.Dataset:
    return vrw.simulate(vrw.WheelParams(), n_steps=3, n_samples=40)


@pytest.fixture(scope="module")
def rigid_walk() -> xr.Dataset:
    params = vrw.WheelParams(slope=0.1)
    return vrw.simulate(params, n_steps=2, n_samples=20, model=vrw.RigidWheel())


@pytest.fixture(scope="module")
def sliding_walk() -> xr.Dataset:
    ground = vrw.UnilateralWheel(friction=0.7)
    return vrw.simulate(vrw.WheelParams(), n_steps=2, n_samples=20, model=ground)


def make_branch(n_components: int, ends: tuple[str, str]) -> Branch:
    """Return the branch of the logistic map's fixed point, 1 - 1/r, in each component."""
    r = np.linspace(2.0, 3.5, 31)
    multiplier = np.repeat((2.0 - r)[:, None], n_components, axis=1)
    dataset = xr.Dataset(
        {
            "x": (("point", "component"), np.repeat((1.0 - 1.0 / r)[:, None], n_components, 1)),
            "multiplier_real": (("point", "multiplier"), multiplier),
            "multiplier_imag": (("point", "multiplier"), 0.0 * multiplier),
            "spectral_radius": ("point", np.abs(2.0 - r)),
        },
        {"r": ("point", r)},
    )
    point = FixedPoint(np.full(n_components, 2.0 / 3.0), 3.0, -np.eye(n_components))
    doubling = SpecialPoint("period_doubling", "period_doubling", 3.0, point, False)
    return Branch("r", dataset, (doubling,), ends, vrw.Outcome.STEPPED)


RANGE_END = "The parameter's range ended."


def list_drawn_texts(figure: Figure) -> list[Text]:
    texts = {*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())}
    for axes in filter(lambda axes: axes.axison, figure.axes):
        texts |= {*axes.texts, axes.title, axes.xaxis.label, axes.yaxis.label}
        texts |= set(axes.get_legend().get_texts()) if axes.get_legend() else set()
        for axis in (axes.xaxis, axes.yaxis):
            texts |= {tick.label1 for tick in axis._update_ticks()}
    return [text for text in texts if text.get_visible() and text.get_text().strip()]


DRAWN = {
    "gait_panels": lambda walk, width: vrw.plot.gait_panels(walk, width=width),
    "ground_forces": lambda walk, width: ground_forces(walk, width=width),
    "sticks": lambda walk, width: vrw.plot.sticks(walk, width=width),
    "foot_height": lambda walk, width: vrw.plot.foot_height([walk], width=width),
    "rear_force": lambda walk, width: vrw.plot.rear_force([walk], width=width),
    "branch_figure": lambda _, width: vrw.plot.branch_figure(make_branch(2, ("", "")), width=width),
}


@pytest.mark.parametrize("width", ["column", 120.0, "page"])
@pytest.mark.parametrize("name", DRAWN)
def test_a_figure_has_its_width_and_texts_that_are_readable_in_print(name, width, paper_walk):
    figure = DRAWN[name](paper_walk, width)
    # The journal's column is 3.4 inches wide, and its page is 6.9 inches wide.
    inches = {"column": 3.4, "page": 6.9}.get(width) or width / 25.4
    assert figure.get_figwidth() == pytest.approx(inches, abs=1e-12)  # round-off
    with vrw.plot.figure_style():
        figure.draw_without_rendering()
        boxes = {text: text.get_window_extent() for text in list_drawn_texts(figure)}
    for axes in figure.axes:
        assert axes.bbox.width >= 1.5 * figure.dpi  # 38 mm, about half of a column
    for text, box in boxes.items():
        assert text.get_fontsize() >= 7.0, text  # points, at the printed size
        is_inside = box.x0 > -1.0 and box.y0 > -1.0 and box.x1 < figure.bbox.width + 1.0
        assert is_inside, text
        assert box.y1 < figure.bbox.height + 1.0, text
    for (text, box), (other, other_box) in itertools.combinations(boxes.items(), 2):
        overlap = [min(box.x1, other_box.x1) - max(box.x0, other_box.x0),
                   min(box.y1, other_box.y1) - max(box.y0, other_box.y0)]  # fmt: skip
        assert min(overlap) < 1.5, (text, other)  # pixels, since boxes are larger than letters


@pytest.mark.parametrize(
    ("width", "sentence"),
    [
        ("wide", "width is 'wide', but it is no width"),
        (3.4, "width is 3.4 mm, but a figure is 80 to 500 mm wide"),
        (1200, "width is 1200 mm"),
        ([90], "width is .*one real number"),
    ],
)
def test_a_wrong_width_is_refused_with_the_allowed_ones(width, sentence, paper_walk):
    with pytest.raises((TypeError, ValueError), match=sentence):
        ground_forces(paper_walk, width=width)


def test_a_pdf_has_the_printed_width_and_fonts_of_type_42(tmp_path, paper_walk):
    figure = ground_forces(paper_walk, width="column")
    (path,) = vrw.plot.save(figure, tmp_path, "forces.pdf")
    figure.savefig(tmp_path / "direct.pdf")
    for content in (path.read_bytes(), (tmp_path / "direct.pdf").read_bytes()):
        # A point is 1/72 inch. Type 42 embeds a TrueType font (/FontFile2).
        assert re.search(rb"/MediaBox \[ 0 0 244\.8 ", content)
        assert b"/FontFile2" in content
        assert b"/Type3" not in content
    (again,) = vrw.plot.save(figure, tmp_path, "again.pdf")
    assert again.read_bytes() == path.read_bytes()


def test_a_notebook_shows_a_figure_without_pyplot(paper_walk, tmp_path):
    formatters = pytest.importorskip("IPython.core.formatters")
    figure = ground_forces(paper_walk)
    shown, _ = formatters.DisplayFormatter().format(figure)
    path = tmp_path / "shown.png"
    path.write_bytes(shown["image/png"])
    with Image.open(path) as image:
        assert image.size == tuple(np.round(figure.get_size_inches() * figure.dpi))
    code = "import sys, vrw_jax; vrw_jax.plot.sticks; assert 'matplotlib.pyplot' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_names_of_phases_lie_flat_where_they_fit(paper_walk, rigid_walk):
    paper_names = vrw.plot.gait_panels(paper_walk).axes[0].texts[1:]
    assert [(name.get_text(), name.get_rotation()) for name in paper_names] == [
        ("DLS", 0.0), ("SLS-I", 0.0), ("SLS-II", 90.0)
    ]  # fmt: skip
    for draw in (vrw.plot.gait_panels, ground_forces):
        names = [text for text in draw(rigid_walk).axes[0].texts if "SLS" in text.get_text()]
        assert [(name.get_text(), name.get_rotation()) for name in names] == [("SLS-II", 0.0)] * 2


@pytest.mark.parametrize("width", [None, "column", "page"])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_sticks_leave_no_white_bands(width, n_steps, paper_walk):
    walk = paper_walk.isel(time=paper_walk.step.values < n_steps)
    figure = vrw.plot.sticks(walk, width=width)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    is_drawn = np.asarray(canvas.buffer_rgba())[..., :3].min(-1) < 255
    for axis in (0, 1):
        drawn = np.flatnonzero(is_drawn.any(axis))
        margins = drawn[0], is_drawn.shape[1 - axis] - 1 - drawn[-1]
        # Constrained layout leaves 0.04 inches; boxes of texts are a little larger than letters.
        assert max(margins) <= 0.1 * figure.dpi
    axes = figure.axes[0]
    scales = axes.transData.transform((1.0, 1.0)) - axes.transData.transform((0.0, 0.0))
    assert scales[0] == pytest.approx(scales[1], rel=1e-6)  # one metre is as long in both
    if width:
        assert figure.get_figwidth() == style.FIGURE_WIDTHS_INCHES[width]


def test_the_figure_of_forces_shows_the_forces_of_every_model(paper_walk, sliding_walk):
    (axes,) = ground_forces(paper_walk).axes
    for line, name in zip(
        axes.lines, ("lambda_1", "lambda_2", "lambda_3", "lambda_4"), strict=False
    ):
        values = line.get_ydata()
        np.testing.assert_array_equal(values[np.isfinite(values)], paper_walk[name])
    for axes, name in zip(ground_forces(sliding_walk).axes, ("normal", "tangential"), strict=True):
        for leg in (1, 2):
            values = axes.lines[leg - 1].get_ydata()
            np.testing.assert_array_equal(
                values[np.isfinite(values)], sliding_walk[name].sel(leg=leg)
            )


def test_an_animation_keeps_the_colors_of_the_panels(sliding_walk, tmp_path):
    frames, milliseconds = vrw.plot.walk_frames(sliding_walk, n_frames=4)
    path = vrw.plot.save_animation(frames, milliseconds, tmp_path / "walk.gif")
    seen: set[tuple[int, ...]] = set()
    with Image.open(path) as animation:
        for index in range(animation.n_frames):
            animation.seek(index)
            seen |= {color for _, color in animation.convert("RGB").getcolors(10**6)}
    for mode in (ContactMode.OFF, ContactMode.STICK, ContactMode.SLIP_DOWN):
        color = mpl.colors.to_rgb(_contact.CONTACT_MODE_COLORS[mode])
        assert tuple(np.round(255.0 * np.array(color))) in seen, mode


def test_the_branch_of_a_map_is_drawn_with_each_component_of_its_fixed_points():
    branch = make_branch(2, (RANGE_END, RANGE_END))
    states, multipliers = vrw.plot.branch_figure(branch).axes
    is_solid = {line.get_linestyle() for line in states.lines if len(line.get_xdata()) > 2}
    assert is_solid == {"-", "--"}
    assert [text.get_text() for text in states.get_legend().get_texts()] == ["$x_{1}$", "$x_{2}$"]
    assert states.get_xlabel() == multipliers.get_xlabel() == "r"
    (line, *_) = states.lines
    np.testing.assert_allclose(line.get_ydata(), 1.0 - 1.0 / line.get_xdata(), atol=1e-15)
    empty = Branch(
        "r", xr.Dataset(coords={"r": ("point", [])}), (), ("", ""), vrw.Outcome.NO_CYCLE_FOUND
    )
    with pytest.raises(ValueError, match="the branch has no point to draw"):
        vrw.plot.branch_figure(empty)


def test_a_branch_prints_an_end_once_if_both_ends_have_one_reason():
    branch = make_branch(1, (RANGE_END, RANGE_END))
    assert str(branch).count(RANGE_END) == branch.ending.count(RANGE_END) == 1
    assert "at 2 and at 3.5: " + RANGE_END in str(branch)
    curve = vrw.SpecialPointCurve(
        "fold", ("a", "r"), branch.dataset.assign(a=branch.dataset.r), (), (RANGE_END,) * 2
    )
    assert str(curve).count(RANGE_END) == curve.ending.count(RANGE_END) == 1
    other_end = "It closes."
    text = str(make_branch(1, (RANGE_END, other_end)))
    assert f"at 2: {RANGE_END}\n  at 3.5: {other_end}" in text


@pytest.mark.parametrize("package", [vrw.plot, vrw_jax.hybrid, vrw_jax.continuation])
def test_the_help_of_a_package_lists_its_documented_names(package):
    pages = "\n".join(path.read_text() for path in (ROOT / "docs/reference").glob("*.md"))
    documented = set(re.findall(rf"^::: {package.__name__}\.(\w+)$", pages, re.M))
    assert documented
    assert documented <= set(package.__all__)
    text = pydoc.plain(pydoc.render_doc(package))
    for name in documented:
        assert re.search(rf"^ +(class )?{name}\(", text, re.M), name
