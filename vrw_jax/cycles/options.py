"""Every numerical choice of the search for limit cycles in one visible object."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class CycleOptions:
    """Numerical choices of `limit_cycle`; each change compiles again.

    The defaults reach 1e-9 relative in values and 1e-8 in first derivatives.
    """

    steps: tuple[int, int, int] = (10, 8, 3)  # of order 8 in DLS, SLS-I, SLS-II
    growth: float = 2.0  # last over first step in SLS-I
    tolerance: float = 1e-10  # of Newton's last correction, rad, rad/s, s or m
    iterations: int = 12  # of Newton's method per attempt
    first_iterations: int = 4  # after which a batch gathers the wheels that need more
    stages: int = 12  # of a homotopy from Table 1, where the first attempt fails
    block: int = 64  # wheels that are solved side by side

    def __post_init__(self) -> None:
        for name in ("iterations", "first_iterations", "stages", "block"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, but it must be at least 1.")
        for name in ("growth", "tolerance"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name):g}, but it must be positive.")
        if len(self.steps) != 3 or min(self.steps) < 1:
            raise ValueError(
                f"steps is {self.steps}, but it counts the steps in DLS, SLS-I and SLS-II: "
                "give three whole numbers of at least 1, as (10, 8, 3)."
            )

    @classmethod
    def tight(cls) -> "CycleOptions":
        """Right to about 1e-12 in values and 1e-10 in first derivatives."""
        return cls(steps=(16, 20, 4), tolerance=1e-11)
