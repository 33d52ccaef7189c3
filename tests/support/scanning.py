"""A small design, and a stand-in for the engine that computes its samples."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import xarray as xr

from vrw_jax.results.measures import MARGINS
from vrw_jax.scans import design as designs
from vrw_jax.scans import running
from vrw_jax.scans.design import Columns
from vrw_jax.scans.evaluate import Engine as Engine
from vrw_jax.scans.planning import Chunk, Plan, plan
from vrw_jax.wheel.outcomes import Outcome

MEASURES = ("dls_fraction", "speed", "d dls_fraction / d damping")
GRID = designs.grid(damping=np.linspace(100.0, 200.0, 5), slope=np.linspace(0.28, 0.31, 4))


def arithmetic(columns: Columns) -> Mapping[str, np.ndarray]:
    """A stand-in for the engine, quick and exact: every variable is some function of the sample."""
    total = np.sum([np.sin(column) for column in columns.values()], axis=0)
    told = {name: total * (i + 1) for i, name in enumerate(MARGINS)}
    for name, margin in MARGINS.items():
        if margin.axis:
            told[name] = told[name][:, None] + np.arange(6)
    outcome = np.where(total > 0.9, Outcome.NO_CYCLE_FOUND, Outcome.STEPPED).astype(np.int8)
    names = ("dls_fraction", "speed", "d_dls_fraction_d_damping", "spectral_radius")
    return told | {name: total / (i + 1) for i, name in enumerate(names)} | {"outcome": outcome}


class Counted:
    """The stand-in, counting its calls and failing at the call that it is told to."""

    def __init__(self, fails_at: int | None = None, error: type[BaseException] = KeyboardInterrupt):
        self.calls, self.fails_at, self.error = 0, fails_at, error

    def __call__(self, columns: Columns) -> Mapping[str, np.ndarray]:
        self.calls += 1
        if self.calls == self.fails_at:
            raise self.error
        return arithmetic(columns)


def run(
    planned: Plan, store: object = None, evaluate: Callable | None = None, **more: object
) -> xr.Dataset:
    """A scan whose samples `evaluate` computes in the engine's stead, in turn."""

    def in_turn(planned: Plan, missing: Sequence[int]) -> Iterator[Chunk]:
        for index in missing:
            yield index, evaluate(planned.design.block(planned.layout.region(index)))

    return running.run(planned, store, **({"through": in_turn} if evaluate else {}) | more)


def planned(chunk: int = 4, **changes: object) -> Plan:
    return plan(GRID, MEASURES, chunk=chunk, **changes)
