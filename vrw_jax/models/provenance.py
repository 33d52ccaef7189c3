"""Provenance of results: versions, device, floating-point type, tolerances and parameters."""

import platform
from typing import Any

import jax
import jax.numpy as jnp

from vrw_jax.base.options import StepOptions
from vrw_jax.base.parameters import list_tree_parameters
from vrw_jax.lanes.disk_cache import find_library_version
from vrw_jax.wheel.params import WheelParams


def collect_provenance_attributes(
    params: Any, model: object, options: StepOptions | None = None
) -> dict[str, str | float | int]:
    """Return dataset attributes that describe how a result was computed.

    They state versions, device, floating-point type, tolerances and parameters. The default of
    `options` is `StepOptions()`.
    """
    options = StepOptions() if options is None else options
    parameter_attributes: dict[str, str | float | int] = {
        f"parameter_{parameter.name}": float(parameter.value)
        for parameter in list_tree_parameters(params)
        if jnp.ndim(parameter.value) == 0
    }
    if isinstance(params, WheelParams):
        parameter_attributes["parameter_n_legs"] = params.n_legs
    return parameter_attributes | {
        "model": repr(model),
        "versions": ", ".join(
            f"{library_name} {find_library_version(library_name)}"
            for library_name in ("vrw-jax", "jax", "diffrax", "numpy")
        )
        + f", python {platform.python_version()}",
        "device": jax.devices()[0].device_kind,
        "dtype": str(jnp.result_type(*jax.tree.leaves(params), float)),
        "solver": options.solver,
        "rtol": float(options.rtol),
        "atol": float(options.atol),
    }
