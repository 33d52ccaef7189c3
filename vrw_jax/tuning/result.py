"""A tuned gait, how it was come by, and what holds it there."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

from vrw_jax.results import MEASURES, measure_of
from vrw_jax.runtime import xarray as xr
from vrw_jax.tuning.climbing import Ending
from vrw_jax.tuning.starts import Lanes
from vrw_jax.wheel import Outcome, WheelParams
from vrw_jax.wording import as_html, as_text


class Active(NamedTuple):
    """A constraint or bound that holds the optimum.

    - `name`: of the constraint (with the leg, if it has one), or of the parameter;
    - `limit`: its margin, or the bound;
    - `price`: objective gained per unit of limit given up.
    """

    name: str
    limit: float
    unit: str
    price: float


class Walked(NamedTuple):
    """What walking the tuned wheel showed, from a start displaced a little.

    - `distance`: from the limit cycle after the last step, rad, rad/s and m/s;
    - `kept`: whether every step kept every constraint on a monitor, within 1e-3 of its value and
      1e-2 of its default margin.
    """

    steps: int
    outcome: Outcome
    distance: float
    kept: bool


@dataclasses.dataclass(frozen=True)
class Tuned:
    """A tuned gait, how it was come by, and what holds it there.

    - `params`: the wheel;
    - `ending`: how the climb ended;
    - `objective`, `value`, `start_value`: its name, its value here and at the start;
    - `active`: constraints and bounds that hold the optimum, each with its price;
    - `walked`: what ten steps of the wheel came to;
    - `cycle`: LimitCycle, or WalkedCycle on real ground;
    - `step`: StepResult, or UnilateralStep;
    - `kkt_residual`: of the first-order condition, relative to the objective's gradient;
    - `unkept`: premises that were no constraint and are broken;
    - `path`: every gait that was evaluated, in order;
    - `evaluations`: limit cycles, each with one step;
    - `shortened`: trials that lost the gait or its branch;
    - `seconds`: of which `compile_seconds` went to compiling;
    - `compile_seconds`: and to exploring, if there were many starts;
    - `lanes`: where many starts got to before the climb.

    Examples:
        >>> bounds = {"damping": (100.0, 215.0)}
        >>> tuned = vrw.tune(vrw.WheelParams(), "dls_fraction", ["damping"], bounds)
        >>> print(f"{tuned.params.damping:.1f} N s/m, {bool(tuned.cycle.found)}")
        215.0 N s/m, True
    """

    params: WheelParams
    ending: Ending
    objective: str
    value: float
    start_value: float
    cycle: Any
    step: Any
    active: tuple[Active, ...]
    kkt_residual: float
    unkept: tuple[str, ...]
    walked: Walked
    path: xr.Dataset
    evaluations: int
    shortened: int
    seconds: float
    compile_seconds: float
    lanes: Lanes | None = None

    @property
    def converged(self) -> bool:
        """Whether the climb ended at an optimum."""
        return self.ending == Ending.CONVERGED

    def lines(self) -> dict[str, str]:
        """The result in words, for a reader."""
        free = self.path.attrs["free"].split()
        wheel = [f"{n} {MEASURES[n].text(getattr(self.params, n))}" for n in free]
        kept = "every constraint kept" if self.walked.kept else "a constraint broken"
        kept = kept if self.path.sizes["constraint"] else "no constraint to keep"
        held = [f"{a.name} at {measure_of(a.name).text(a.limit)}" for a in self.active]
        return {
            "objective": f"{self.objective}: {self.start_value:.6g} at the start, {self.value:.6g}",
            "wheel": ", ".join(wheel),
            "ending": f"{self.ending.name}: {self.ending.meaning}",
            "held by": ", ".join(held) or "nothing: a maximum inside all bounds and constraints",
            "not asked for, and broken": ", ".join(self.unkept) or "none",
            "walked": f"{self.walked.steps} steps, {self.walked.outcome.name}, "
            f"{self.walked.distance:.1e} from the cycle at last; {kept}",
            "cost": f"{self.evaluations} gaits, {self.shortened} steps shortened, "
            f"{self.seconds - self.compile_seconds:.2f} s and {self.compile_seconds:.1f} s to "
            "compile",
        }

    def __repr__(self) -> str:
        return as_text("Tuned", self.lines().items())

    def _repr_html_(self) -> str:
        return as_html("Tuned gait", self.lines().items())
