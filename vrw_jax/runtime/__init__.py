"""Process-wide runtime: number format, lazily imported libraries, disk cache, compiled programs."""

from vrw_jax.runtime.lazy import library, xarray
from vrw_jax.runtime.programs import compiled, lane_function, lane_program, remembered
from vrw_jax.runtime.start import start_jax
from vrw_jax.runtime.store import code_digest
