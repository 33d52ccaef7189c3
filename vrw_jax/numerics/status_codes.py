"""Status codes with one sentence each, stored as an integer for each batch element."""

import enum


class StatusCode(enum.IntEnum):
    """Base class of status codes, whose members are defined as `NAME = number, "sentence"`.

    The number is the value of the member, and the sentence is its attribute `meaning`.
    """

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> "StatusCode":
        status_code = int.__new__(cls, value)
        status_code._value_, status_code.meaning = value, meaning
        return status_code
