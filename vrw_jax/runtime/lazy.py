"""Libraries imported when they are first used: together they cost a second of every start."""

import importlib
from typing import TYPE_CHECKING, Any


class _Library:
    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(importlib.import_module(self._name), attribute)


def library(name: str) -> Any:
    """That library, imported once something of it is asked for."""
    return _Library(name)


if TYPE_CHECKING:
    import xarray as xarray
else:
    xarray = library("xarray")  # of which all results are made
