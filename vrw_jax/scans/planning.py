"""Plan of a scan before it runs: checked arguments, layout and identifying settings."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from vrw_jax import simd
from vrw_jax.cycles import CycleOptions, make_finder
from vrw_jax.measures import MARGIN_MEASURES, locked_leg_coordinate, measure_attrs, provenance
from vrw_jax.models import AbstractWheel, ModelCapabilities, ViscoelasticWheel
from vrw_jax.numerics import StepOptions, batch_sizes
from vrw_jax.runtime import source_digest
from vrw_jax.scans.collocation_engine import EvaluationRequest
from vrw_jax.scans.design import AbstractDesign, SampleColumns
from vrw_jax.scans.engines import make_engine
from vrw_jax.scans.integrity import MANIFEST_ATTRIBUTE
from vrw_jax.scans.measure_catalog import (
    canonicalize_name,
    check_measures,
    error_variable_name,
    get_variable_attrs,
    select_catalog,
)
from vrw_jax.scans.store import (
    PROVENANCE_ATTRIBUTE,
    REQUESTED_ATTRIBUTE,
    ResultLayout,
    VariableLayout,
    choose_chunk_shape,
    find_first_difference,
)
from vrw_jax.selection import describe_models
from vrw_jax.simulation import ModelLike, check_model, check_options
from vrw_jax.validation import check_int, check_names, check_positive, check_type
from vrw_jax.wheel import FRICTION_NAME, PARAMETER_NAMES, WheelParams

MAX_SCAN_SAMPLES = 1_000_000_000
"""Largest number of samples of a scan, chosen because it takes over a day and some hundred GB."""


PASSAGE_CHUNK_SIZE = 16
"""Number of samples that are written at a time if walks over random slopes are measured, chosen
because each sample takes a second or more."""


STORED_KINDS = {"StepOptions": "Options"}
"""Names of classes in stores, if they differ from the names in Python."""

STORED_FIELD_NAMES = {
    "StepOptions": {
        "dt0": "first_step",
        "max_event_iterations": "event_steps",
        "max_margin_search_iterations": "monitor_steps",
    },
    "CycleOptions": {
        "mesh_intervals": "steps",
        "mesh_grading": "growth",
        "max_newton_iterations": "iterations",
        "first_newton_iterations": "first_iterations",
        "homotopy_steps": "stages",
        "batch_size": "block",
    },
    "UnilateralWheel": {"infinite_friction_rule": "infinite"},
}
"""Names of fields in stores by class, if they differ from the names in Python."""

STORED_MODEL_NAMES = {
    "model_name": "rung",
    "reports_contacts": "tells_contacts",
    "batch_kernel": "lanes",
    "is_compliant": "legs_yield",
}
"""Names of class variables of models in stores, if they differ from the names in Python."""

EvaluateSamples = Callable[[SampleColumns], Mapping[str, np.ndarray]]
"""Function that returns the results of samples by variable, with the axis of samples first."""

ChunkResult = tuple[int, Mapping[str, np.ndarray]]
"""Index of a chunk, and its results by variable."""

ChunkExecutor = Callable[["ScanPlan", Sequence[int]], Iterator[ChunkResult]]
"""Function that computes chunks of a plan, given by index, and yields them in any order."""


@dataclass(frozen=True)
class ScanPlan:
    """Checked arguments and layout of a scan."""

    design: AbstractDesign
    request: EvaluationRequest
    layout: ResultLayout
    requested_measures: tuple[str, ...]  # names of the requested measures, as the caller gave them
    config_text: str

    @property
    def settings(self) -> dict[str, object]:
        """Return the settings that a store must have so that the scan can continue in it."""
        measures, base, model, options, cycle_options, tol, slope_sd = self.request
        fixed_names = (name for name in PARAMETER_NAMES if name not in self.design.names)
        return {
            "design": self.design.describe_identity(),
            "wheel": {name: float(getattr(base, name)) for name in fixed_names}
            | {"n_legs": base.n_legs},
            "measures": list(measures),
            "model": _record_fields(model),
            "options": _record_fields(options),
            "cycle_options": _record_fields(cycle_options),
            "dtype": str(base.damping.dtype),
            "chunk": list(self.layout.chunk_shape),
        } | {
            name: value
            for name, value in (("tol", tol), ("slope_sd", slope_sd))
            if value is not None
        }

    @property
    def store_attrs(self) -> dict[str, object]:
        """Return the attributes of the labeled result and its store."""
        return {
            "title": f"Steady gaits of the viscoelastic-legged rimless wheel over "
            f"{', '.join(self.design.names)}",
            "rule": "NaN, or -1 in an integer, where the outcome is not STEPPED.",
            MANIFEST_ATTRIBUTE: json.dumps(self.settings),  # Other formats have no tables.
            PROVENANCE_ATTRIBUTE: json.dumps(describe_environment()),
            REQUESTED_ATTRIBUTE: ", ".join(self.requested_measures),
            "config": self.config_text,
        }

    def build_engine(self) -> EvaluateSamples:
        """Return the engine that computes the samples."""
        return make_engine(self.request)


def plan_scan(
    design: AbstractDesign,
    measures: Iterable[str] | None = None,
    *,
    base: WheelParams | None = None,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    cycle_options: CycleOptions | None = None,
    chunk: int | None = None,
    config_text: str = "",
    tol: float | None = None,
    slope_sd: float | None = None,
) -> ScanPlan:
    """Return the checked plan of a scan, with the layout of its result; nothing is computed."""
    if not isinstance(design, AbstractDesign):
        raise TypeError(
            f"design is a {type(design).__name__}, but it must say which samples: write "
            "vrw.grid(damping=[...]), vrw.samples({...}), vrw.sobol({...}, n) or vrw.uniform."
        )
    base = WheelParams() if base is None else base
    check_type("base", base, WheelParams, "write vrw.WheelParams(slope=...)")
    base.require_single("give numbers, and what varies in the design")
    options, model = check_options(options), check_model(model)
    options.check_tolerances(np.dtype(base.damping.dtype))
    finder = make_finder(model, base.n_legs, cycle_options=cycle_options, step_options=options)
    finder.search_options.check_tolerances(np.dtype(base.damping.dtype))
    default_chunk = batch_sizes.SCAN_CHUNK_SIZE if slope_sd is None else PASSAGE_CHUNK_SIZE
    chunk = default_chunk if chunk is None else check_int("chunk", chunk)
    if design.size > MAX_SCAN_SAMPLES:
        raise ValueError(
            f"the design has {design.size:,} samples, but a scan takes {MAX_SCAN_SAMPLES:,} at "
            "most: give its axes fewer values, or draw samples with vrw.sobol."
        )
    if not model.is_compliant:
        raise TypeError(
            f"model is {model!r}, but a scan is of gaits with compliant legs: give "
            f"{describe_models('scan')}."
        )
    if FRICTION_NAME in design.names and FRICTION_NAME not in model.parameter_names:
        raise ValueError(
            "the design sweeps friction, which does not affect the paper's wheel: give "
            f"model={describe_models('scan', FRICTION_NAME)}."
        )
    tol = None if tol is None else _check_tolerance(model, check_positive("tol", tol))
    if slope_sd is not None:
        slope_sd = check_positive("slope_sd", slope_sd)
        if tol is not None:
            raise ValueError(
                "tol and slope_sd are both given, but a scan to a tolerance has no measures of "
                "walks over random slopes: drop one of them."
            )
    catalog = select_catalog(model, tol, slope_sd)
    requested_measures = (
        catalog.default_measures if measures is None else check_names("measures", measures)
    )
    names = check_measures(requested_measures, catalog)
    canonical_names = (canonicalize_name(name) for name in requested_measures)
    variable_names = dict.fromkeys(
        variable_name
        for name in canonical_names
        for variable_name in (name, error_variable_name(name))[: 1 + bool(tol)]
    )
    cycle_options = CycleOptions() if cycle_options is None else cycle_options
    request = EvaluationRequest(names, base, model, options, cycle_options, tol, slope_sd)
    layout = _make_layout(
        design, tuple(variable_names | dict.fromkeys(catalog.always_included)), base, chunk
    )
    return ScanPlan(design, request, layout, requested_measures, config_text)


def _check_tolerance(model: AbstractWheel, tol: float) -> float:
    """Return the tolerance; raise a ValueError if a tolerance cannot refer to the model."""
    fields: dict[str, Any] = type(model).__dataclass_fields__
    default_only_fields = model.capabilities.fixed_by_tolerance
    if default_only_fields is None or any(
        getattr(model, name) != fields[name].default for name in default_only_fields
    ):
        raise ValueError(
            f"tol is given and model is {model!r}, but a tolerance refers to unilateral contact "
            "with no settings other than friction and stoppers: give "
            "model=vrw.UnilateralWheel(friction=...)."
        )
    return tol


def describe_environment() -> dict[str, object]:
    """Return the digest of the source, the versions and the device of this process."""
    environment = provenance(WheelParams(), ViscoelasticWheel(), StepOptions())
    processor_features = simd.describe_processor()[2].split(",")
    instruction_sets = [
        name for name in VECTOR_INSTRUCTION_SETS if f"+{name}" in processor_features
    ]
    processor = " ".join([platform.machine(), *instruction_sets])
    return {
        "code": source_digest(),
        "versions": environment["versions"],
        "device": f"{jax.default_backend()}: {environment['device']}, {processor}",
    }


VECTOR_INSTRUCTION_SETS = ("avx", "fma", "avx2", "avx512f", "avx512dq", "neon", "sve")
"""Instruction sets that decide which sums the compiler fuses, and thus the last digits."""


def describe_difference(stored_settings: object, current_settings: object) -> str:
    """Return a description of the first setting that differs, or an empty string."""
    name, stored_value, current_value = find_first_difference(stored_settings, current_settings)
    if not name:
        return ""
    if name == "design.digest":
        return "the values of the swept parameters differ"
    if name == "code":
        return "the library's code differs"
    return f"{name} is {stored_value!r} there and {current_value!r} here"


def _make_layout(
    design: AbstractDesign, names: tuple[str, ...], base: WheelParams, chunk: int
) -> ResultLayout:
    """Return the layout of the variables `names` over a design, in chunks of at most `chunk`
    samples.
    """
    dtype = str(base.damping.dtype)
    legs = locked_leg_coordinate(base.n_legs)

    def make_variable(name: str) -> VariableLayout:
        """Return type, missing value and attributes of one variable."""
        attributes = get_variable_attrs(name)
        if name in ("outcome", "rung", "reason"):
            return VariableLayout(name, "int8", -1, attributes)
        if name == "solver_steps":
            return VariableLayout(name, "int32", -1, attributes)
        if name in MARGIN_MEASURES and MARGIN_MEASURES[name].dimension:
            return VariableLayout(name, dtype, np.nan, attributes, ("leg",), legs.shape)
        return VariableLayout(name, dtype, np.nan, attributes)

    coordinates = {
        name: (
            dim,
            values,
            measure_attrs(name) if name in (*PARAMETER_NAMES, FRICTION_NAME) else {},
        )
        for name, (dim, values) in design.result_coordinates().items()
    }
    coordinates["leg"] = ("leg", legs.values, legs.attrs)
    return ResultLayout(
        dims=design.dims,
        shape=design.shape,
        chunk_shape=choose_chunk_shape(design.shape, chunk),
        variables=tuple(make_variable(name) for name in names),
        coordinates=coordinates,
    )


def _record_fields(settings: object) -> dict[str, object]:
    """Return the class name and the fields of settings as values of JSON."""
    class_name = type(settings).__name__
    record: dict[str, object] = {"kind": STORED_KINDS.get(class_name, class_name)}
    stored_names = STORED_MODEL_NAMES | STORED_FIELD_NAMES.get(class_name, {})
    for name in type(settings).__dataclass_fields__:  # type: ignore[attr-defined]
        value = getattr(settings, name)
        if isinstance(value, StepOptions | ModelCapabilities):
            continue  # Options are recorded separately, and capabilities are code.
        if value is None or isinstance(value, bool | int | str):
            record[stored_names.get(name, name)] = value
        elif isinstance(value, tuple):
            record[stored_names.get(name, name)] = list(value)
        else:
            record[stored_names.get(name, name)] = float(value)
    return record
