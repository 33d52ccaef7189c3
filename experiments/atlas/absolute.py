"""The slider–crank with play in nine absolute coordinates, 40 digits: its case's reference.

    python -m experiments.atlas.absolute

Three bodies with their middles' places and angles, six equations of joints, and one for each corner
in contact; forces of joints and corners are multipliers. Steps of the midpoint rule, extrapolated;
an event is Newton's on the last step's length. Nothing is shared with cases/slider_crank but the
numbers of the mechanism. Prints what `REFERENCE` there holds; minutes.
"""

from collections.abc import Callable
from typing import NamedTuple

from mpmath import cos, mp, mpf, sin

from experiments.atlas.cases import slider_crank as given
from experiments.shared.command import make_parser, parse_and_start_jax

Row = list  # of mpf
LEVELS, STEP = 11, mpf("2e-4")
"""Extrapolated steps of 2, 4, ... substeps; their length, s."""
STEP_TOLERANCE = mpf("1e-26")


def exact(*numbers: float) -> list:
    """Return decimal literals as exact numbers, without the rounding of 64-bit floats."""
    return [mpf(repr(x)) for x in numbers]


def solve(matrix: list[Row], right: Row) -> Row:
    """Solve a linear system by Gaussian elimination with pivots."""
    rows = [[*row, x] for row, x in zip(matrix, right, strict=True)]
    n = len(rows)
    for i in range(n):
        pivot = max(range(i, n), key=lambda k: abs(rows[k][i]))
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for k in range(i + 1, n):
            factor = rows[k][i] / rows[i][i]
            if factor:
                rows[k] = [x - factor * y for x, y in zip(rows[k], rows[i], strict=True)]
    result = [mpf(0)] * n
    for i in reversed(range(n)):
        result[i] = (rows[i][n] - sum(rows[i][k] * result[k] for k in range(i + 1, n))) / rows[i][i]
    return result


class Mechanism:
    """Places q = (x, y, angle) of crank, rod and slider, then their rates."""

    def __init__(self) -> None:
        self.crank, self.rod, self.half, self.height, self.play = exact(
            given.CRANK, given.ROD, given.HALF, given.HEIGHT, given.PLAY
        )
        masses = exact(given.CRANK_MASS, given.ROD_MASS, given.SLIDER_MASS)
        inertias = exact(given.CRANK_INERTIA, given.ROD_INERTIA, given.SLIDER_INERTIA)
        self.mass = [x for m, j in zip(masses, inertias, strict=True) for x in (m, m, j)]
        self.gravity, self.restitution, self.friction = exact(
            given.GRAVITY, given.RESTITUTION_COEFFICIENT, given.FRICTION
        )
        self.weight = [mpf(0)] * 9
        for i in (1, 4, 7):
            self.weight[i] = -self.gravity * self.mass[i]

    def start(self) -> Row:
        a, b = mpf(0), mpf(0)
        first, second = exact(*given.RATES)
        l1, l2 = self.crank, self.rod
        pin = (l1 * cos(a), l1 * sin(a))
        speed = (-l1 * sin(a) * first, l1 * cos(a) * first)
        places = [pin[0] / 2, pin[1] / 2, a]
        places += [pin[0] + l2 * cos(b) / 2, pin[1] + l2 * sin(b) / 2, b]
        places += [pin[0] + l2 * cos(b), pin[1] + l2 * sin(b), mpf(0)]
        rates = [speed[0] / 2, speed[1] / 2, first]
        rates += [speed[0] - l2 * sin(b) * second / 2, speed[1] + l2 * cos(b) * second / 2, second]
        rates += [speed[0] - l2 * sin(b) * second, speed[1] + l2 * cos(b) * second, mpf(0)]
        return places + rates

    def joints(self, y: Row) -> tuple[list[Row], Row]:
        """Return the Jacobian of the gaps of the joints, and their curvature terms."""
        rows, bends = [], []
        ends = ((None, 0), (0, 1), (1, 2))  # each joint: the end of one body, the start of the next
        lengths = (self.crank / 2, self.rod / 2, mpf(0))
        for before, after in ends:
            for axis in (0, 1):
                row, bend = [mpf(0)] * 9, mpf(0)
                for body, sign in ((before, 1), (after, -1)):
                    if body is None:
                        continue
                    angle, rate = y[3 * body + 2], y[3 * body + 11]
                    reach = lengths[body]  # of its end, or start, from its middle
                    row[3 * body + axis] += sign
                    direction_cosine = cos(angle) if axis == 0 else sin(angle)
                    transverse_part = -sin(angle) if axis == 0 else cos(angle)
                    row[3 * body + 2] += reach * transverse_part
                    bend -= reach * direction_cosine * rate * rate
                rows.append(row)
                bends.append(bend)
        return rows, bends

    def corners(self, y: Row, face: int) -> tuple[Row, list[Row], list[Row], Row]:
        """Return gaps, rates, sliding forces and curvature terms of both corners of a face."""
        angle, rate = y[8], y[17]
        gaps, normals, pushes, bends = [], [], [], []
        for transverse_part in (-self.half, self.half):
            up = face * self.height
            level = y[7] + transverse_part * sin(angle) + up * cos(angle)
            turn = transverse_part * cos(angle) - up * sin(angle)
            gaps.append(self.height + self.play - face * level)
            normals.append([mpf(0)] * 7 + [mpf(-face), -face * turn])
            ahead = -transverse_part * sin(angle) - up * cos(angle)
            pushes.append(
                [mpf(0)] * 6 + [self.friction, mpf(-face), -face * turn + self.friction * ahead]
            )
            bends.append(-face * (-transverse_part * sin(angle) - up * cos(angle)) * rate * rate)
        return gaps, normals, pushes, bends

    def solve_constraints(
        self, y: Row, face: int, bare: Row, joints: Row, corners: Row
    ) -> tuple[Row, Row]:
        """Return changes that satisfy the joints and the corners of `face` (0 for none), and the
        forces.
        """
        rows, _ = self.joints(y)
        forces = list(rows)
        wanted = list(joints)
        if face:
            _, normals, pushes, _ = self.corners(y, face)
            rows, forces, wanted = rows + normals, forces + pushes, wanted + list(corners)
        product = lambda a, b: sum(p * q / m for p, q, m in zip(a, b, self.mass, strict=True) if p)
        matrix = [[product(row, force) for force in forces] for row in rows]
        right = [w - product(row, bare) for w, row in zip(wanted, rows, strict=True)]
        sizes = solve(matrix, right)
        total = list(bare)
        for size, force in zip(sizes, forces, strict=True):
            total = [x + size * f for x, f in zip(total, force, strict=True)]
        return [x / m for x, m in zip(total, self.mass, strict=True)], sizes[6:]

    def field(self, y: Row, face: int) -> tuple[Row, Row]:
        """Return the derivatives of positions and rates, and the normal forces of the corners of a
        face.
        """
        bends = [-bend for bend in self.joints(y)[1]]
        open_ = [-bend for bend in self.corners(y, face)[3]] if face else []
        rates, sizes = self.solve_constraints(y, face, self.weight, bends, open_)
        return y[9:] + rates, sizes

    def apply_impact(self, y: Row, face: int, restitution: mpf) -> tuple[Row, Row]:
        """Past an impact of both corners, and their impulses."""
        _, normals, _, _ = self.corners(y, face)
        rates = [sum(n * v for n, v in zip(normal, y[9:], strict=True)) for normal in normals]
        jumps, sizes = self.solve_constraints(
            y, face, [mpf(0)] * 9, [mpf(0)] * 6, [-(1 + restitution) * rate for rate in rates]
        )
        return y[:9] + [v + jump for v, jump in zip(y[9:], jumps, strict=True)], sizes


def extrapolate_step(field: Callable[[Row], Row], y: Row, length: mpf) -> Row:
    """Advance one step by the midpoint rule with 2, 4, ... substeps and extrapolation."""
    table: list[Row] = []
    first = field(y)
    for level in range(1, LEVELS + 1):
        n = 2 * level
        h = length / n
        before, state = y, [a + h * b for a, b in zip(y, first, strict=True)]
        for _ in range(n - 1):
            rate = field(state)
            before, state = (
                state,
                [a + 2 * h * b for a, b in zip(before, rate, strict=True)],
            )
        rate = field(state)
        entry = [(a + b + h * c) / 2 for a, b, c in zip(before, state, rate, strict=True)]
        line = [entry]
        for k in range(1, level):
            ratio = (mpf(level) / (level - k)) ** 2 - 1
            pairs = zip(line[k - 1], table[k - 1], strict=True)
            line.append([a + (a - b) / ratio for a, b in pairs])
        gap = max(abs(a - b) for a, b in zip(line[-1], table[-1], strict=True)) if table else 1
        table = line
        if gap < STEP_TOLERANCE:
            return table[-1]
    raise ArithmeticError(f"the step of {length} s is off by {gap}")


class EventState(NamedTuple):
    time: mpf
    state: Row


def integrate_until(field: Callable, value: Callable, y: Row, length: mpf) -> EventState:
    """To where `value` falls to zero: steps, then the secant rule, away from where a step began."""
    time = mpf(0)
    while True:
        after = extrapolate_step(field, y, length)
        if value(after) <= 0:
            break
        y, time = after, time + length
    near = mpf("0.9") * length
    low, high = (near, value(extrapolate_step(field, y, near))), (length, value(after))
    for _ in range(60):
        root = high[0] - high[1] * (high[0] - low[0]) / (high[1] - low[1])
        if abs(root - high[0]) < STEP_TOLERANCE * STEP:
            break
        low, high = high, (root, value(extrapolate_step(field, y, root)))
        if low[1] == high[1]:
            break
    return EventState(time + root, extrapolate_step(field, y, root))


def simulate_bounces(bounces: int = 60) -> dict[str, mpf]:
    """Return event times (s), the angular rate of the crank, and both impulses of the first
    impact.
    """
    mechanism, result = Mechanism(), {}
    flight = lambda y: mechanism.field(y, 0)[0]
    above = lambda y: mechanism.corners(y, 1)[0][0]
    event = integrate_until(flight, above, mechanism.start(), STEP)
    time, y = event.time, event.state
    result["first impact"] = time
    y, sizes = mechanism.apply_impact(y, 1, mechanism.restitution)
    result["crank's rate after it"] = y[11]
    result["impulse behind"], result["impulse ahead"] = sizes
    for bounce in range(2, bounces + 1):
        rate, bend = -y[16], -flight(y)[16]  # of the gap: the slider does not turn
        length = -2 * rate / bend
        event = integrate_until(flight, above, y, min(length * mpf("1.02"), STEP))
        time, y = time + event.time, event.state
        y, _ = mechanism.apply_impact(y, 1, mechanism.restitution)
        if bounce == 2:
            result["second impact"] = time
        if event.time < mpf("1e-20"):
            break
    result["end of the bounces"] = time
    result["crank's rate there"] = y[11]
    y, _ = mechanism.apply_impact(y, 1, mpf(0))
    slide = lambda y: mechanism.field(y, 1)[0]
    event = integrate_until(slide, lambda y: min(mechanism.field(y, 1)[1]), y, STEP)
    time, y = time + event.time, event.state
    result["letting go"] = time
    event = integrate_until(flight, lambda y: mechanism.corners(y, -1)[0][0], y, STEP)
    result["touch of the other face"] = time + event.time
    result["crank's rate at it"] = event.state[11]
    return result


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    mp.dps = 40
    for name, number in simulate_bounces().items():
        print(f"{name}: {mp.nstr(number, 22)}", flush=True)


if __name__ == "__main__":
    main()
