"""Outcomes of a step, of a walk and of a search for a gait."""

from typing import Any

from vrw_jax.base.printing import (
    StatusCode,
    describe_step_ending,
    format_each_batch_element,
)


class NoGaitError(ValueError):
    """Error of a computation that needs a gait, for a wheel or walker that has none."""


class Outcome(StatusCode):
    """Outcome of a step. Only a step with the outcome STEPPED ends in a section state. Every other
    outcome ends the walk.

    Examples:
        >>> vrw.Outcome.FELL_BACK.meaning
        'The wheel stopped rolling forward and would fall back.'
        >>> vrw.Outcome(0).name
        'STEPPED'
    """

    STEPPED = 0, "The wheel stepped from touchdown to touchdown."
    TOUCHDOWN_BEFORE_STOPPER = (
        1, "The next foot met the ground before Leg 2 was back at its stopper."
    )  # fmt: skip
    STOPPER_IN_DOUBLE_SUPPORT = (
        2, "Leg 2 reached its stopper while its foot was still on the ground."
    )  # fmt: skip
    FELL_BACK = 3, "The wheel stopped rolling forward and would fall back."
    COLLAPSED = 4, "A loaded leg collapsed to where its mass meets the hub: the wheel fell."
    LEG_1_LIFTED_OFF = 5, "The ground would have to pull on Leg 1's foot: it lifts off."
    NO_TOUCHDOWN_IN_TIME = 6, "No touchdown came within the allowed time of one phase."
    SOLVER_FAILED = 7, "The integrator ran out of steps or could not locate an event."
    BAD_INPUT = 8, "A parameter or the start is not finite, or outside its domain."
    NO_CYCLE_FOUND = (
        9, "The search for a limit cycle did not converge: there may be one that it missed."
    )  # fmt: skip
    TOO_MANY_EVENTS = 10, "Contacts and stoppers changed more often than one step may."
    NO_ADMISSIBLE_CONTACT = (
        11, "No combination of contact modes was found that satisfies Coulomb's law in an impact."
    )  # fmt: skip
    THREE_FEET_LOADED = 12, "Three feet would have to carry load at once."
    MESH_TOO_COARSE = (
        13, "A cycle solves the equations, but the mesh is too coarse: give more intervals."
    )  # fmt: skip
    EVENT_ORDER_MISMATCH = (
        14, "A cycle solves the equations, but its events do not come in the paper's order."
    )  # fmt: skip
    BRANCH_ENDS_BEFORE_TARGET = (
        16, "No cycle was found; followed from Table 1 to this wheel, the gait ends on the way."
    )  # fmt: skip
    PAINLEVE_PARADOX = (
        15, "Friction is so high that no forces can carry the motion on (Painlevé's paradox)."
    )  # fmt: skip
    CAME_TO_REST = 17, "The wheel came to rest: it neither rolls on nor falls back."
    GUARD_VIOLATED = (
        18, "One of the guards was negative when its mode began, for example after a fall."
    )  # fmt: skip
    ENDED_BY_GUARD = 19, "A guard that ends walks has fallen to zero, for example at a fall."


def describe_outcomes(outcomes: Any, section: str = "") -> Any:
    """Return the sentence on an outcome, or an array of sentences for a batch.

    - `section`: name of the section of a walker of the user, which takes the place of a touchdown.
    """
    sentences = describe_step_ending(outcomes, Outcome)
    if not section:
        return sentences
    name_section = lambda x: x.replace("touchdown", section).replace("The wheel", "The walker")
    return format_each_batch_element(name_section, sentences)
