"""Provenance of results: versions, device, number format, tolerances, parameters."""

import functools
import importlib.metadata
import platform

import jax

from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams


def provenance(
    params: WheelParams, model: object, options: StepOptions
) -> dict[str, str | float | int]:
    """Return the origin of a result: versions, device, number format, tolerances, parameters."""
    names = ("vrw-jax", "jax", "diffrax", "numpy")
    values: dict[str, str | float | int] = {
        f"parameter_{name}": float(getattr(params, name))
        for name in PARAMETER_NAMES
        if getattr(params, name).ndim == 0
    }
    return values | {
        "parameter_n_legs": params.n_legs,
        "model": repr(model),
        "versions": ", ".join(f"{name} {_installed_version(name)}" for name in names)
        + f", python {platform.python_version()}",
        "device": jax.devices()[0].device_kind,
        "dtype": str(params.damping.dtype),
        "solver": options.solver,
        "rtol": float(options.rtol),
        "atol": float(options.atol),
    }


@functools.cache  # Reading the metadata takes longer than the steps of a walk.
def _installed_version(name: str) -> str:
    """Return the version of an installed library."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
