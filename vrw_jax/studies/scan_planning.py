"""Plan of a scan before its computation: checked arguments, layout of the result, and the settings
that identify the scan.
"""

from __future__ import annotations

import json
import math
import platform
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax import lanes
from vrw_jax.base.checks import check_int, check_names, check_positive, check_type
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Measure, find_own_measures, name_measures
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.walker import check_parameters, is_own_walker
from vrw_jax.gaits.cycle import CycleOptions
from vrw_jax.gaits.gait_search import make_finder
from vrw_jax.gaits.walker_finder import ParameterizedWalker, make_walker_finder
from vrw_jax.lanes.environment import compute_source_digest
from vrw_jax.lanes.keys import UnresolvableFunctionError, make_key
from vrw_jax.models.ladder import collect_provenance_attributes, describe_accepted_models
from vrw_jax.models.measures import MARGIN_MEASURES, describe_parameter, make_locked_leg_coordinate
from vrw_jax.models.stepping import (
    convert_model_argument,
    convert_step_options,
    require_compliant_model,
    require_legs_in_turn_by_collocation,
)
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.studies.measure_catalog import (
    ERROR_VARIABLE_SUFFIX,
    MeasureCatalog,
    ValuesByVariable,
    canonicalize_variable_name,
    check_measure_names,
    get_variable_attributes,
    parse_derivative,
    select_measure_catalog,
)
from vrw_jax.studies.scan_design import (
    MANIFEST_ATTRIBUTE,
    REQUESTED_MEASURES_ATTRIBUTE,
    JsonObject,
    ParameterSamples,
    SampleDesign,
)
from vrw_jax.studies.scan_engines import EvaluationRequest, SampleEvaluator, make_scan_engine
from vrw_jax.wheel.params import FRICTION_NAME, LAW_NAMES, WheelParams, check_parameter_name

SCAN_CHUNK_SIZE = 4096
"""Default number of samples of a scan that are written together. A scan that is killed may lose as
many samples.
"""

PROVENANCE_ATTRIBUTE = "provenance"
"""Name of the attribute of a store that describes the origin of the results."""

MAX_SCAN_SAMPLES = 1_000_000_000
"""Largest number of samples in a scan.

The value is chosen because so many samples take over a day and some hundred GB.
"""


N_PASSAGE_SAMPLES_PER_CHUNK = 16
"""Number of samples that are written at a time if a scan measures walks over random slopes.

The value is chosen because each sample takes a second or more.
"""


STORED_NAME_BY_CLASS = {"StepOptions": "Options"}
"""Names of classes in stores, by their names in Python, where the two names differ."""

STORED_NAMES_BY_FIELD_OF_CLASS = {
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
"""Names of fields in stores, by class and by name in Python, where the two names differ."""

STORED_NAME_BY_MODEL_FIELD = {
    "model_name": "rung",
    "reports_contacts": "tells_contacts",
    "batch_kernel": "lanes",
    "is_compliant": "legs_yield",
}
"""Names in stores of class variables of models, by their names in Python, where the two names
differ.
"""

ChunkResult = tuple[int, ValuesByVariable]
"""Index of a chunk, and the values of each variable in the chunk, by the name of the variable."""

ChunkExecutor = Callable[["ScanPlan", Sequence[int]], Iterator[ChunkResult]]
"""Function that computes the chunks with the given indices, and yields a `ChunkResult` for each
chunk in any order.
"""


ChunkRegion = tuple[slice, ...]
"""Slices that select the samples of a chunk, one for each sample axis."""


@dataclass(frozen=True)
class ResultLayout:
    """Description of a result: its sample axes, chunks, variables and coordinates.

    The variables have the shape of the whole result and contain missing values, which occupy no
    memory.
    """

    sample_shape: tuple[int, ...]
    chunk_shape: tuple[int, ...]
    empty_variables: Mapping[str, xr.Variable]
    result_coordinates: Mapping[str, xr.Variable]

    @property
    def n_chunks(self) -> int:
        """Return the number of chunks of the result."""
        return math.prod(self._chunks_per_axis)

    @property
    def _chunks_per_axis(self) -> tuple[int, ...]:
        n_chunks_by_axis = np.ceil(np.divide(self.sample_shape, self.chunk_shape))
        return tuple(n_chunks_by_axis.astype(int).tolist())

    def compute_chunk_region(self, chunk_index: int) -> ChunkRegion:
        """Return the slices that select the samples of a chunk, one for each sample axis."""
        chunk_indices = np.unravel_index(chunk_index, self._chunks_per_axis)
        chunk_starts = np.multiply(chunk_indices, self.chunk_shape)
        chunk_ends = np.minimum(chunk_starts + self.chunk_shape, self.sample_shape)
        return tuple(map(slice, chunk_starts.tolist(), chunk_ends.tolist()))

    def compute_chunk_sample_shape(self, chunk_index: int) -> tuple[int, ...]:
        """Return the number of samples in a chunk along each sample axis.

        A chunk at the end of an axis may be smaller than others.
        """
        return tuple(
            chunk_slice.stop - chunk_slice.start
            for chunk_slice in self.compute_chunk_region(chunk_index)
        )

    @property
    def bytes_per_sample(self) -> int:
        """Return the number of bytes that the uncompressed results of one sample occupy."""
        n_bytes = sum(variable.nbytes for variable in self.empty_variables.values())
        return n_bytes // math.prod(self.sample_shape)


def choose_chunk_shape(sample_shape: tuple[int, ...], max_chunk_samples: int) -> tuple[int, ...]:
    """Return the shape of chunks that contain at most `max_chunk_samples` samples.

    A chunk spans the whole length of the last axes.
    """
    chunk_shape: list[int] = []
    for axis_length in reversed(sample_shape):
        chunk_length = min(axis_length, max_chunk_samples)
        max_chunk_samples //= chunk_length  # It stays at least 1.
        chunk_shape.insert(0, chunk_length)
    return tuple(chunk_shape)


@dataclass(frozen=True)
class ScanPlan:
    """Checked arguments of a scan, and the layout of its result."""

    design: SampleDesign
    evaluation_request: EvaluationRequest
    measure_catalog: MeasureCatalog
    result_layout: ResultLayout
    requested_measures: tuple[str, ...]  # names of the requested measures, as the caller gave them
    config_file_text: str

    @property
    def scan_settings(self) -> JsonObject:
        """Return the settings that identify the scan.

        A scan continues a store only if the store contains the same settings.
        """
        request, base_wheel = self.evaluation_request, self.evaluation_request.base_wheel
        scan_settings: JsonObject = {
            "design": self.design.describe_design(),
            "wheel": {
                parameter_name: float(request.wheel_model.get_parameter(base_wheel, parameter_name))
                for parameter_name in request.wheel_model.parameter_names
                if parameter_name not in (FRICTION_NAME, *self.design.swept_parameters)
            }
            | ({"n_legs": base_wheel.n_legs} if request.wheel_model.is_wheel else {}),
            "measures": list(request.measure_names),
            "model": _convert_settings_to_json(request.wheel_model),
            "options": _convert_settings_to_json(request.step_options),
            "cycle_options": _convert_settings_to_json(request.cycle_options),
            "dtype": str(jnp.result_type(*jax.tree.leaves(base_wheel))),
            "chunk": list(self.result_layout.chunk_shape),
        }
        if request.error_tolerance is not None:
            scan_settings["tol"] = request.error_tolerance
        if request.own_measures:
            scan_settings["own_measures"] = {
                x.name: _identify_code(x) for x in request.own_measures
            }
        if request.slope_standard_deviation is not None:
            scan_settings["slope_sd"] = request.slope_standard_deviation
        return scan_settings

    @property
    def store_attributes(self) -> JsonObject:
        """Return the attributes that the labeled result and its store have."""
        is_wheel = self.evaluation_request.wheel_model.is_wheel
        walker_text = "the viscoelastic-legged rimless wheel" if is_wheel else "a walker"
        return {
            "title": f"Steady gaits of {walker_text} over "
            f"{', '.join(self.design.swept_parameters)}",
            "rule": "NaN, or -1 in an integer, where the outcome is not STEPPED.",
            MANIFEST_ATTRIBUTE: json.dumps(self.scan_settings),  # Other formats have no tables.
            PROVENANCE_ATTRIBUTE: json.dumps(describe_computing_environment()),
            REQUESTED_MEASURES_ATTRIBUTE: ", ".join(self.requested_measures),
            "config": self.config_file_text,
        }

    def select_chunk_samples(self, chunk_index: int) -> ParameterSamples:
        """Return the values of each swept parameter for the samples of a chunk, by parameter."""
        return self.design.select_samples(self.result_layout.compute_chunk_region(chunk_index))

    def build_scan_engine(self) -> SampleEvaluator:
        """Return the engine that computes the samples of this plan."""
        return make_scan_engine(self.evaluation_request)


def plan_scan(
    design: SampleDesign,
    measures: Iterable[str | Measure] | Measure | None = None,
    *,
    base: Any = None,
    model: Any = None,
    options: StepOptions | None = None,
    cycle_options: CycleOptions | None = None,
    chunk: int | None = None,
    config_text: str = "",
    tol: float | None = None,
    slope_sd: float | None = None,
) -> ScanPlan:
    """Return the checked plan of a scan, with the layout of its result. No gait is computed.

    The arguments are those of `scan`. `config_text` is the text of the configuration file, if any.
    """
    if not isinstance(design, SampleDesign):
        raise TypeError(
            f"design is a {type(design).__name__}, but it must say which samples: write "
            "vrw.grid(damping=[...]), vrw.samples({...}), vrw.sobol({...}, n) or vrw.uniform."
        )
    options = convert_step_options(options)
    if is_own_walker(model):
        if base is None or tol is not None or slope_sd is not None:
            raise ValueError(
                "model is a walker of yours, so that tol and slope_sd, which belong to the wheel, "
                "can't be given, and base must be: give base= the parameters of the walker."
            )
        base = check_parameters(base)
        gait_finder: Any = make_walker_finder(model, base, options)
        model = gait_finder.model
    else:
        base = WheelParams() if base is None else base
        check_type("base", base, WheelParams, "write vrw.WheelParams(slope=...)")
        base.require_single_wheel("give numbers, and what varies in the design")
        model = convert_model_argument(model)
        require_legs_in_turn_by_collocation(model, "vrw.scan")
        gait_finder = make_finder(
            model, base.n_legs,
            period_n=model.leg_period, cycle_options=cycle_options, step_options=options,
        )  # fmt: skip
    if cycle_options is not None and not isinstance(gait_finder.search_options, CycleOptions):
        raise ValueError(
            "cycle_options is given, but the gaits of this model are found on its return map: give "
            "options=vrw.StepOptions(...) of its step."
        )
    dtype = np.dtype(jnp.result_type(*jax.tree.leaves(base)))
    options.check_tolerances(dtype)
    gait_finder.search_options.check_tolerances(dtype)
    if chunk is None:
        chunk = SCAN_CHUNK_SIZE if slope_sd is None else N_PASSAGE_SAMPLES_PER_CHUNK
    chunk = check_int("chunk", chunk)
    if design.size > MAX_SCAN_SAMPLES:
        raise ValueError(
            f"the design has {design.size:,} samples, but a scan takes {MAX_SCAN_SAMPLES:,} at "
            "most: give its axes fewer values, or draw samples with vrw.sobol."
        )
    require_compliant_model(model, "a scan is of gaits with", "scan")
    if FRICTION_NAME in design.swept_parameters and FRICTION_NAME not in model.parameter_names:
        raise ValueError(
            "the design sweeps friction, which does not affect the paper's wheel: give "
            f"model={describe_accepted_models('scan', FRICTION_NAME)}."
        )
    for parameter_name in design.swept_parameters:
        check_parameter_name(parameter_name, model.parameter_names, "parameter of this model")
    tol = None if tol is None else check_positive("tol", tol)
    slope_sd = None if slope_sd is None else check_positive("slope_sd", slope_sd)
    _check_tolerance_and_slopes(model, options, tol, slope_sd)
    catalog, own_measures = _select_measures(gait_finder, measures, tol, slope_sd)
    requested_measures = catalog.default_measures
    if measures is not None:
        requested_measures = check_names("measures", name_measures(measures))
    measure_names = check_measure_names(requested_measures, catalog)
    variable_names = []
    for requested_measure in requested_measures:
        variable_names.append(canonicalize_variable_name(requested_measure))
        if tol is not None and requested_measure in measure_names:
            variable_names.append(requested_measure + ERROR_VARIABLE_SUFFIX)
    variable_names += catalog.always_included_variables
    cycle_options = getattr(gait_finder, "cycle_options", cycle_options or CycleOptions())
    own = tuple(own_measures.values())
    request = EvaluationRequest(
        measure_names, base, model, options, cycle_options, tol, slope_sd, own
    )
    result_layout = _make_result_layout(
        design, variable_names, base, gait_finder, own_measures, dtype, chunk
    )
    return ScanPlan(design, request, catalog, result_layout, requested_measures, config_text)


def _check_tolerance_and_slopes(
    model: Any, options: StepOptions, tol: float | None, slope_sd: float | None
) -> None:
    """Raise an error unless the model has scans to a tolerance, or with random slopes."""
    if tol is not None:
        model_fields: dict[str, Any] = type(model).__dataclass_fields__
        fixed_fields = model.fixed_fields_of_tolerance
        if fixed_fields is None or any(
            getattr(model, name) != model_fields[name].default for name in fixed_fields
        ):
            raise ValueError(
                f"tol is given and model is {model!r}, but a tolerance refers to unilateral "
                "contact with no settings other than friction and stoppers: give "
                "model=vrw.UnilateralWheel(friction=...)."
            )
        if options != StepOptions():
            raise ValueError(
                "tol and options are both given, but a tolerance itself sets the options of each "
                "sample: drop one of them."
            )
    if slope_sd is not None:
        if model.leg_period > 1:
            raise ValueError(
                "slope_sd is given and the legs alternate, but walks over random slopes have equal "
                "legs: give one law for all legs, or no slope_sd."
            )
        if tol is not None:
            raise ValueError(
                "tol and slope_sd are both given, but a scan to a tolerance has no measures of "
                "walks over random slopes: drop one of them."
            )


def _select_measures(
    gait_finder: Any, measures: Any, tol: float | None, slope_sd: float | None
) -> tuple[MeasureCatalog, Mapping[str, Measure]]:
    """Return the catalog of measures of a scan, and the requested measures of the user by name."""
    model = gait_finder.model
    if not model.is_wheel:
        names = gait_finder.differentiable_measures
        always_included = "outcome", "spectral_radius"
        return MeasureCatalog(names, always_included, names, model.parameter_names, names, 64), {}
    catalog = select_measure_catalog(model, tol, slope_sd)
    own_measures = find_own_measures(measures, catalog.requestable_measures)
    if own_measures and (not gait_finder.has_own_measures or tol is not None):
        raise ValueError(
            f"{', '.join(own_measures)} is a measure of your own, but it is known for gaits of "
            "the paper's model only: take model=vrw.ViscoelasticWheel(), and no tol."
        )
    return catalog._replace(
        requestable_measures=(*catalog.requestable_measures, *own_measures),
        differentiable_measures=(*catalog.differentiable_measures, *own_measures),
    ), own_measures


def describe_computing_environment() -> JsonObject:
    """Return a description of the environment in which this process computes.

    It consists of the digest of the source code, the versions of the libraries and the device.
    """
    provenance_record = collect_provenance_attributes(
        WheelParams(), ViscoelasticWheel(), StepOptions()
    )
    processor_features = lanes.describe_processor()[2].split(",")
    instruction_sets = [
        instruction_set
        for instruction_set in VECTOR_INSTRUCTION_SETS
        if f"+{instruction_set}" in processor_features
    ]
    processor_text = " ".join([platform.machine(), *instruction_sets])
    return {
        "code": compute_source_digest(),
        "versions": provenance_record["versions"],
        "device": f"{jax.default_backend()}: {provenance_record['device']}, {processor_text}",
    }


def _identify_code(code: Any) -> str:
    """Return the key of the code of a walker, or of a law without its parameters.

    The key of code that cannot be identified is new in each scan, which therefore never resumes.
    """
    try:
        return make_key(code)
    except UnresolvableFunctionError as error:
        return f"{uuid.uuid4()}: {error}"


VECTOR_INSTRUCTION_SETS = ("avx", "fma", "avx2", "avx512f", "avx512dq", "neon", "sve")
"""Processor instruction sets that decide which products and sums the compiler fuses, and thus the
last digits of results.
"""


def describe_settings_difference(
    stored_settings: object, current_settings: object, setting_name: str = ""
) -> str:
    """Return a sentence that states the first setting that differs, or "" if no setting differs.

    - `setting_name`: name of the compared setting, "" for the table of all settings.
    """
    if isinstance(stored_settings, dict) and isinstance(current_settings, dict):
        differences = (
            describe_settings_difference(
                stored_settings.get(nested_name),
                current_settings.get(nested_name),
                f"{setting_name}.{nested_name}".removeprefix("."),
            )
            for nested_name in stored_settings | current_settings
        )
        return next(filter(None, differences), "")
    if stored_settings == current_settings:
        return ""
    if setting_name == "design.digest":
        return "the values of the swept parameters differ"
    if setting_name.startswith("own_measures."):
        return f"the code of {setting_name.removeprefix('own_measures.')} differs"
    if setting_name == "model.parameters":
        return "the class of the walker's parameters or one of their static fields differs"
    if setting_name == "model.walker" or setting_name.removeprefix("model.") in LAW_NAMES:
        return f"the code of {setting_name.removeprefix('model.')} differs"
    if setting_name == "code":
        return "the library's code differs"
    return f"{setting_name} is {stored_settings!r} there and {current_settings!r} here"


def _make_result_layout(
    design: SampleDesign,
    variable_names: Iterable[str],
    base_wheel: Any,
    gait_finder: Any,
    own_measures: Mapping[str, Measure],
    dtype: np.dtype,
    chunk_size: int,
) -> ResultLayout:
    """Return the layout of a scan's variables over the axes of a design.

    - `chunk_size`: largest number of samples in a chunk.
    """
    model = gait_finder.model
    locked_leg_coordinate = make_locked_leg_coordinate(getattr(base_wheel, "n_legs", 2))
    domains = model.parameter_domains

    def describe_variable(variable_name: str) -> dict[str, Any]:
        derivative = parse_derivative(variable_name)
        measure_name = variable_name if derivative is None else derivative.measure_name
        is_known = model.is_wheel or variable_name in ("outcome", "spectral_radius")
        if is_known and measure_name not in own_measures:
            return get_variable_attributes(variable_name)
        measure: Any = own_measures.get(measure_name) or gait_finder.get_measure(measure_name)
        if derivative is None:
            return measure.variable_attributes
        parameter_name = derivative.parameter_name
        return derivative.describe_variable(
            measure, describe_parameter(parameter_name, domains[parameter_name])
        )

    def make_empty_variable(variable_name: str) -> xr.Variable:
        """Return a variable without results: NaN for every sample, or -1 for an integer."""
        missing_value = np.array(np.nan, dtype)
        if variable_name in INTEGER_VARIABLE_DTYPES:
            missing_value = np.array(-1, INTEGER_VARIABLE_DTYPES[variable_name])
        dimension_names, shape = design.dims, design.shape
        if variable_name in MARGIN_MEASURES and MARGIN_MEASURES[variable_name].leg_dimension:
            dimension_names, shape = (*dimension_names, "leg"), (*shape, locked_leg_coordinate.size)
        return xr.Variable(
            dimension_names, np.broadcast_to(missing_value, shape), describe_variable(variable_name)
        )

    result_coordinates = design.make_result_coordinates()
    if model.is_wheel:
        result_coordinates |= {"leg": locked_leg_coordinate}
    for parameter_name in design.swept_parameters:
        result_coordinates[parameter_name].attrs |= describe_parameter(
            parameter_name, domains[parameter_name]
        ).variable_attributes
    return ResultLayout(
        sample_shape=design.shape,
        chunk_shape=choose_chunk_shape(design.shape, chunk_size),
        empty_variables={
            variable_name: make_empty_variable(variable_name) for variable_name in variable_names
        },
        result_coordinates=result_coordinates,
    )


INTEGER_VARIABLE_DTYPES = {
    "outcome": "int8",
    "rung": "int8",
    "reason": "int8",
    "solver_steps": "int32",
}
"""Types of the variables that are integers."""


def _convert_settings_to_json(settings_object: object) -> JsonObject:
    """Return the class name and the fields of `settings_object` as JSON values, by field name."""
    class_name = type(settings_object).__name__
    if isinstance(settings_object, ParameterizedWalker):
        return {
            "kind": class_name,
            "walker": _identify_code(settings_object.walker),
            "parameters": _identify_code(settings_object.structure),  # code and static fields
        }
    field_value_by_name: JsonObject = {"kind": STORED_NAME_BY_CLASS.get(class_name, class_name)}
    stored_name_by_field = STORED_NAME_BY_MODEL_FIELD | STORED_NAMES_BY_FIELD_OF_CLASS.get(
        class_name, {}
    )
    for field_name in type(settings_object).__dataclass_fields__:  # type: ignore[attr-defined]
        field_value = getattr(settings_object, field_name)
        if isinstance(field_value, StepOptions):
            continue  # Options are recorded separately.
        if field_name in LAW_NAMES:
            if field_value is None:
                continue
            field_value = _identify_code(jax.tree.structure(field_value))
        elif isinstance(field_value, tuple):
            field_value = list(field_value)
        elif field_value is not None and not isinstance(field_value, bool | int | str):
            field_value = float(field_value)
        field_value_by_name[stored_name_by_field.get(field_name, field_name)] = field_value
    if hasattr(settings_object, "parameter_names"):
        field_value_by_name["parameter_names"] = list(settings_object.parameter_names)
    return field_value_by_name
