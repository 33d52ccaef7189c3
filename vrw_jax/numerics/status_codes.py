"""Status codes: integers for batch elements, each with a sentence that explains it."""

import enum


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
