"""What tuning leaves behind: the path, the tuned wheel as a config, a summary, a picture."""

from pathlib import Path

from vrw_jax.figures import tuning
from vrw_jax.figures import walk as plots
from vrw_jax.tuning import Tuned
from vrw_jax.wheel import DOMAINS, PARAMETER_NAMES


def write(tuned: Tuned, folder: Path, picture: bool = True) -> list[Path]:
    """Write everything about a tuned gait into `folder`; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    store, wheel, text = folder / "path.zarr", folder / "wheel.toml", folder / "summary.md"
    tuned.path.to_zarr(store, mode="w", zarr_format=2)
    wheel.write_text(_config(tuned), encoding="utf-8")
    text.write_text(summary(tuned), encoding="utf-8")
    pictures = plots.save(tuning(tuned), folder, "tuning") if picture else []
    return [store, wheel, text, *pictures]


def _config(tuned: Tuned) -> str:
    lines = [
        f"# Tuned: {tuned.objective} {tuned.value:.6g}. Walk it with `vrw gait`.",
        "",
        "[wheel]",
    ]
    for name in PARAMETER_NAMES:
        unit = DOMAINS[name].unit
        value = float(getattr(tuned.params, name))
        lines.append(f"{name} = {value!r}" + (f" # {unit}" if unit else ""))
    return "\n".join([*lines, f"n_legs = {tuned.params.n_legs}", ""])


def summary(tuned: Tuned) -> str:
    """The result for a reader, in Markdown."""
    lines = [f"# Tuned: {tuned.objective}", ""]
    lines += [f"- **{name}**: {text}" for name, text in tuned.lines().items()]
    lines += ["", "| held by | limit | objective gained per unit given up |", "|---|---|---|"]
    for active in tuned.active:
        unit = "" if active.unit == "1" else f" {active.unit}"
        lines.append(f"| {active.name} | {active.limit:.6g}{unit} | {active.price:.4g} |")
    if not tuned.active:
        lines.append("| nothing | | |")
    lines += [
        "",
        f"First-order condition met to {tuned.kkt_residual:.1e} of the objective's gradient.",
        "",
        "| parameter | start | tuned | unit |",
        "|---|---|---|---|",
    ]
    for name in tuned.path.attrs["free"]:
        first, last = float(tuned.path[name][0]), float(getattr(tuned.params, name))
        lines.append(f"| {name} | {first:.6g} | {last:.6g} | {DOMAINS[name].unit} |")
    return "\n".join([*lines, ""])
