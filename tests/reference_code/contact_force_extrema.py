"""Extrema of normal forces in a step of the second formulation of unilateral contact.

The force in each interval between two events is a Chebyshev polynomial through values of the
second formulation. The code is independent of the library.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev
from scipy.integrate import solve_ivp

from reference_code import complementarity

N = complementarity.N
N_COEFFICIENTS = 60
"""Chebyshev coefficients of the force between two events: the last ones are round-off."""


class Extrema(NamedTuple):
    """Smooth extrema of a force in one step, in the order of time."""

    forces: np.ndarray  # N
    is_maximum: np.ndarray
    rate_maxima_after_peak: np.ndarray  # maxima of the force's rate after the first maximum, N/s
    largest_force: float  # in the step, at an extremum or at an end of an interval, N

    def compute_trough_depth(self) -> float:
        """Return the largest depth of a minimum below the lower of two maxima around it, N."""
        peaks = np.where(self.is_maximum, self.forces, -np.inf)
        depths = [
            min(peaks[:i].max(initial=-np.inf), peaks[i:].max()) - self.forces[i]
            for i in np.flatnonzero(~self.is_maximum)
        ]
        return max([0.0, *depths])


def make_start(x: np.ndarray) -> complementarity.HybridState:
    """Return the state just before the landing from a full section state of the library.

    The section state is (theta, dtheta, hub velocity, lengths, rates, codes of contact) in the
    legs' labels of the step that ends.
    """
    lengths, rates, codes = (np.roll(part, 1) for part in np.split(x[4:], 3))
    theta = x[0] - complementarity.ALPHA
    codes = np.round(codes).astype(int)
    return complementarity.HybridState(
        np.r_[lengths[0] * np.sin(theta), lengths[0] * np.cos(theta), theta, lengths],
        np.r_[x[2:4], x[1], rates],
        tuple(codes % 4),
        tuple(codes >= 4),
    )


def compute_landing_impulse(
    wheel: complementarity.ComplementarityWheel,
    place: complementarity.HybridState,
    after: complementarity.HybridState,
) -> float:
    """Return the normal impulse on the foot that lands, N s, from the jump of all momenta."""
    mass, _ = complementarity._mass_and_force(wheel, place.q, place.v)
    rows, _ = complementarity._points(place.q, place.v, place.q[3:])
    feet = [j for j in range(N) if after.mode[j] or place.mode[j] or j == 0]
    legs = [j for j in range(N) if after.is_locked[j]]
    directions = np.vstack([*(rows[j] for j in feet), complementarity._locked_rows(legs)])
    impulses = np.linalg.lstsq(directions.T, mass @ (after.v - place.v), rcond=None)[0]
    assert np.allclose(directions.T @ impulses, mass @ (after.v - place.v), atol=1e-9)
    return impulses[2 * feet.index(0) + 1]


def find_inner_roots(polynomial: Chebyshev) -> np.ndarray:
    """Return the real roots inside the polynomial's domain, in ascending order."""
    roots = polynomial.roots()
    roots = np.sort(roots[np.abs(roots.imag) < 1e-9].real)
    return roots[(roots > polynomial.domain[0]) & (roots < polynomial.domain[1])]


def find_extrema(polynomials: list[Chebyshev]) -> Extrema:
    """Return the extrema of a force that is one polynomial of time in each interval."""
    forces, maxima, later_rates = [], [], []
    for force in polynomials:
        times = find_inner_roots(force.deriv())
        is_maximum = force.deriv(2)(times) < 0.0
        rate_times = find_inner_roots(force.deriv(2))
        rate_times = rate_times[force.deriv(3)(rate_times) < 0.0]
        first_peak = -np.inf if any(maxima) else min(times[is_maximum], default=np.inf)
        later_rates += force.deriv()(rate_times[rate_times > first_peak]).tolist()
        forces += force(times).tolist()
        maxima += is_maximum.tolist()
    largest = max(*forces, *(force(np.array(force.domain)).max() for force in polynomials))
    return Extrema(np.array(forces), np.array(maxima, bool), np.array(later_rates), largest)


def find_step_extrema(
    wheel: complementarity.ComplementarityWheel, start: complementarity.HybridState
) -> tuple[Extrema, Extrema, float]:
    """Return the extrema of the fore foot's force and of the total force, and the first impulse.

    The step begins with the landing at `start`. The impulse is the normal impulse on the fore foot
    in this landing, N s.
    """
    place, struck, polynomials, landing_impulse = start, ("gap", 0), [], None
    while struck != ("gap", N - 1):
        name, j = struck
        foot, leg = (j if name == "gap" else None), (j if name == "room" else None)
        before = place
        place, _ = complementarity._process_event(wheel, place, foot, leg)
        if landing_impulse is None:
            landing_impulse = compute_landing_impulse(wheel, before, place)
        duration, y, struck = complementarity._integrate_to_event(wheel, place)
        solve = lambda y, place=place: complementarity._solve_contact_forces(
            wheel, y[:11], y[11:], place.mode, place.is_locked
        )
        motion = solve_ivp(
            lambda _, y, solve=solve: np.r_[y[11:], solve(y)[0]],
            (0.0, duration), np.r_[place.q, place.v],
            method="DOP853", rtol=1e-13, atol=1e-13, max_step=4e-3, dense_output=True,
        ).sol  # fmt: skip
        angles = np.pi * (np.arange(N_COEFFICIENTS) + 0.5) / N_COEFFICIENTS
        nodes = 0.5 * duration * (1.0 - np.cos(angles))
        normals = np.array([solve(motion(t))[1][:, 1] for t in nodes])
        polynomials.append(
            [
                Chebyshev.fit(nodes, force, N_COEFFICIENTS - 1, domain=[0.0, duration])
                for force in (normals[:, 0], normals.sum(1))
            ]
        )
        place = place._replace(q=y[:11].copy(), v=y[11:].copy())
        complementarity._project_to_constraints(wheel, place)
    fore, total = map(list, zip(*polynomials, strict=True))
    fore = [force for force in fore if np.any(force.coef)]
    return find_extrema(fore), find_extrema(total), landing_impulse
