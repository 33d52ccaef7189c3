"""Status codes with one sentence for a reader, stored as an integer for each batch element."""

import enum


class StatusCode(enum.IntEnum):
    """Base class of status codes, whose members are `NAME = number, "sentence"`.

    The number is the value of the member, and the sentence its attribute `meaning`.
    """

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> "StatusCode":
        code = int.__new__(cls, value)
        code._value_, code.meaning = value, meaning
        return code
