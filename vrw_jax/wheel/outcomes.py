"""How a step can end: one integer code per lane, with a name and a sentence."""

import enum


class Outcome(enum.IntEnum):
    """How a step ended. Only STEPPED leaves a section state; the others end the walk."""

    STEPPED = 0
    TOUCHDOWN_BEFORE_STOPPER = 1
    STOPPER_IN_DOUBLE_SUPPORT = 2
    FELL_BACK = 3
    COLLAPSED = 4
    LEG_1_LIFTED_OFF = 5
    NO_TOUCHDOWN_IN_TIME = 6
    SOLVER_GAVE_UP = 7
    BAD_INPUT = 8
    NO_CYCLE_FOUND = 9
    TOO_MANY_EVENTS = 10
    NO_ADMISSIBLE_CONTACT = 11
    THREE_FEET_LOADED = 12
    MESH_TOO_COARSE = 13
    ORDER_DIFFERS = 14

    @property
    def meaning(self) -> str:
        """One sentence for a reader."""
        return _MEANINGS[self]


_MEANINGS = {
    Outcome.STEPPED: "The wheel stepped from touchdown to touchdown in the paper's sequence.",
    Outcome.TOUCHDOWN_BEFORE_STOPPER: (
        "The next foot met the ground before Leg 2 was back at its stopper."
    ),
    Outcome.STOPPER_IN_DOUBLE_SUPPORT: (
        "Leg 2 reached its stopper while its foot was still on the ground."
    ),
    Outcome.FELL_BACK: "The wheel stopped rolling forward and would fall back.",
    Outcome.COLLAPSED: "A loaded leg collapsed to where its mass meets the hub: the wheel fell.",
    Outcome.LEG_1_LIFTED_OFF: "The ground would have to pull on Leg 1's foot: it lifts off.",
    Outcome.NO_TOUCHDOWN_IN_TIME: "No touchdown came within the allowed time of one phase.",
    Outcome.SOLVER_GAVE_UP: "The integrator ran out of steps or could not locate an event.",
    Outcome.BAD_INPUT: "A parameter or the start is not finite, or outside its domain.",
    Outcome.NO_CYCLE_FOUND: (
        "The search for a limit cycle did not converge: there may be one that it missed."
    ),
    Outcome.TOO_MANY_EVENTS: "Contacts and stoppers changed more often than one step may.",
    Outcome.NO_ADMISSIBLE_CONTACT: (
        "No combination of contact modes satisfies Coulomb's law (a Painlevé paradox)."
    ),
    Outcome.THREE_FEET_LOADED: "Three feet would have to carry load at once.",
    Outcome.MESH_TOO_COARSE: (
        "A cycle solves the equations, but the mesh is too coarse for it: give more steps."
    ),
    Outcome.ORDER_DIFFERS: (
        "A cycle solves the equations, but its events do not come in the paper's order."
    ),
}
