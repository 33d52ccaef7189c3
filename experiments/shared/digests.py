"""Print digests of results by engine, which show whether a change of the code keeps every bit.

    python -m experiments.shared.digests FILE [--only GROUP ...] [--numbers FOLDER]

The command writes one line per result to FILE. Run it before and after the change on one machine,
and compare the files with `diff`. With `--numbers FOLDER` it also stores the numbers. With
`--against FOLDER` it prints their largest relative change.
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
from experiments.shared.command import make_parser, parse_and_start_jax

N_STEP_WHEELS = 4096
"""Number of wheels of the batches of steps."""
N_CYCLE_WHEELS = 1024
"""Number of wheels of the batch of limit cycles."""
NumberTable = dict[str, np.ndarray]
"""Arrays of a result by their names."""


def collect_numbers(tree: object) -> NumberTable:
    """Return all arrays of a result, by their path in it."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def draw_wheels(n: int, seed: int) -> vrw.WheelParams:
    """Return `n` random wheels."""
    draw = np.random.default_rng(seed).uniform
    return vrw.WheelParams(
        damping=draw(20.0, 215.0, n),
        stiffness=draw(400.0, 600.0, n),
        natural_length=draw(1.01, 1.04, n),
        slope=draw(0.26, 0.34, n),
    )


def digest_steps() -> Iterator[tuple[str, NumberTable]]:
    """Yield steps of a batch by each engine, and steps with unilateral contact."""
    params = draw_wheels(N_STEP_WHEELS, 1)
    draw = np.random.default_rng(2)
    states = np.asarray(vrw.limit_cycle(vrw.WheelParams()).section_state)
    states = states * draw.uniform(0.98, 1.02, (N_STEP_WHEELS, 3))
    yield "steps by lanes", collect_numbers(vrw.step_batch(params, states))
    yield "steps by diffrax", collect_numbers(vrw.step_batch(params, states, engine="diffrax"))
    ground = vrw.UnilateralWheel(friction=2.0)
    first_wheels = jax.tree.map(lambda x: x[:64] if jnp.ndim(x) else x, params)
    yield (
        "steps with unilateral contact",
        collect_numbers(vrw.step_batch(first_wheels, states[:64], 3, model=ground)),
    )


def digest_single_wheel() -> Iterator[tuple[str, NumberTable]]:
    """Yield a step of one wheel, its Jacobian, a trajectory and a walk with unilateral contact."""
    table_1 = vrw.WheelParams()
    x = vrw.limit_cycle(table_1).section_state
    yield "step", collect_numbers(vrw.step(table_1, x))
    jacobians = jax.jacfwd(vrw.return_map, argnums=(0, 1))(table_1, x)
    yield "return map's Jacobian", collect_numbers(jacobians)
    walk = vrw.simulate(table_1, x, n_steps=2)
    yield "trajectory", {str(name): np.asarray(walk[name]) for name in walk.data_vars}
    ground = vrw.UnilateralWheel(friction=1.5)
    yield "walk with unilateral contact", collect_numbers(vrw.walk(table_1, x, 5, model=ground))


def digest_cycles() -> Iterator[tuple[str, NumberTable]]:
    """Yield a scan of limit cycles with derivatives of their measures."""
    names = ("dls_fraction", "speed", "period", "lambda_I4", "lambda_4_plus")
    design = vrw.samples(
        {
            name: np.asarray(getattr(draw_wheels(N_CYCLE_WHEELS, 3), name))
            for name in ("damping", "stiffness", "natural_length", "slope")
        }
    )
    derivatives = [
        f"d {name} / d {input_name}"
        for name in names
        for input_name in ("damping", "slope", "leg_mass")
    ]
    scan_result = vrw.scan(design, [*names, *derivatives])
    yield (
        "cycles with derivatives",
        {str(name): np.asarray(scan_result[name]) for name in scan_result},
    )


def digest_quickstart() -> Iterator[tuple[str, NumberTable]]:
    """Yield the scan of `configs/quickstart.toml`, computed into a store."""
    text = (Path(__file__).parents[2] / "configs" / "quickstart.toml").read_text()
    config = tomllib.loads(text)
    with TemporaryDirectory() as folder:
        axes = {
            name: np.linspace(axis["from"], axis["to"], axis["count"])
            if isinstance(axis, dict)
            else np.asarray(axis)
            for name, axis in config["grid"].items()
        }
        scan_result = vrw.scan(
            vrw.grid(**axes), config["scan"]["measures"], store=Path(folder) / "s"
        )
        yield (
            "quickstart's store",
            {str(name): np.asarray(scan_result[name]) for name in scan_result},
        )


def digest_branch() -> Iterator[tuple[str, NumberTable]]:
    """Yield a branch along the damping with its special points."""
    branch_result = vrw.continue_branch(vrw.WheelParams(), "damping", (4.0, 230.0))
    special_points = {
        f"border {special_point.name}": np.asarray(special_point.value)
        for special_point in branch_result.special_points
    }
    points = {
        str(name): np.asarray(branch_result.dataset[name])
        for name in branch_result.dataset.variables
    }
    yield "branch", special_points | points


def digest_tuning() -> Iterator[tuple[str, NumberTable]]:
    """Yield the result and the path of a tuning."""
    bounds = {"damping": (20.0, 215.0), "slope": (0.26, 0.34)}
    tune_result = vrw.tune(vrw.WheelParams(), "dls_fraction", list(bounds), bounds)
    path = {
        f"path {name}": np.asarray(tune_result.path[name]) for name in tune_result.path.data_vars
    }
    yield (
        "tuning",
        collect_numbers((tune_result.params, tune_result.value, tune_result.kkt_residual)) | path,
    )


GROUPS: dict[str, Callable[[], Iterator[tuple[str, NumberTable]]]] = {
    "steps": digest_steps,
    "one_wheel": digest_single_wheel,
    "cycles": digest_cycles,
    "quickstart": digest_quickstart,
    "branch": digest_branch,
    "tuning": digest_tuning,
}
"""Functions that compute results, by the names of `--only`."""


def compute_digest(numbers: NumberTable) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 hash of a result."""
    result = hashlib.sha256()
    for name in sorted(numbers):
        value = numbers[name]
        content = value.tobytes() if value.dtype.kind in "fiub" else repr(value.tolist()).encode()
        result.update(f"{name} {value.shape} {value.dtype.kind}".encode() + content)
    return result.hexdigest()[:16]


def compute_distance(new_numbers: NumberTable, old_numbers: NumberTable) -> str:
    """Return as text the largest relative difference and the names that only one side has."""
    worst, worst_name = 0.0, "none"
    for name in new_numbers.keys() & old_numbers.keys():
        x, y = new_numbers[name], old_numbers[name]
        if x.shape != y.shape:
            return f"{name} has shape {x.shape}, previously {y.shape}"
        if x.dtype.kind != "f":
            if not np.array_equal(x, y):
                return f"{np.sum(x != y)} of {x.size} values of {name} differ"
            continue
        scale = 1e-300 + np.max(np.abs(y), initial=0.0, where=np.isfinite(y))
        relative_change = np.where(np.isnan(x) & np.isnan(y), 0.0, np.abs(x - y)) / scale
        if relative_change.size and not np.max(relative_change) <= worst:
            worst, worst_name = float(np.max(relative_change)), name
    unshared_names = sorted(new_numbers.keys() ^ old_numbers.keys())
    return (
        f"largest relative difference {worst:.1e} "
        f"({worst_name}){f'; on one side only: {unshared_names}' * bool(unshared_names)}"
    )


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--only", choices=list(GROUPS), nargs="*", default=list(GROUPS))
    parser.add_argument("--numbers", type=Path)
    parser.add_argument("--against", type=Path)
    arguments = parse_and_start_jax(parser)
    lines = []
    for group in arguments.only:
        for name, numbers in GROUPS[group]():
            line = f"{compute_digest(numbers)}  {name}"
            lines.append(line)
            file_name = f"{name.replace(' ', '_')}.npz"
            if arguments.numbers:
                arguments.numbers.mkdir(parents=True, exist_ok=True)
                np.savez(arguments.numbers / file_name, **numbers)
            if arguments.against:
                with np.load(arguments.against / file_name) as old_file:
                    line += f"  {compute_distance(numbers, dict(old_file))}"
            print(line, flush=True)
    arguments.file.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
