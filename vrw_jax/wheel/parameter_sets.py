"""Named sets of wheel parameters, each with its source."""

from dataclasses import dataclass, field
from types import MappingProxyType

from vrw_jax.wheel.params import WheelParams


@dataclass(frozen=True)
class ParameterSet:
    """Named set of wheel parameters. A parameter that the set does not list has its value in Table
    1 of the paper.

    - `values`: parameters that differ from Table 1 of the paper at slope 0.30 rad, in SI units;
    - `description`: property of the wheel that the set illustrates;
    - `source`: source of the values, and of their confirmation.

    Examples:
        >>> two_peaks = vrw.parameter_sets["two_peaks"]
        >>> float(two_peaks.params.stiffness), two_peaks.description
        (2500.0, 'walks with two peaks of the vertical ground reaction force')
    """

    values: dict[str, float] = field(hash=False)
    description: str
    source: str

    @property
    def params(self) -> WheelParams:
        """Return a wheel with the parameters of this set."""
        return WheelParams(**self.values)  # type: ignore[arg-type]


_STUDY_SOURCE = (
    "study of force peaks of this library; period, share of double support and peak forces were "
    "confirmed by an independent code of five constrained coordinates"
)

parameter_sets = MappingProxyType(
    {
        "table_1": ParameterSet(
            {},
            "walks with one force peak; legs are soft and overdamped, the slope is steep",
            "Table 1 of the paper at phi = 0.30 rad, the slope of its Fig. 10; g = 9.81 m/s^2",
        ),
        "two_peaks": ParameterSet(
            {"stiffness": 2500.0, "damping": 100.0, "natural_length": 1.0, "slope": 0.075},
            "walks with two peaks of the vertical ground reaction force",
            _STUDY_SOURCE,
        ),
        "two_peaks_light_damping": ParameterSet(
            {"stiffness": 2000.0, "damping": 50.0, "natural_length": 1.0, "slope": 0.05},
            "walks with two force peaks and 18 % double support; legs are lightly damped",
            _STUDY_SOURCE,
        ),
        "two_peaks_soft": ParameterSet(
            {"stiffness": 1500.0, "damping": 75.0, "natural_length": 1.0, "slope": 0.06},
            "walks with two force peaks and 22 % double support; legs are softer",
            _STUDY_SOURCE,
        ),
    }
)
"""Parameter sets by name, as in `vrw.parameter_sets["two_peaks"].params`. In the table `[wheel]` of
a configuration, write `parameter_set = "two_peaks"`.
"""
