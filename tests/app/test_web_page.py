"""docs/wheel.html in a real browser: sliders move, numbers follow, and nothing is cut off."""

import os
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from support.web_code import PAGE_PATH

import vrw_jax as vrw
from vrw_jax.app import explorer

pytestmark = pytest.mark.slow
BROWSER_SWITCHES = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip
WINDOW_SIZES = {"desktop": (1280, 900), "phone": (390, 844)}
TIMEOUT_MILLISECONDS = 120_000
"""For the map, ms: what it takes on a machine that does much else."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Return a Chromium of this machine with an empty profile."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright drives the browser: pip install playwright"
    )
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")
    if path is None:
        pytest.skip("no Chromium is installed here, which the page is looked at in")
    folder = tmp_path_factory.mktemp("browser")
    with playwright.sync_playwright() as machine:
        opened = machine.chromium.launch_persistent_context(
            folder,
            executable_path=path,
            args=BROWSER_SWITCHES,
            headless=True,
            reduced_motion="reduce",
        )
        opened.set_default_timeout(TIMEOUT_MILLISECONDS)
        yield opened
        opened.close()


def record_requests(address, complaints):
    """Record requests; the page contains everything that it needs."""
    if not address.startswith(("file:", "blob:", "data:")):
        complaints.append(address)


@pytest.fixture
def page(browser):
    """Return the page, opened from its file; any console message fails the test."""
    browser_page, complaints = browser.new_page(), []
    browser_page.on("pageerror", lambda error: complaints.append(str(error)))
    browser_page.on(
        "console", lambda said: complaints.append(said.text) if said.type == "error" else None
    )
    browser_page.on(
        "request", lambda asked: complaints.append(asked.url) if asked.url[:4] == "http" else None
    )
    browser_page.goto(PAGE_PATH.as_uri())
    browser_page.evaluate("vrw.ready")
    yield browser_page
    browser_page.close()
    assert not complaints


def read_gait(page):
    solution = page.evaluate("vrw.state.result.gait")
    values = [complex(m["re"], m["im"]) for m in solution["multipliers"]]
    return np.array(solution["x"]), np.array(values)


def test_a_gait_and_its_multipliers_equal_the_librarys(page):
    for changed in ({}, {"damping": 150.0, "slope": 0.27}, {"stiffness": 560.0}):
        page.evaluate(
            "values => vrw.update(values)",
            {"damping": 200, "slope": 0.3, "stiffness": 500} | changed,
        )
        x, multipliers = read_gait(page)
        cycle = vrw.limit_cycle(vrw.WheelParams(**changed))
        assert np.max(np.abs(x - cycle.section_state)) < 1e-8
        expected = np.asarray(cycle.multipliers)
        order = np.argsort(-np.abs(expected))
        assert np.max(np.abs(multipliers[: len(order)] - expected[order])) < 1e-7
        assert np.all(np.abs(multipliers[len(order) :]) < 1e-9)  # what a landing forgets
        step = vrw.step(vrw.WheelParams(**changed), jnp.asarray(x))
        result = page.evaluate("vrw.state.result.measures")
        for name, value in step.measures().items():
            if np.ndim(value) == 0 and name in result:
                assert abs(result[name] - float(value)) < 1e-8 * (1.0 + abs(float(value))), name


def test_a_slider_moves_the_numbers(page):
    before = page.inner_text("[data-measure=speed]")
    page.locator("#slider-damping").focus()
    for _ in range(5):
        page.keyboard.press("ArrowLeft")
    page.wait_for_function(
        "text => document.querySelector('[data-measure=speed]').innerText !== text", arg=before
    )
    assert float(page.input_value("#number-damping")) < 200.0
    page.fill("#number-damping", "300")
    page.locator("#number-damping").press("Tab")
    page.wait_for_function("document.getElementById('verdict').className === 'bad'")
    assert "before Leg 2 was back at its stopper" in page.inner_text("#verdict")
    assert "damping=300" in page.inner_text("#python")


@pytest.mark.parametrize("held", [True, False])
def test_rigid_legs_move_as_in_the_library(page, held):
    """At a slope of 0.45 rad the ground would have to pull."""
    params = vrw.WheelParams(slope=0.2 if held else 0.45, n_legs=8)
    page.evaluate("s => vrw.update({ rung: 'rigid', slope: s })", float(params.slope))
    model = vrw.RigidWheel()
    assert "RigidWheel()" in page.inner_text("#python")
    result = page.evaluate("vrw.state.result")
    if not held:
        assert result["gait"] is None
        assert "ended" in page.inner_text("#verdict")
        return
    x, multipliers = read_gait(page)
    cycle = vrw.limit_cycle(params, model=model)
    assert np.max(np.abs(x - cycle.section_state)) < 1e-9
    assert abs(abs(multipliers[0]) - float(cycle.spectral_radius)) < 1e-9
    for name, value in vrw.step(params, jnp.asarray(x), model=model).measures().items():
        if np.ndim(value) == 0 and name in result["measures"]:
            assert abs(result["measures"][name] - float(value)) < 1e-9 * (1.0 + abs(value)), name
    trace = vrw.simulate(params, x, n_steps=1, n_samples=24, model=model)
    [step] = result["steps"]
    for row, name in (("times", "time"), (0, "theta"), (7, "lambda_2")):
        values_array = np.array(step[row] if row == "times" else step["rows"][row])
        assert np.max(np.abs(values_array - trace[name].values[-24:])) < 1e-8, name


def test_a_unilateral_gait_its_multipliers_and_motion_equal_the_librarys(page):
    """Feet slide there; multipliers are differences, right to five digits."""
    params, model = vrw.WheelParams(damping=150.0), vrw.UnilateralWheel(friction=0.5)
    page.evaluate("vrw.update({ rung: 'unilateral', damping: 150, friction: 0.5 })")
    assert "unilateral contact" in page.inner_text("#verdict")
    assert "UnilateralWheel(friction=0.5)" in page.inner_text("#python")
    assert not page.is_visible("#ground-card")
    x, multipliers = read_gait(page)
    batch_result = vrw.step_batch(params, x[None], model=model, derivatives="section_state")
    assert np.max(np.abs(batch_result.section_state[0] - x)) < 1e-8
    expected = np.linalg.eigvals(batch_result.derivatives["section_state"].section_state[0])
    expected = expected[np.argsort(-np.abs(expected))][: len(multipliers)]
    stacked_values = np.stack(
        [multipliers.real - expected.real, np.abs(multipliers.imag) - np.abs(expected.imag)]
    )
    assert np.max(np.abs(stacked_values)) < 1e-5
    result = page.evaluate("vrw.state.result.measures")
    assert result["slip"] > 0.01
    for name, value in vrw.step(params, jnp.asarray(x), model=model).measures().items():
        if np.ndim(value) == 0 and name in result:
            assert abs(result[name] - float(value)) < 1e-8 * (1.0 + abs(float(value))), name
    [step] = page.evaluate("vrw.state.result.steps")
    assert abs(step["length"] - result["step_length"]) < 1e-12
    assert abs(sum(band["duration"] for band in step["bands"]) - result["period"]) < 1e-12
    assert any("slid" in band["texts"][0] for band in step["bands"])
    page.wait_for_function("vrw.state.basin.cells.size > 16 && vrw.state.map.cells.size > 16")
    assert "to the gait" in page.inner_text("#basin-legend")
    page.select_option("#map-x", "friction")  # only unilateral contact has this axis
    page.wait_for_function("vrw.state.map.x === 'friction' && vrw.state.map.cells.size > 16")
    page.evaluate("vrw.update({ rung: 'viscoelastic' })")
    assert page.evaluate("vrw.state.map.x") != "friction"
    assert page.is_visible("#ground-card")


def test_a_walk_that_slides_to_a_halt_is_shown_until_it_stops(page):
    page.evaluate("vrw.update({ rung: 'unilateral', friction: 0.05 })")
    result = page.evaluate("vrw.state.result")
    assert result["gait"] is None
    assert "ended" in page.inner_text("#verdict")
    assert len(result["steps"][-1]["times"]) > 24


def test_insufficient_friction_is_reported(page):
    params = vrw.WheelParams()
    required = vrw.step(params, vrw.limit_cycle(params).section_state).required_friction
    needed = f"{float(max(required.fore, required.landing_fore)):.4g}"
    evaluate = lambda mu: (
        page.evaluate("mu => vrw.update({ friction: mu })", mu) or page.inner_text("#verdict")
    )
    assert f"The fore foot requires a friction coefficient of {needed}" in evaluate(1.0)
    assert "with 1.2, the rear foot would slide" in evaluate(1.2)
    assert page.get_attribute("#verdict", "class") == "good"
    assert "both feet would slide" in evaluate(0.3)
    assert page.get_attribute("#verdict", "class") == "warn"
    assert "100 is enough" in evaluate(100.0)


def test_a_wheel_can_be_sent_as_an_address(browser):
    browser_page = browser.new_page()
    browser_page.goto(PAGE_PATH.as_uri() + "#damping=40&n_legs=8")
    browser_page.evaluate("vrw.ready")
    assert "scuffs" in browser_page.inner_text("#verdict")
    browser_page.goto("about:blank")
    browser_page.goto(PAGE_PATH.as_uri() + "#n_legs=10")
    browser_page.evaluate("vrw.ready")
    assert "ten legs" in browser_page.inner_text("header")
    assert browser_page.evaluate("vrw.state.result.measures.locked_stopper_force === undefined")
    assert browser_page.evaluate("'locked_stopper_force[10]' in vrw.state.result.measures")
    browser_page.close()


def test_map_and_basin_are_drawn_and_the_marker_sets_the_wheel(page):
    page.wait_for_function("vrw.state.basin.done && vrw.state.map.done")
    assert page.evaluate("vrw.state.basin.cells.size") == 64 * 64
    assert page.evaluate("vrw.state.map.cells.size") == 65 * 65
    page.locator("#map").focus()
    page.keyboard.press("ArrowLeft")
    page.wait_for_function("vrw.state.values.damping < 200")
    box = page.locator("#map").bounding_box()
    page.mouse.click(box["x"] + 0.3 * box["width"], box["y"] + 0.7 * box["height"])
    page.wait_for_function("vrw.state.values.damping < 150 && vrw.state.values.slope < 0.27")
    assert page.evaluate("vrw.state.map.cells.size") == 65 * 65  # two parameters' map stays
    # What the map shows under the dot is what the wheel does.
    speed = page.evaluate("""() => {
      const { map, values } = vrw.state, [x, y] = ["damping", "slope"].map(mapAxis);
      const share = (axis) => (values[axis.name] - axis.from) / (axis.to - axis.from);
      const at = (axis) => Math.round(64 * share(axis));
      return mapValue(map.cells.get([at(x), at(y)].join()));
    }""")
    assert abs(speed - page.evaluate("vrw.state.result.measures.speed")) < 0.05


@pytest.mark.parametrize("size", WINDOW_SIZES)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_clipped_and_every_element_has_a_name(page, size, scheme, tmp_path):
    page.emulate_media(color_scheme=scheme)
    width, height = WINDOW_SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    page.wait_for_timeout(300)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    nameless = page.evaluate("""() => {
      const name = (one) => one.getAttribute("aria-label") || one.labels?.length || one.innerText;
      return [...document.querySelectorAll("input, select, button, canvas")].filter(
        (one) => !name(one)).length;
    }""")
    assert nameless == 0
    # A window as high as the page: to look at, and a picture of more than one colour.
    page.set_viewport_size({"width": width, "height": page.evaluate("document.body.scrollHeight")})
    folder = Path(os.environ.get("VRW_SCREENSHOTS", tmp_path))
    page.screenshot(path=folder / f"wheel_{size}_{scheme}.png", timeout=TIMEOUT_MILLISECONDS)
    canvas_fills = page.evaluate("""() => ["walk", "strips", "circle"].map((id) => {
      const canvas = document.getElementById(id), { width, height } = canvas;
      const dots = canvas.getContext("2d").getImageData(0, 0, width, height).data;
      return new Set(new Uint32Array(dots.buffer)).size;
    })""")
    assert min(canvas_fills) > 10


def test_the_frame_of_a_widget_exchanges_values_in_both_directions(browser):
    browser_page = browser.new_page()
    browser_page.set_content("<div id='cell'></div>")
    traits = {
        "page": PAGE_PATH.read_text(encoding="utf-8"),
        "height": 800,
        "map": {},
        "measures": {},
    }
    traits["values"] = explorer._make_page_values(
        vrw.WheelParams(damping=150.0), 0.9, "viscoelastic"
    )
    browser_page.evaluate(
        """traits => {
          const listeners = {};
          window.model = {
            get: (name) => traits[name],
            set: (name, value) => { traits[name] = value; },
            save_changes: () => {},
            on: (event, call) => { listeners[event] = call; },
            fromPython: (name, value) => { traits[name] = value; listeners[`change:${name}`](); },
          };
        }""",
        traits,
    )
    render = explorer.WIDGET_JAVASCRIPT.replace("export default { render };", "")
    browser_page.evaluate(
        f"() => {{ {render}; render({{ model, el: document.getElementById('cell') }}) }}"
    )
    browser_page.wait_for_function(
        "model.get('measures').speed > 0 && model.get('values').damping === 150"
    )
    result = browser_page.evaluate("model.get('measures')")
    cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
    assert abs(result["speed"] - float(cycle.speed)) < 1e-8
    browser_page.evaluate("model.fromPython('values', { ...model.get('values'), damping: 170 })")
    browser_page.wait_for_function(
        f"Math.abs(model.get('measures').speed - {result['speed']}) > 1e-4"
    )
    inside = browser_page.frames[1]
    assert inside.input_value("#number-damping") == "170"
    inside.fill("#number-damping", "180")
    inside.locator("#number-damping").press("Tab")
    browser_page.wait_for_function("model.get('values').damping === 180")
    axes = [{"name": "damping", "values": [100, 150, 200]}, {"name": "slope", "values": [0.2, 0.3]}]
    given = {
        "axes": axes,
        "measures": {"speed": [[1, 2, None], [3, 4, 5]]},
        "outcome": [[0, 0, 3]] * 2,
    }
    browser_page.evaluate("given => model.fromPython('map', given)", given)
    inside.wait_for_function(
        "document.getElementById('map-state').innerText === 'From your dataset.'"
    )
    assert "fell back" in inside.inner_text("#map-legend")
    browser_page.close()
