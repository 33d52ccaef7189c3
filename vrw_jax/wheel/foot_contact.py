"""Codes of the contact between a foot and the ground."""

from enum import IntEnum


class ContactMode(IntEnum):
    """Contact mode of a foot. Section states and trajectories contain these integers."""

    OFF = 0  # in the air
    STICK = 1  # at rest on the ground
    SLIP_DOWN = 2  # sliding downhill
    SLIP_UP = 3  # sliding uphill
