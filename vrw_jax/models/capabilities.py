"""Features of the library that each model declares, and that other packages read."""

import enum
from dataclasses import dataclass


class GaitMethod(enum.StrEnum):
    """Methods that find, follow and scan the gaits of a model."""

    COLLOCATION = enum.auto()
    """Newton's method on the whole cycle, for a fixed sequence of phases."""
    CONTACT_WALKS = enum.auto()
    """Walks that settle on a gait, then Newton's method on the return map with fixed contact
    modes."""
    RETURN_MAP = enum.auto()
    """Newton's method on the return map."""
    SELECTION = enum.auto()
    """Method of the model that is selected for each wheel."""


class PassageMethod(enum.StrEnum):
    """Methods that compute mean first-passage times of a model on uneven ground."""

    QUADRATURE = enum.auto()
    """Quadrature of the closed-form kernel of the model's `make_vertical_rate_map`."""
    SAMPLING = enum.auto()
    """Importance sampling of many walks."""


@dataclass(frozen=True)
class ModelCapabilities:
    """Features of the library that one model supports."""

    config_name: str
    """Name of the model in a configuration and on the command line."""
    gait_method: GaitMethod
    """Method that finds the gaits of the model; branches and scans follow from it."""
    commands: frozenset[str]
    """Commands that accept the model: "scan", "map", "tune", "branch" and "explore"."""
    fixed_by_tolerance: tuple[str, ...] | None = None
    """Fields that need their default values if measures are requested to a tolerance. None means
    that the model does not support measures to a tolerance."""
    passage_method: PassageMethod = PassageMethod.SAMPLING
    """Method of `first_passage`."""
    begins_within_step: bool = False
    """Whether the model has `finish_step`, so that a step can be disturbed at any instant."""
