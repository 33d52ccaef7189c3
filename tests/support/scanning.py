"""A small design, and an arithmetic substitute for the engine that computes samples."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import xarray as xr

from vrw_jax import Outcome
from vrw_jax.models import MARGIN_MEASURES
from vrw_jax.studies import ScanPlan, plan_scan
from vrw_jax.studies import scan_design as designs
from vrw_jax.studies import scan_execution as running

SCANNED_MEASURES = ("dls_fraction", "speed", "d dls_fraction / d damping")
SMALL_GRID = designs.grid(damping=np.linspace(100.0, 200.0, 5), slope=np.linspace(0.28, 0.31, 4))


def evaluate_arithmetically(columns: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
    """Return every variable as a function of the sample, in place of the engine."""
    total = np.sum([np.sin(column) for column in columns.values()], axis=0)
    results = {name: total * (i + 1) for i, name in enumerate(MARGIN_MEASURES)}
    for name, margin in MARGIN_MEASURES.items():
        if margin.leg_dimension:
            results[name] = results[name][:, None] + np.arange(6)
    outcome = np.where(total > 0.9, Outcome.NO_CYCLE_FOUND, Outcome.STEPPED).astype(np.int8)
    names = ("dls_fraction", "speed", "d_dls_fraction_d_damping", "spectral_radius")
    return results | {name: total / (i + 1) for i, name in enumerate(names)} | {"outcome": outcome}


class CountingEngine:
    """Substitute for the engine that counts its calls, and fails at one of them."""

    def __init__(
        self, failing_call: int | None = None, error: type[BaseException] = KeyboardInterrupt
    ) -> None:
        self.n_calls, self.failing_call, self.error = 0, failing_call, error

    def __call__(self, columns: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        self.n_calls += 1
        if self.n_calls == self.failing_call:
            raise self.error
        return evaluate_arithmetically(columns)


def run_plan(
    plan_of_scan: ScanPlan,
    store: object = None,
    evaluate: Callable | None = None,
    **keywords: object,
) -> xr.Dataset:
    """Return a scan whose samples `evaluate` computes in order, in place of the engine."""

    def compute_in_order(
        running_plan: ScanPlan, missing: Sequence[int]
    ) -> Iterator[tuple[int, dict]]:
        for index in missing:
            yield (
                index,
                evaluate(
                    running_plan.design.select_samples(
                        running_plan.result_layout.compute_chunk_region(index)
                    )
                ),
            )

    return running.run_scan(
        plan_of_scan, store, **({"chunk_executor": compute_in_order} if evaluate else {}) | keywords
    )


def make_plan(chunk: int = 4, **changes: object) -> ScanPlan:
    return plan_scan(SMALL_GRID, SCANNED_MEASURES, chunk=chunk, **changes)
