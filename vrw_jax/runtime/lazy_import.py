"""Lazy import of libraries, because importing all of them would add a second to every start."""

import importlib
from typing import Any


class _LazyLibrary:
    """Proxy for a library, which is imported when one of its attributes is first read."""

    def __init__(self, library_name: str) -> None:
        self._library_name = library_name

    def __getattr__(self, attribute_name: str) -> Any:
        return getattr(importlib.import_module(self._library_name), attribute_name)


def lazy_import(library_name: str) -> Any:
    """Return a proxy for a library. The library is imported when one of its attributes is first
    read.
    """
    return _LazyLibrary(library_name)
