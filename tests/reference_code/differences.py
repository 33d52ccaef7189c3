"""Central differences in multiprecision, and the little algebra of a plane map."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import mpmath as mp

from .multiprecision import Number, Vector

Function = Callable[[Sequence[Number]], Vector]


class Stencil:
    """First and second central differences of a vector function about a point.

    ``sizes`` are the steps of each argument. Second differences with respect to two arguments
    need two evaluations beside those of the first ones.
    """

    def __init__(self, function: Function, point: Vector, sizes: Vector) -> None:
        """Evaluate at the point and one step to either side along each argument."""
        self.function, self.point, self.sizes = function, list(point), list(sizes)
        self.value = function(point)
        self._sides = {
            (i, s): self._evaluate_at({i: s}) for i in range(len(point)) for s in (1, -1)
        }

    def _evaluate_at(self, moves: Mapping[int, int]) -> Vector:
        point = list(self.point)
        for i, sign in moves.items():
            point[i] = point[i] + sign * self.sizes[i]
        return self.function(point)

    def first(self, i: int) -> Vector:
        """Derivative by argument i."""
        up, down = self._sides[i, 1], self._sides[i, -1]
        return [(a - b) / (2 * self.sizes[i]) for a, b in zip(up, down, strict=True)]

    def second(self, i: int, j: int) -> Vector:
        """Derivative by arguments i and j."""
        sides = [self._sides[i, 1], self._sides[i, -1]]
        if i == j:
            return [
                (a + b - 2 * f) / self.sizes[i] ** 2
                for a, b, f in zip(*sides, self.value, strict=True)
            ]
        sides += [self._sides[j, 1], self._sides[j, -1]]
        corners = [self._evaluate_at({i: s, j: s}) for s in (1, -1)]
        scale = 2 * self.sizes[i] * self.sizes[j]
        return [
            (a + b - mp.fsum(rest) + 2 * f) / scale
            for a, b, f, *rest in zip(*corners, self.value, *sides, strict=True)
        ]


def spectrum(matrix: list[Vector]) -> tuple[list[Number], Number, Callable[[list[Vector]], Number]]:
    """Eigenvalues of a 2 x 2 matrix, spectral radius, and the latter's derivative."""
    (a, b), (c, d) = matrix
    trace, determinant = a + d, a * d - b * c
    discriminant = trace**2 - 4 * determinant
    root = mp.sqrt(discriminant)
    values = sorted([(trace + root) / 2, (trace - root) / 2], key=lambda v: -abs(v))
    radius = abs(values[0])

    def derivative(rate: list[Vector]) -> Number:
        d_trace = rate[0][0] + rate[1][1]
        d_determinant = rate[0][0] * d + a * rate[1][1] - rate[0][1] * c - b * rate[1][0]
        if discriminant < 0:
            return d_determinant / (2 * radius)
        leading = values[0]
        slope = (leading * d_trace - d_determinant) / (2 * leading - trace)
        return slope * mp.sign(leading)

    return values, radius, derivative


def solve_two(matrix: list[Vector], right: Vector) -> Vector:
    """Solution of a 2 x 2 system."""
    (a, b), (c, d) = matrix
    determinant = a * d - b * c
    return [
        (right[0] * d - b * right[1]) / determinant,
        (a * right[1] - c * right[0]) / determinant,
    ]


def subtract_identity(matrix: list[Vector]) -> list[Vector]:
    """I - A for a 2 x 2 matrix."""
    return [[(1 if i == j else 0) - matrix[i][j] for j in range(2)] for i in range(2)]


def compute_gap(solution: Sequence[Number], expected: Sequence[Number]) -> Number:
    """Largest difference relative to the larger of the two vectors' greatest entry."""
    scale = max(abs(v) for v in expected)
    return max(abs(a - b) for a, b in zip(solution, expected, strict=True)) / scale


def plane_jacobian(function: Function, y: Vector, p: Vector, size: Number) -> list[Vector]:
    """Jacobian (2 x 2) of the plane map by y."""
    columns = []
    for i in range(2):
        ends = []
        for sign in (1, -1):
            shifted = list(y)
            shifted[i] = shifted[i] + sign * size
            ends.append(function([*shifted, *p]))
        columns.append([(a - b) / (2 * size) for a, b in zip(*ends, strict=True)])
    return [[columns[j][i] for j in range(2)] for i in range(2)]
