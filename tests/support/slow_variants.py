"""Marks further variants of a quick test as slow."""

from typing import Any

import pytest


def mark_slow(*variants: Any) -> list[Any]:
    """Return the values of a parametrized test, each marked as slow.

    A variant of several arguments is a tuple.
    """
    return [
        pytest.param(*(x if isinstance(x, tuple) else (x,)), marks=pytest.mark.slow)
        for x in variants
    ]
