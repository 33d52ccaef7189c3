"""A change that moves code leaves every bit of what is computed: digests of results, by engine.

    python -m experiments.shared.digests FILE [--only GROUP ...] [--numbers FOLDER]

Writes one line a result; run it before and after, on one machine, and compare by `diff`.
`--numbers` keeps the numbers too, for changes that move last digits: `--against FOLDER` says by how
much.
"""

import hashlib
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import command, started

LANES, CYCLES = 4096, 1024
Numbers = dict[str, np.ndarray]


def numbers_of(tree: object) -> Numbers:
    """Every array of a result, by its place in it."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def drawn(n: int, seed: int) -> vrw.WheelParams:
    draw = np.random.default_rng(seed).uniform
    return vrw.WheelParams(
        damping=draw(20.0, 215.0, n),
        stiffness=draw(400.0, 600.0, n),
        natural_length=draw(1.01, 1.04, n),
        slope=draw(0.26, 0.34, n),
    )


def steps() -> Iterator[tuple[str, Numbers]]:
    params = drawn(LANES, 1)
    draw = np.random.default_rng(2)
    states = np.asarray(vrw.limit_cycle(vrw.WheelParams()).section_state)
    states = states * draw.uniform(0.98, 1.02, (LANES, 3))
    lanes = vrw.steps(params, states)
    yield "steps by lanes", numbers_of(lanes)
    yield "steps by diffrax", numbers_of(vrw.steps(params, states, engine="diffrax"))
    expected = np.asarray(lanes.durations) * draw.uniform(0.98, 1.02, (LANES, 3))
    by_collocation = vrw.steps(params, states, engine="collocation", durations=expected)
    yield "steps by collocation", numbers_of(by_collocation)
    ground = vrw.UnilateralWheel(friction=2.0)
    few = jax.tree.map(lambda x: x[:64] if jnp.ndim(x) else x, params)
    yield "steps on real ground", numbers_of(vrw.steps(few, states[:64], 3, model=ground))


def one_wheel() -> Iterator[tuple[str, Numbers]]:
    table_1 = vrw.WheelParams()
    x = vrw.limit_cycle(table_1).section_state
    yield "step", numbers_of(vrw.step(table_1, x))
    by = jax.jacfwd(vrw.return_map, argnums=(0, 1))(table_1, x)
    yield "return map's Jacobian", numbers_of(by)
    walk = vrw.simulate(table_1, x, n_steps=2)
    yield "trajectory", {str(name): np.asarray(walk[name]) for name in walk.data_vars}
    ground = vrw.UnilateralWheel(friction=1.5)
    yield "walk on real ground", numbers_of(vrw.walk(table_1, x, 5, model=ground))


def cycles() -> Iterator[tuple[str, Numbers]]:
    names = ("dls_fraction", "speed", "period", "lambda_I4", "lambda_4_plus")
    design = vrw.samples(
        {
            name: np.asarray(getattr(drawn(CYCLES, 3), name))
            for name in ("damping", "stiffness", "natural_length", "slope")
        }
    )
    slopes = [f"d {name} / d {by}" for name in names for by in ("damping", "slope", "leg_mass")]
    found = vrw.scan(design, [*names, *slopes])
    yield "cycles with derivatives", {str(name): np.asarray(found[name]) for name in found}


def quickstart() -> Iterator[tuple[str, Numbers]]:
    text = (Path(__file__).parents[2] / "configs" / "quickstart.toml").read_text()
    config = tomllib.loads(text)
    with TemporaryDirectory() as folder:
        axes = {
            name: np.linspace(axis["from"], axis["to"], axis["count"])
            if isinstance(axis, dict)
            else np.asarray(axis)
            for name, axis in config["grid"].items()
        }
        found = vrw.scan(vrw.grid(**axes), config["scan"]["measures"], store=Path(folder) / "s")
        yield "quickstart's store", {str(name): np.asarray(found[name]) for name in found}


def branch() -> Iterator[tuple[str, Numbers]]:
    told = vrw.continue_branch(vrw.WheelParams(), "damping", (4.0, 230.0))
    borders = {f"border {border.name}": np.asarray(border.value) for border in told.borders}
    points = {str(name): np.asarray(told.dataset[name]) for name in told.dataset.variables}
    yield "branch", borders | points


def tuning() -> Iterator[tuple[str, Numbers]]:
    bounds = {"damping": (20.0, 215.0), "slope": (0.26, 0.34)}
    tuned = vrw.tune(vrw.WheelParams(), "dls_fraction", list(bounds), bounds)
    path = {f"path {name}": np.asarray(tuned.path[name]) for name in tuned.path.data_vars}
    yield "tuning", numbers_of((tuned.params, tuned.value, tuned.kkt_residual)) | path


GROUPS: dict[str, Callable[[], Iterator[tuple[str, Numbers]]]] = {
    group.__name__: group for group in (steps, one_wheel, cycles, quickstart, branch, tuning)
}


def digest(numbers: Numbers) -> str:
    told = hashlib.sha256()
    for name in sorted(numbers):
        value = numbers[name]
        content = value.tobytes() if value.dtype.kind in "fiub" else repr(value.tolist()).encode()
        told.update(f"{name} {value.shape} {value.dtype.kind}".encode() + content)
    return told.hexdigest()[:16]


def distance(here: Numbers, there: Numbers) -> str:
    """The largest relative difference, of which number; names that only one side has."""
    worst, where = 0.0, "none"
    for name in here.keys() & there.keys():
        x, y = here[name], there[name]
        if x.shape != y.shape:
            return f"{name} has shape {x.shape}, and had {y.shape}"
        if x.dtype.kind != "f":
            if not np.array_equal(x, y):
                return f"{np.sum(x != y)} of {x.size} values of {name} differ"
            continue
        scale = 1e-300 + np.max(np.abs(y), initial=0.0, where=np.isfinite(y))
        away = np.where(np.isnan(x) & np.isnan(y), 0.0, np.abs(x - y)) / scale
        if away.size and not np.max(away) <= worst:
            worst, where = float(np.max(away)), name
    alone = sorted(here.keys() ^ there.keys())
    return f"largest relative difference {worst:.1e} ({where}){f'; alone: {alone}' * bool(alone)}"


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--only", choices=list(GROUPS), nargs="*", default=list(GROUPS))
    parser.add_argument("--numbers", type=Path)
    parser.add_argument("--against", type=Path)
    arguments = started(parser)
    lines = []
    for group in arguments.only:
        for name, numbers in GROUPS[group]():
            line = f"{digest(numbers)}  {name}"
            lines.append(line)
            place = f"{name.replace(' ', '_')}.npz"
            if arguments.numbers:
                arguments.numbers.mkdir(parents=True, exist_ok=True)
                np.savez(arguments.numbers / place, **numbers)
            if arguments.against:
                with np.load(arguments.against / place) as there:
                    line += f"  {distance(numbers, dict(there))}"
            print(line, flush=True)
    arguments.file.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
