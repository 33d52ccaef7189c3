"""Marks variants of a test as slow."""

from collections.abc import Collection, Iterable
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


ENGINES = [pytest.param("auto", id="lanes"), *mark_slow("diffrax")]
"""Engines of a test. "auto" selects "lanes", by the programs of tests that name no engine."""


def make_params_with_slow_marks(names: Iterable[str], slow_names: Collection[str]) -> list[Any]:
    """Return the names as values of a parametrized test, and mark those in `slow_names` as slow."""
    return [pytest.param(x, marks=[pytest.mark.slow] * (x in slow_names)) for x in names]
