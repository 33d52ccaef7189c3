"""Results of a case: one row per method, with the verdict right, reported or silently wrong."""

import math
import re
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from matplotlib.figure import Figure

ACCEPTED_ERROR, EXACT_ERROR, TOLERANCE_EXCESS_FACTOR = 1e-9, 1e-12, 100.0
"""An error that counts as right at all; what is asked of a closed form times the problem's own
condition; over the tolerance that a method was asked for: see `Row.is_within_request`."""


class Row(NamedTuple):
    """One method's answer to one question of a case."""

    quantity: str
    method: str
    found: float
    reference: float
    error: float  # absolute, or relative where the case says so
    says: str  # its own code, message or exception
    admits: bool  # whether that is a failure told, and not success claimed
    work: int  # steps tried, or evaluations where a method tells those alone
    seconds: float  # CPU time of a call that has been compiled before
    options: str
    version: str
    condition: float = 1.0  # by how much a unit error of the state moves the reference
    digits: int | None = None  # of a published reference; None: a closed form, or all digits

    @property
    def requested_tolerance(self) -> float:
        """Return the tolerance among the options of the method, or 0."""
        result = re.search(r"\d\S*e-\d+", self.options)
        return float(result[0].rstrip(",")) if result else 0.0

    @property
    def is_within_request(self) -> float:
        """Return whether the error satisfies the rule that holds for all methods."""
        published = 0.0 if self.digits is None else 0.5 * 10.0**-self.digits
        return max(
            ACCEPTED_ERROR,
            EXACT_ERROR * self.condition,
            TOLERANCE_EXCESS_FACTOR * self.requested_tolerance,
            published,
        )

    @property
    def verdict(self) -> str:
        if self.error <= self.is_within_request:
            return "right"
        return "says so" if self.admits else "WRONG, silently"


class Case(NamedTuple):
    """A problem of somebody else."""

    title: str
    breaks: str
    reference: str
    source: str
    rows: Callable[[], Iterable[Row]]
    draw: Callable[[Figure, list[dict[str, str]]], None]


def compute_error(solution: float, reference: float, *, relative: bool = False) -> float:
    """Error; infinite where nothing was found."""
    gap = abs(solution - reference) / (abs(reference) if relative else 1.0)
    return gap if math.isfinite(gap) else math.inf


def time_second_call(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a second call and its CPU seconds, without compilation."""
    call()
    began = time.process_time()
    result = call()
    return result, time.process_time() - began
