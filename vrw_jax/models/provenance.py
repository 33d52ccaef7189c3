"""Provenance of results: versions, device, floating-point type, tolerances and parameters."""

import platform

import jax

from vrw_jax.base.options import StepOptions
from vrw_jax.lanes.disk_cache import find_library_version
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams


def collect_provenance_attributes(
    params: WheelParams, model: object, options: StepOptions | None = None
) -> dict[str, str | float | int]:
    """Return dataset attributes that describe how a result was computed.

    They state versions, device, floating-point type, tolerances and parameters. The default of
    `options` is `StepOptions()`.
    """
    options = StepOptions() if options is None else options
    parameter_attributes: dict[str, str | float | int] = {
        f"parameter_{parameter_name}": float(getattr(params, parameter_name))
        for parameter_name in PARAMETER_NAMES
        if getattr(params, parameter_name).ndim == 0
    }
    return parameter_attributes | {
        "parameter_n_legs": params.n_legs,
        "model": repr(model),
        "versions": ", ".join(
            f"{library_name} {find_library_version(library_name)}"
            for library_name in ("vrw-jax", "jax", "diffrax", "numpy")
        )
        + f", python {platform.python_version()}",
        "device": jax.devices()[0].device_kind,
        "dtype": str(params.damping.dtype),
        "solver": options.solver,
        "rtol": float(options.rtol),
        "atol": float(options.atol),
    }
