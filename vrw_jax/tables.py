"""How results show themselves: a few lines of text, and a table in a notebook."""

from collections.abc import Sequence
from html import escape

import jax
import numpy as np

from vrw_jax.limit_cycle import LimitCycle
from vrw_jax.measures import MARGINS, STEP, Measure, step_measures
from vrw_jax.models.base import StepResult
from vrw_jax.outcomes import Outcome

Row = tuple[str, str]


def is_concrete(tree: object) -> bool:
    """Whether all numbers are known, as they aren't inside `jit` or `vmap`."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def cycle_rows(cycle: LimitCycle) -> list[Row]:
    """What a limit cycle says of itself; of many, how many were found."""
    outcome = np.asarray(cycle.outcome)
    if outcome.ndim:
        found = int(np.sum(outcome == Outcome.STEPPED))
        return [("wheels", f"{outcome.size} in shape {outcome.shape}, {found} with a gait")]
    if outcome != Outcome.STEPPED:
        code = Outcome(int(outcome))
        return [("outcome", f"{code.name}: {code.meaning}")]
    multipliers = sorted(np.linalg.eigvals(np.asarray(cycle.matrix)), key=abs, reverse=True)
    radius = float(np.max(np.abs(multipliers)))
    told = ", ".join(f"{z:.5f}" if z.imag else f"{z.real:.5f}" for z in multipliers)
    forces = cycle.indicators
    many = cycle.problem.period_n > 1
    return [
        ("gait", f"{'stable' if radius < 1.0 else 'unstable'}, repeats after "
         f"{f'{cycle.problem.period_n} steps' if many else 'one step'}"),
        ("double support", f"{100 * float(cycle.dls_fraction):.3f} %"),
        ("period", f"{float(cycle.period):.6f} s"),
        ("speed", f"{float(cycle.speed):.6f} m/s"),
        ("durations of DLS, SLS-I, SLS-II", f"{_list(cycle.durations)} s"),
        ("after landing: angle, rate", f"{_list(cycle.post_impact)} rad, rad/s"),
        ("indicators λ_I4, λ2⁺, λ4⁺", f"{_list(forces.lambda_I4)} N s, "
         f"{_list(forces.lambda_2)} N, {_list(forces.lambda_4)} N"),
        ("multipliers", f"{told}; spectral radius {radius:.6f}"),
    ]  # fmt: skip


def step_rows(result: StepResult) -> list[Row]:
    """What a step says of itself: measures, then premises and whether they hold."""
    outcome = np.asarray(result.outcome)
    if outcome.ndim:
        stepped = int(np.sum(outcome == Outcome.STEPPED))
        return [("steps", f"{outcome.size} in shape {outcome.shape}, {stepped} to touchdown")]
    code = Outcome(int(outcome))
    values = step_measures(result)
    rows = [("outcome", f"{code.name}: {code.meaning}")]
    rows += [
        (m.long_name, _with_unit(values[name], m)) for name, m in STEP.items() if name != "outcome"
    ]
    for name, m in MARGINS.items():
        least = float(np.min(np.asarray(values[name])))
        verdict = "holds" if least >= 0.0 else "broken"
        rows.append((f"premise: {m.long_name}", f"{_with_unit(least, m)}, {verdict}"))
    return rows


def as_text(title: str, rows: Sequence[Row]) -> str:
    """The rows under a title."""
    return "\n".join([title, *(f"  {name}: {text}" for name, text in rows)])


def as_html(title: str, rows: Sequence[Row]) -> str:
    """The rows as a table."""
    left = "style='text-align:left'"
    cells = "".join(
        f"<tr><th {left}>{escape(name)}</th><td {left}>{escape(text)}</td></tr>"
        for name, text in rows
    )
    return f"<table><caption>{escape(title)}</caption>{cells}</table>"


def _list(values: object) -> str:
    return ", ".join(f"{v:.5g}" for v in np.ravel(np.asarray(values)))


def _with_unit(value: object, m: Measure) -> str:
    return f"{float(np.asarray(value)):.6g} {'' if m.unit == '1' else m.unit}".strip()
