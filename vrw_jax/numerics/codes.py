"""What a lane carries of how something ended: a code, with one sentence for a reader."""

import enum


class Code(enum.IntEnum):
    """Members are `NAME = number, "sentence"`; the number is the value."""

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> "Code":
        code = int.__new__(cls, value)
        code._value_, code.meaning = value, meaning
        return code
