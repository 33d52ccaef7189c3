"""Build docs/wheel.html, one file with the library's step inside.

    python -m experiments.web.build [--page]

With `--page` the command takes the code of the step from the present page, which is quick. Without
it the command traces and compiles the step, which takes some minutes. `wasm-ld` is Debian's `lld`,
or comes with `pip install ziglang`.
"""

import base64
import datetime
import gzip
import json
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.web.programs import (
    GROUND_TOLD,
    LEGS,
    PAGE_FRICTION,
    PAGE_MARGINS,
    SAMPLES,
    Program,
    ground_rows,
    make_shared_programs,
    programs,
)
from vrw_jax.models import (
    LIMIT_CYCLE_MEASURES,
    MARGIN_MEASURES,
    PAPER_START_STATE,
    STEP_MEASURES,
    STOPPER_MARGIN_MEASURES,
    UNILATERAL_STEP_MEASURES,
    DoubleSupportIndicators,
    EnergyLoss,
    RequiredFriction,
)
from vrw_jax.wheel import PARAMETER_DOMAINS

ROOT = Path(__file__).parents[2]
PAGE, SOURCES = ROOT / "docs" / "wheel.html", Path(__file__).parent / "page"
CODE, FACTS = "code", "facts"
"""Where in the page lie the step's code, and what the library calls things."""
STACK = 1 << 20
"""Bytes that the code has for what it can't hold in registers."""

SLIDERS = {
    "damping": (0.0, 600.0),
    "stiffness": (200.0, 3000.0),
    "natural_length": (0.95, 1.15),
    "slope": (0.0, 0.6),
    "hub_mass": (0.0, 40.0),
    "leg_mass": (0.1, 4.0),
    "leg_com": (0.0, 0.9),
    "locked_length": (0.6, 1.4),
    "gravity": (1.0, 25.0),
}
"""What a slider spans, parameters that one turns first first."""

RUNGS = {
    "viscoelastic": "springs",
    "rigid": "rigid legs",
    "unilateral": "unilateral contact",
}
"""What is modelled, by the rungs' names."""
SHARED_MODULE_NAME = "shared"
"""Name of the code that is the same for any number of legs."""


def link_module(objects: dict[str, bytes]) -> bytes:
    """Link functions by name into one WebAssembly module that imports `sin` and `cos`."""
    linker = [shutil.which("wasm-ld")]
    if linker == [None]:
        if find_spec("ziglang") is None:
            raise SystemExit("wasm-ld is missing: install Debian's lld, or pip install ziglang.")
        linker = [sys.executable, "-m", "ziglang", "wasm-ld"]
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for name, content in objects.items():
            paths.append(Path(folder, f"{name}.o"))
            paths[-1].write_bytes(content)
        out = Path(folder, "linked.wasm")
        exports = [f"--export={name}" for name in (*objects, "__heap_base")]
        choices = ["--no-entry", "--gc-sections", "--strip-all", "--allow-undefined"]
        stack = ["-z", f"stack-size={STACK}"]
        subprocess.run([*linker, *choices, *stack, *exports, *paths, "-o", out], check=True)
        return out.read_bytes()


def compile_page_code(selection: dict[str, Program]) -> str:
    """Programs' code, packed as the page holds it."""
    code = link_module({name: program.object(name) for name, program in selection.items()})
    return pack_bytes(gzip.compress(code, 9, mtime=0))


def pack_bytes(code: bytes) -> str:
    """Return bytes as text for a page: the number of appended zeros, then base 85 with `.` for
    `<`.
    """
    return f"{-len(code) % 4}{base64.b85encode(code, pad=True).decode().replace('<', '.')}"


def unpack_bytes(text: str) -> bytes:
    """Return the bytes of a text that `pack_bytes` returned."""
    code = base64.b85decode(text[1:].replace(".", "<"))
    return code[: len(code) - int(text[0])]


def list_output_rows(n_legs: int) -> list[str]:
    """Return the names of the outputs of a step, one per row."""
    legs = range(3, n_legs + 1)
    margins = [
        [f"{name}[{leg}]" for leg in legs] if measure.leg_dimension else [name]
        for name, measure in PAGE_MARGINS.items()
    ]
    return [
        "theta_touchdown",
        "dtheta_touchdown",
        "dL1_touchdown",
        "theta_post_impact",
        "dtheta_post_impact",
        "duration_dls",
        "duration_sls1",
        "duration_sls2",
        "step_length",
        *_field_names(DoubleSupportIndicators),
        *(name for names in margins for name in names),
        *(RequiredFriction.measure_name_by_field[name] for name in PAGE_FRICTION),
        *_field_names(EnergyLoss),
    ]


def _field_names(result: Any) -> list[str]:
    return [
        result.measure_name_by_field.get(name, name)
        for name in result.__annotations__
        if name != "measure_name_by_field"
    ]


def facts() -> dict[str, Any]:
    """Return names, units, sentences and defaults that the page shows."""
    git = lambda *what: subprocess.run(
        ["git", *what], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.strip()
    evaluate = lambda m: {
        "label": m.long_name, "symbol": m.symbol, "unit": m.display_unit,
        "meaning": m.description, "breaks": m.violation_text,
    }  # fmt: skip
    default = vrw.WheelParams()
    return {
        "commit": git("rev-parse", "--short", "HEAD"),
        "version": vrw.__version__,
        "built": datetime.date.today().isoformat(),
        "order": list(PARAMETER_DOMAINS),
        "parameters": {
            name: {
                "symbol": PARAMETER_DOMAINS[name].symbol,
                "unit": PARAMETER_DOMAINS[name].unit,
                "meaning": PARAMETER_DOMAINS[name].description,
                "value": float(getattr(default, name)),
                "from": span[0],
                "to": span[1],
                "least": PARAMETER_DOMAINS[name].lower_bound,
            }
            for name, span in SLIDERS.items()
        },
        "start": list(PAPER_START_STATE),
        "legs": list(LEGS),
        "rungs": RUNGS,
        "samples": SAMPLES,
        "rows": {n: list_output_rows(n) for n in LEGS},
        "ground": {n: ground_rows(n) for n in LEGS},
        "groundTold": GROUND_TOLD,
        "stoppers": list(STOPPER_MARGIN_MEASURES),
        "measures": {
            name: evaluate(m)
            for name, m in (
                STEP_MEASURES
                | MARGIN_MEASURES
                | UNILATERAL_STEP_MEASURES
                | STOPPER_MARGIN_MEASURES
                | LIMIT_CYCLE_MEASURES
            ).items()
        },
        "margins": {name: bool(m.leg_dimension) for name, m in PAGE_MARGINS.items()},
        "outcomes": {int(o): {"name": o.name, "meaning": o.meaning} for o in vrw.Outcome},
    }


def read_page_content(page: str, name: str) -> Any:
    """Return the JSON content of a built page under a name."""
    _, _, rest = page.partition(f'<script type="application/json" id="{name}">')
    return json.loads(rest.partition("</script>")[0])


def write_page(code: dict[str, str]) -> str:
    """Return the page with scripts, styles and data inside."""
    part = lambda name: (SOURCES / name).read_text(encoding="utf-8")
    page, text_by_mark = part("page.html"), {}
    for name in ("page.css", "engine.js", "ground.js", "worker.js", "pictures.js", "page.js"):
        lines = (line.strip() for line in part(name).splitlines())
        text_by_mark[f"/*{name}*/"] = "\n".join(x for x in lines if x and not x.startswith("// "))
    text_by_mark[f"/*{FACTS}*/"] = json.dumps(facts(), ensure_ascii=False)
    text_by_mark[f"/*{CODE}*/"] = json.dumps(code)
    for mark, text in text_by_mark.items():
        if page.count(mark) != 1:
            raise SystemExit(f"page.html says {mark} {page.count(mark)} times: once is needed.")
        page = page.replace(mark, text)
    return page.replace("/*size*/", f"{len(page.encode()) / 1000:,.0f} kB")


def main() -> int:
    parser = make_parser(__doc__)
    parser.add_argument("--page", action="store_true", help="keep the step's code as it is")
    only_page = parse_and_start_jax(parser).page
    if only_page:
        code = read_page_content(PAGE.read_text(encoding="utf-8"), CODE)
    else:
        code = {SHARED_MODULE_NAME: compile_page_code(make_shared_programs())} | {
            str(n): compile_page_code(programs(n)) for n in LEGS
        }
    page = write_page(code)
    PAGE.write_text(page, encoding="utf-8")
    print(f"{PAGE}: {len(page.encode()):,} bytes, {sum(map(len, code.values())):,} of them code")
    return 0


if __name__ == "__main__":
    sys.exit(main())
