"""Measure the time of the page's updates after a slider moves, in Node and in Chromium.

    python -m experiments.web.speed

The command prints a table. It needs `node`, `chromium` and playwright (`.[web]`).
"""

import json
import shutil
import subprocess
import tempfile
from typing import Any

from experiments.shared.command import make_parser, parse_and_start_jax, require_extra
from experiments.shared.tables import describe_run, format_markdown
from experiments.web.build import (
    CODE,
    FACTS,
    PAGE,
    SHARED_MODULE_NAME,
    SOURCES,
    read_page_content,
)

N_SLIDER_MOVES = 80
"""Places of the slider, after as many that warm up."""

IN_NODE = """
const given = JSON.parse(require("fs").readFileSync(0)), { facts, packed } = given;
(0, eval)(given.source + ";globalThis.own = { Engine, Ground, jobs, motionOnGround };");
(async () => {
  const engine = await own.Engine.load(packed, facts, 8);
  const at = (damping) => facts.order.map(
    (name) => (name === "damping" ? damping : facts.parameters[name].value));
  let gait = engine.gait(at(200), [facts.start]);
  const times = [], cpu = () => (process.cpuUsage().user + process.cpuUsage().system) / 1000;
  for (let i = 0; i < 8 * given.moved; i++) {
    const began = cpu(), wheel = at(150 + 50 * Math.abs(Math.sin(i)));
    gait = engine.gait(wheel, [gait.x]);
    engine.told(wheel, 1, gait.x);
    times.push(cpu() - began);
  }
  const sorted = (times) => times.slice(-given.moved).sort((a, b) => a - b);
  const found = { update: sorted(times)[given.moved >> 1] }, [theta] = gait.x, lost = [];
  for (let i = 1; lost.length < 4 * given.moved; i++) {
    // Damping and slope all over what their sliders span.
    const wheel = at(600 * ((0.618034 * i) % 1));
    wheel[facts.order.indexOf("slope")] = 0.6 * ((0.754878 * i) % 1);
    const began = cpu();
    if (engine.gait(wheel, [gait.x, facts.start])) continue;
    const { states: [states] } = engine.walks(1e-10, [wheel], [gait.x], 60);
    states.slice(-8).map((x) => engine.told(wheel, 1, x));
    lost.push(cpu() - began);
  }
  found.lost = [0.5, 0.95, 0.99].map((share) => sorted(lost)[Math.floor(share * given.moved)]);
  const x = { from: theta - 0.4, to: theta + 0.4 }, y = { from: 0, to: 3 };
  const job = { kind: "basin", id: 1, legs: 8, wheel: at(200), gait: gait.x, x, y, last: 63 };
  job.rate = gait.x[2];
  for (let i = 0; i < 2; i++) {
    const began = cpu();
    await own.jobs(() => {})({ job, packed, facts });
    found.basin = cpu() - began;
  }
  const real = [];
  let one = null;
  for (let i = 0; i < 2 * given.moved; i++) {
    const began = cpu(), wheel = at(150 + 50 * Math.abs(Math.sin(i / 10)));
    const ground = new own.Ground(engine, wheel, 0.7);
    one = one && ground.near(one.x, one.J);
    one ||= ground.found([() => ground.begun(facts.start)]).gait;
    own.motionOnGround(ground, ground.step(one ? one.x : ground.begun(facts.start)));
    real.push(cpu() - began);
  }
  found.real = [0.5, 0.95].map((share) => sorted(real)[Math.floor(share * given.moved)]);
  console.log(JSON.stringify(found));
})();
"""

IN_CHROMIUM = """async ([moved, rung, pace]) => {
  const times = [];
  for (let i = 0; i < 2 * moved; i++) {
    await new Promise((go) => requestAnimationFrame(go));
    const began = performance.now();
    await vrw.update({ rung, friction: 0.7, damping: 150 + 50 * Math.abs(Math.sin(pace * i)) });
    times.push(performance.now() - began);
  }
  const late = times.slice(-moved).sort((a, b) => a - b);
  return [late[moved >> 1], late[Math.floor(0.95 * moved)]];
}"""


def in_node() -> dict[str, Any]:
    """CPU time of an update, of one without a gait (three quantiles) and of a basin, ms."""
    page = PAGE.read_text(encoding="utf-8")
    source = "\n".join(
        (SOURCES / name).read_text() for name in ("engine.js", "ground.js", "worker.js")
    )
    code = read_page_content(page, CODE)
    given = {
        "facts": read_page_content(page, FACTS),
        "packed": [code[SHARED_MODULE_NAME], code["8"]],
        "moved": N_SLIDER_MOVES,
        "source": source.replace('"use strict";', ""),
    }
    node = ["node", "-e", IN_NODE]
    process = subprocess.run(
        node, input=json.dumps(given), check=True, capture_output=True, text=True
    )
    return json.loads(process.stdout)


def in_chromium() -> dict[str, tuple[list[float], float, float]]:
    """Measure by model the wall time of an update with its drawing (median and 95th percentile,
    ms).

    The times of basin and map are in seconds."""
    found_by_name = {}
    path = shutil.which("chromium")
    switches = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync"]
    playwright = require_extra("playwright.sync_api", 'pip install -e ".[web]"')
    with playwright.sync_playwright() as machine, tempfile.TemporaryDirectory() as folder:
        opened = machine.chromium.launch_persistent_context(
            folder, executable_path=path, args=switches
        )
        page = opened.new_page()
        page.goto(PAGE.as_uri())
        page.evaluate("vrw.ready")
        done = "vrw.state.map.done && vrw.state.basin.done"
        for rung, pace in (("viscoelastic", 1.0), ("unilateral", 0.1)):
            times = page.evaluate(IN_CHROMIUM, [N_SLIDER_MOVES, rung, pace])
            page.wait_for_timeout(1000)
            page.wait_for_function(done, timeout=300_000)
            # Once more, as it is when the code is warm.
            page.evaluate(f"vrw.update({{ stiffness: {500 + 10 * pace} }})")
            page.wait_for_timeout(1000)
            page.wait_for_function(done, timeout=300_000)
            pictures = page.evaluate("[vrw.state.basin.seconds, vrw.state.map.seconds]")
            found_by_name[rung] = times, *pictures
        opened.close()
    return found_by_name


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    node, chromium = in_node(), in_chromium()
    (times, basin, map_seconds), (real, slow, wide) = (
        chromium["viscoelastic"],
        chromium["unilateral"],
    )
    rows = [
        ("gait, multipliers, forces and margins after a slider moves", f"{node['update']:.1f} ms",
         f"{times[0]:.0f} ms, 95 % below {times[1]:.0f} ms"),
        ("the same for a wheel without a gait: search, and walk until the fall",
         "{:.0f} ms, 95 % below {:.0f} ms, none above {:.0f} ms".format(*node["lost"]), ""),
        ("a basin of 64 × 64 starts", f"{node['basin'] / 1000:.2f} s", f"{basin:.1f} s"),
        ("a map of 65 × 65 gaits", "", f"{map_seconds:.1f} s"),
        ("unilateral contact: gait after a slider moves a little",
         "{:.0f} ms, 95 % below {:.0f} ms".format(*node["real"]),
         f"{real[0]:.0f} ms, 95 % below {real[1]:.0f} ms"),
        ("unilateral contact: a basin of 32 × 32 starts", "", f"{slow:.0f} s"),
        ("unilateral contact: a map of 33 × 33 gaits", "", f"{wide:.0f} s"),
    ]  # fmt: skip
    table = format_markdown(("", "Node, CPU time", "Chromium, wall time, with drawing"), rows)
    print(table, describe_run("experiments.web.speed"), sep="\n\n")


if __name__ == "__main__":
    main()
