"""Status codes: integers for batch elements, each with a sentence that explains it."""

import enum
from typing import Any

from vrw_jax.base.printing import format_each_batch_element


class StatusCode(enum.IntEnum):
    """Base class for enumerations of status codes. Members are defined as `NAME = number,
    "sentence"`.

    The number is the member's value, and the sentence is the member's attribute `meaning`.
    """

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> "StatusCode":
        status_code = int.__new__(cls, value)
        status_code._value_, status_code.meaning = value, meaning
        return status_code


def describe_step_ending(status_codes: Any, status_code_class: type[StatusCode]) -> Any:
    """Return the sentence that explains a status code, or an array of sentences for a batch."""
    describe_status_code = lambda status_code: status_code_class(int(status_code)).meaning
    return format_each_batch_element(describe_status_code, status_codes)
