"""Libraries imported on first use, because importing all of them takes a second of every start."""

import importlib
from typing import TYPE_CHECKING, Any


class _LazyLibrary:
    """A library that is imported on the first access to one of its attributes."""

    def __init__(self, library_name: str) -> None:
        self._library_name = library_name

    def __getattr__(self, attribute_name: str) -> Any:
        return getattr(importlib.import_module(self._library_name), attribute_name)


def lazy_import(library_name: str) -> Any:
    """Return a library that is imported on the first access to one of its attributes."""
    return _LazyLibrary(library_name)


if TYPE_CHECKING:
    import xarray as xarray
else:
    xarray = lazy_import("xarray")  # All labeled results are datasets of this library.
