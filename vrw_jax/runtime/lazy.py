"""Libraries imported when they are first used: together they cost a second of every start."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import diffrax as diffrax
    import optax as optax
    import xarray as xarray
    import zarr as zarr
else:

    class _Library:
        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, attribute: str) -> Any:
            return getattr(importlib.import_module(self._name), attribute)

    diffrax, optax, xarray, zarr = map(_Library, ("diffrax", "optax", "xarray", "zarr"))
