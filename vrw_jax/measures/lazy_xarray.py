"""The library xarray, imported on first use. All labeled results are its datasets."""

from typing import TYPE_CHECKING

from vrw_jax.runtime import lazy_import

if TYPE_CHECKING:
    import xarray as xarray
else:
    xarray = lazy_import("xarray")
