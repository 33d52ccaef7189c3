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
from vrw_jax.cycles import CycleOptions, finder_of
from vrw_jax.models import AbstractWheel, ViscoelasticWheel
from vrw_jax.numerics import Options
from vrw_jax.results import MARGINS, attrs_of, locked_legs, provenance
from vrw_jax.runtime import code_digest
from vrw_jax.scans.design import AbstractDesign, Columns
from vrw_jax.scans.evaluate import Asked
from vrw_jax.scans.ground import engine_for
from vrw_jax.scans.offer import canonical, check_measures, error_of, offer_of, variable_attrs
from vrw_jax.scans.store import (
    ASKED,
    MANIFEST,
    PROVENANCE,
    Layout,
    Variable,
    chunk_shape,
    first_difference,
)
from vrw_jax.walks import ModelLike, options_of, rung_of
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES, WheelParams
from vrw_jax.wording import instance, names_of, positive, whole

MOST_SAMPLES = 1_000_000_000
"""Largest number of samples, chosen because it takes over a day and some hundred GB."""

CHUNK = 4096
"""Default number of samples per chunk; a killed scan can lose so many."""

ANSWERABLE = {"unilateral": ("restitution", "infinite", "uneven", "max_events")}
"""Models that a tolerance can refer to, and their fields that must have the default value."""

Evaluate = Callable[[Columns], Mapping[str, np.ndarray]]
"""Function that returns the results of samples by variable, with the axis of samples first."""
Chunk = tuple[int, Mapping[str, np.ndarray]]
"""Index of a chunk and its results."""
Through = Callable[["Plan", Sequence[int]], Iterator[Chunk]]
"""Function that computes chunks of a plan, given by index, and yields them in any order."""


@dataclass(frozen=True)
class Plan:
    """Checked arguments and layout of a scan."""

    design: AbstractDesign
    for_engine: Asked
    layout: Layout
    asked: tuple[str, ...]  # measures by the names that the caller gave
    text: str

    @property
    def settings(self) -> dict[str, object]:
        """Return the settings that a store must share so that the scan can continue in it."""
        measures, base, model, options, cycle_options, tol = self.for_engine
        fixed = (name for name in PARAMETER_NAMES if name not in self.design.names)
        return {
            "design": self.design.description(),
            "wheel": {name: float(getattr(base, name)) for name in fixed} | {"n_legs": base.n_legs},
            "measures": list(measures),
            "model": _fields(model),
            "options": _fields(options),
            "cycle_options": _fields(cycle_options),
            "dtype": str(base.damping.dtype),
            "chunk": list(self.layout.chunk),
        } | ({} if tol is None else {"tol": tol})

    @property
    def attrs(self) -> dict[str, object]:
        """Return the attributes of the labelled result."""
        return {
            "title": f"Steady gaits of the viscoelastic-legged rimless wheel over "
            f"{', '.join(self.design.names)}",
            "rule": "NaN, or -1 in an integer, where the outcome is not STEPPED.",
            MANIFEST: json.dumps(self.settings),  # text: other formats take no tables
            PROVENANCE: json.dumps(origin()),
            ASKED: ", ".join(self.asked),
            "config": self.text,
        }

    def engine(self) -> Evaluate:
        """Return the engine that computes the samples."""
        return engine_for(self.for_engine)


def plan(
    design: AbstractDesign,
    measures: Iterable[str] | None = None,
    *,
    base: WheelParams | None = None,
    model: ModelLike | None = None,
    options: Options | None = None,
    cycle_options: CycleOptions | None = None,
    chunk: int | None = None,
    text: str = "",
    tol: float | None = None,
) -> Plan:
    """Return the checked plan of a scan, with the layout of its result, without computing it."""
    if not isinstance(design, AbstractDesign):
        raise TypeError(
            f"design is a {type(design).__name__}, but it must say which samples: write "
            "vrw.grid(damping=[...]), vrw.samples({...}), vrw.sobol({...}, n) or vrw.uniform."
        )
    base = WheelParams() if base is None else base
    instance("base", base, WheelParams, "write vrw.WheelParams(slope=...)")
    base.require_one("give numbers, and what varies in the design")
    options, model = options_of(options), rung_of(model)
    options.require_reachable(np.dtype(base.damping.dtype))
    finder = finder_of(model, base.n_legs, cycle_options=cycle_options, step_options=options)
    finder.options_used.require_reachable(np.dtype(base.damping.dtype))
    chunk = CHUNK if chunk is None else whole("chunk", chunk)
    if design.size > MOST_SAMPLES:
        raise ValueError(
            f"the design has {design.size:,} samples, but a scan takes {MOST_SAMPLES:,} at most: "
            "give its axes fewer values, or draw samples with vrw.sobol."
        )
    if not model.legs_yield:
        raise TypeError(
            f"model is {model!r}, but a scan is of gaits with compliant legs: give "
            'vrw.ViscoelasticWheel(), vrw.UnilateralWheel() or "auto".'
        )
    if FRICTION in design.names and FRICTION not in model.parameter_names:
        raise ValueError(
            "the design sweeps friction, which does not affect the paper's wheel: give "
            'model=vrw.UnilateralWheel() or "auto".'
        )
    tol = None if tol is None else _towards(model, positive("tol", tol))
    offer = offer_of(model, tol)
    asked = offer.default if measures is None else names_of("measures", measures)
    names = check_measures(asked, offer)
    own = (canonical(name) for name in asked)
    first = dict.fromkeys(x for name in own for x in (name, error_of(name))[: 1 + bool(tol)])
    cycle_options = CycleOptions() if cycle_options is None else cycle_options
    sought = Asked(names, base, model, options, cycle_options, tol)
    layout = _layout(design, tuple(first | dict.fromkeys(offer.always)), base, chunk)
    return Plan(design, sought, layout, asked, text)


def _towards(model: AbstractWheel, tol: float) -> float:
    """Return the tolerance; raise if no tolerance can refer to the model."""
    usual: dict[str, Any] = type(model).__dataclass_fields__
    own = ANSWERABLE.get(model.rung)
    if own is None or any(getattr(model, name) != usual[name].default for name in own):
        raise ValueError(
            f"tol is given and model is {model!r}, but a tolerance refers to unilateral contact "
            "with no settings other than friction and stoppers: give "
            "model=vrw.UnilateralWheel(friction=...)."
        )
    return tol


def origin() -> dict[str, object]:
    """Return the code digest, the versions and the device of this process."""
    told = provenance(WheelParams(), ViscoelasticWheel(), Options())
    return {
        "code": code_digest(),
        "versions": told["versions"],
        "device": f"{jax.default_backend()}: {told['device']}, {_processor()}",
    }


VECTOR_SETS = ("avx", "fma", "avx2", "avx512f", "avx512dq", "neon", "sve")
"""Instruction sets that decide which sums the compiler fuses, and thus the last digits."""


def _processor() -> str:
    """Return the kind of processor, as far as the last digits depend on it."""
    able = simd.processor()[2].split(",")
    return " ".join([platform.machine(), *(name for name in VECTOR_SETS if f"+{name}" in able)])


def difference(there: object, here: object) -> str:
    """Return a description of the first setting that differs, or an empty string."""
    name, old, new = first_difference(there, here)
    if not name:
        return ""
    if name == "design.digest":
        return "the values of the swept parameters differ"
    if name == "code":
        return "the library's code differs"
    return f"{name} is {old!r} there and {new!r} here"


def _layout(
    design: AbstractDesign, names: tuple[str, ...], base: WheelParams, chunk: int
) -> Layout:
    """Return the layout of the variables `names` over a design, in chunks of at most `chunk`."""
    dtype = str(base.damping.dtype)
    legs = locked_legs(base.n_legs)

    def variable(name: str) -> Variable:
        """Return type, missing value and attributes of one variable."""
        attrs = variable_attrs(name)
        if name in ("outcome", "rung", "reason"):
            return Variable(name, "int8", -1, attrs)
        if name == "solver_steps":
            return Variable(name, "int32", -1, attrs)
        if name in MARGINS and MARGINS[name].axis:
            return Variable(name, dtype, np.nan, attrs, ("leg",), legs.shape)
        return Variable(name, dtype, np.nan, attrs)

    coordinates = {
        name: (dim, values, attrs_of(name) if name in (*PARAMETER_NAMES, FRICTION) else {})
        for name, (dim, values) in design.coordinates().items()
    }
    coordinates["leg"] = ("leg", legs.values, legs.attrs)
    return Layout(
        dims=design.dims,
        shape=design.shape,
        chunk=chunk_shape(design.shape, chunk),
        variables=tuple(variable(name) for name in names),
        coordinates=coordinates,
    )


def _fields(settings: object) -> dict[str, object]:
    """Return the class name and the fields of settings, as values of JSON."""
    told: dict[str, object] = {"kind": type(settings).__name__}
    for name in type(settings).__dataclass_fields__:  # type: ignore[attr-defined]
        value = getattr(settings, name)
        if isinstance(value, Options):
            continue  # recorded separately
        if value is None or isinstance(value, bool | int | str):
            told[name] = value
        elif isinstance(value, tuple):
            told[name] = list(value)
        else:
            told[name] = float(value)
    return told
