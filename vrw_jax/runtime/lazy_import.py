"""Libraries imported on first use, because importing all of them takes a second of every start."""

import importlib
from typing import TYPE_CHECKING, Any


class _LazyLibrary:
    """A library that is imported on the first access to one of its attributes."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(importlib.import_module(self._name), attribute)


def lazy_import(name: str) -> Any:
    """Return the library `name`, which is imported on the first access to an attribute."""
    return _LazyLibrary(name)


if TYPE_CHECKING:
    import xarray as xarray
else:
    xarray = lazy_import("xarray")  # All labeled results are datasets of this library.
