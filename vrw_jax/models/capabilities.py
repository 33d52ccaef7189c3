"""What the library offers for a model: each model declares it, each package reads its part."""

import enum
from dataclasses import dataclass


class GaitMethod(enum.StrEnum):
    """Ways to find, follow and scan the gaits of a model."""

    COLLOCATION = enum.auto()
    """Newton's method on the whole cycle, for a fixed sequence of phases."""
    CONTACT_WALKS = enum.auto()
    """Walks that settle on a gait, then Newton's method on the return map in contact modes."""
    RETURN_MAP = enum.auto()
    """Newton's method on the return map."""
    SELECTION = enum.auto()
    """The method of the model that is selected for each wheel."""


@dataclass(frozen=True)
class ModelCapabilities:
    """What the library offers for a model."""

    config_name: str
    """Name of the model in a configuration and on the command line."""
    gait_method: GaitMethod
    """How gaits of the model are found; branches and scans follow from it."""
    commands: frozenset[str]
    """Commands that accept the model: "scan", "map", "tune", "branch" and "explore"."""
    fixed_by_tolerance: tuple[str, ...] | None = None
    """Fields that need their default values if measures are requested to a tolerance; None if no
    tolerance can refer to the model."""
