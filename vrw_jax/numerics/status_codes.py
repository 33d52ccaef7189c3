"""Status codes with one sentence for a reader, which each batch element can carry as an integer."""

import enum


class StatusCode(enum.IntEnum):
    """Base class of status codes, whose members are `NAME = number, "sentence"`.

    The number is the value of the member.
    """

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> "StatusCode":
        code = int.__new__(cls, value)
        code._value_, code.meaning = value, meaning
        return code
