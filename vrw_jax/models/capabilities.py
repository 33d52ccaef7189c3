"""Features of the library that each model supports.

Each model declares its features, and other packages read these declarations.
"""

import enum
from dataclasses import dataclass


class GaitMethod(enum.StrEnum):
    """Methods for gait search, continuation and scans with a model."""

    COLLOCATION = enum.auto()
    """Newton's method for all states of the cycle at once, with a fixed sequence of phases."""
    CONTACT_WALKS = enum.auto()
    """Simulated walks that settle on a gait, then Newton's method for the return map with fixed
    contact modes.
    """
    RETURN_MAP = enum.auto()
    """Newton's method for the return map."""
    SELECTION = enum.auto()
    """The method of whichever model is selected for each wheel."""


class PassageMethod(enum.StrEnum):
    """Methods that compute mean first-passage times on uneven ground with a model."""

    QUADRATURE = enum.auto()
    """Quadrature with the closed-form transition kernel from the model's
    `make_vertical_rate_map`.
    """
    SAMPLING = enum.auto()
    """Importance sampling with many simulated walks."""


@dataclass(frozen=True)
class ModelCapabilities:
    """Features of the library that one model supports."""

    config_name: str
    """Name of the model in a configuration and on the command line."""
    gait_method: GaitMethod
    """Method of the gait search with this model; it determines the methods of branches and
    scans.
    """
    accepted_cli_commands: frozenset[str]
    """Commands that accept the model: "scan", "map", "tune", "branch" and "explore"."""
    fields_with_fixed_defaults: tuple[str, ...] | None = None
    """Fields that must have their default values for a measure requested to a tolerance. None means
    that the model does not support measures to a tolerance.
    """
    passage_method: PassageMethod = PassageMethod.SAMPLING
    """Method that `first_passage` uses with this model."""
    supports_uneven_ground: bool = True
    """Whether the slope may change from step to step of a walk."""
    can_start_within_gait_step: bool = False
    """Whether the model implements `finish_step`, so that a step can be disturbed at any
    instant.
    """
