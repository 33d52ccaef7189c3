"""Derive the paper's five-coordinate equations from the Lagrangian and write them out as code.

The wheel is a set of point masses: the hub, the masses of Leg 1 and Leg 2, and those of the
n - 2 locked legs. Their positions are written down in the coordinates q = (x, z, theta, L1, L2)
of Section 3.2; everything else (mass matrix, h, the contact Jacobian of eq. (11), its rate) is
obtained by differentiation, so that no formula of the paper, misprinted or not, enters.

Run ``python tests/reference_code/derive_five_coordinates.py`` to rewrite
``five_coordinates_equations.py`` beside this file; ``--check`` only says whether it is current.
"""

# ruff: noqa: N816  (the paper's symbols)

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import sympy as sp

TARGET = Path(__file__).with_name("five_coordinates_equations.py")

Q = x, z, theta, L1, L2 = sp.symbols("x z theta L1 L2", real=True)
V = dx, dz, dtheta, dL1, dL2 = sp.symbols("dx dz dtheta dL1 dL2", real=True)
W = ddx, ddz, ddtheta, ddL1, ddL2 = sp.symbols("ddx ddz ddtheta ddL1 ddL2", real=True)
# Wheel constants in the order in which the generated functions unpack them. C and S are the sums
# of cos and sin of the angles (j - 1) alpha of the locked legs j = 3..n, counted in n_locked.
P = mH, m, a, L0, phi, g, alpha, n_locked, C, S = sp.symbols(
    "mH m a L0 phi g alpha n_locked C S", real=True
)

HEADER = '''"""Equations of motion of the wheel in q = (x, z, theta, L1, L2).

Written by ``derive_five_coordinates.py`` from the Lagrangian; do not edit by hand. The arguments
are q, v = q', w = q'' (m, rad, s) and p = (mH, m, a, L0, phi, g, alpha, n_locked, C, S), where C
and S are the sums of cos and sin of (j - 1) alpha over the locked legs j = 3..n. Any numbers that
add, multiply and come with a sine and a cosine will do: floats, multiprecision, symbols.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

Numbers = Iterable[Any]
'''


def rate(expression: sp.Expr) -> sp.Expr:
    """Total time derivative of an expression in q and q'."""
    return sum(
        (sp.diff(expression, c) * v for c, v in zip(Q, V, strict=True)), sp.Integer(0)
    ) + sum((sp.diff(expression, v) * w for v, w in zip(V, W, strict=True)), sp.Integer(0))


def direction(angle: sp.Expr) -> sp.Matrix:
    """Unit vector from foot to hub of a leg at this angle from the slope's normal."""
    return sp.Matrix([sp.sin(angle), sp.cos(angle)])


def speed_squared(point: sp.Matrix) -> sp.Expr:
    """Square of the speed of a point given by its position."""
    velocity = point.applyfunc(rate)
    return (velocity.T * velocity)[0]


def derive() -> dict[str, tuple[str, sp.Matrix]]:
    """Every emitted quantity: name -> (docstring, matrix of expressions)."""
    hub = sp.Matrix([x, z]) + L1 * direction(theta)
    foot2 = hub - L2 * direction(theta + alpha)
    down = g * sp.Matrix([sp.sin(phi), -sp.cos(phi)])

    movable = [(mH, hub), (m, sp.Matrix([x, z]) + a * direction(theta))]
    movable.append((m, foot2 + a * direction(theta + alpha)))
    kinetic = sum((mass * speed_squared(point) / 2 for mass, point in movable), sp.Integer(0))
    potential = -sum((mass * (point.T * down)[0] for mass, point in movable), sp.Integer(0))

    # One locked leg at theta + beta; its energies are affine in (1, cos beta, sin beta), so the
    # sum over the locked legs replaces these by (n_locked, C, S).
    beta = sp.Symbol("beta", real=True)
    locked = hub - (L0 - a) * direction(theta + beta)

    def summed(one: sp.Expr) -> sp.Expr:
        one = sp.expand(sp.expand_trig(sp.expand(one)))
        one = sp.expand(one.subs(sp.sin(beta) ** 2, 1 - sp.cos(beta) ** 2))
        parts = sp.Poly(one, sp.cos(beta), sp.sin(beta))
        total = sp.Integer(0)
        for (i, j), coefficient in parts.terms():
            if i + j > 1:
                assert sp.simplify(coefficient) == 0, (i, j)
                continue
            total += coefficient * (C if i else S if j else n_locked)
        return total

    kinetic += summed(m * speed_squared(locked) / 2)
    potential += summed(-m * (locked.T * down)[0])

    mass_matrix = sp.hessian(kinetic, V).applyfunc(sp.simplify)
    momentum = sp.Matrix([sp.diff(kinetic, v) for v in V])
    bias = sp.Matrix(
        [
            rate(momentum[i]).subs(dict.fromkeys(W, 0))
            - sp.diff(kinetic, Q[i])
            + sp.diff(potential, Q[i])
            for i in range(5)
        ]
    ).applyfunc(sp.simplify)
    feet = sp.Matrix([x, z, *foot2])
    jacobian = feet.jacobian(Q).applyfunc(sp.simplify)
    curvature = feet.applyfunc(rate).applyfunc(rate).subs(dict.fromkeys(W, 0))
    hub_velocity = hub.applyfunc(rate)
    return {
        "mass_matrix": ("Mass matrix M(q) of eq. (1).", mass_matrix),
        "bias": ("h(q, q', phi) of eq. (1): Coriolis, centrifugal and gravity terms.", bias),
        "jacobian": ("Contact Jacobian J_DLS(q) of eq. (11), J43 as it must be.", jacobian),
        "jacobian_rate": ("J_DLS'(q, q') q' of eq. (4), m/s^2.", curvature),
        "energies": (
            "Kinetic energy and potential energy of gravity, J.",
            sp.Matrix([kinetic, potential]),
        ),
        "feet": ("Positions x1, z1, x2, z2 of both feet, m.", feet),
        "hub": ("Position of the hub, m.", hub),
        "hub_velocity": ("Velocity of the hub, m/s.", hub_velocity),
        "hub_acceleration": ("Acceleration of the hub, m/s^2.", hub_velocity.applyfunc(rate)),
    }


def emit(name: str, docstring: str, value: sp.Matrix) -> str:
    """One Python function that returns the matrix as a list (vectors) or a list of rows."""
    names: Sequence[sp.Symbol] = sorted(value.free_symbols, key=str)
    used = set(names)
    arguments = ["q"]
    if used & set(V) or used & set(W):
        arguments.append("v")
    if used & set(W):
        arguments.append("w")
    # p always travels, so that all functions are called alike.
    lines = [
        f"def {name}(",
        *(f"    {argument}: Numbers," for argument in [*arguments, "p"]),
        "    sin: Callable[[Any], Any] = math.sin,",
        "    cos: Callable[[Any], Any] = math.cos,",
        ") -> list[Any]:",
        f'    """{docstring}"""',
    ]
    for vector, symbols in (("q", Q), ("v", V), ("w", W), ("p", P)):
        if used & set(symbols):
            targets = ", ".join(str(s) if s in used else "_" for s in symbols)
            lines.append(f"    {targets} = {vector}")
    shared, (reduced,) = sp.cse(value, symbols=sp.numbered_symbols("t"), optimizations="basic")
    for symbol, expression in shared:
        lines.append(f"    {symbol} = {sp.pycode(expression)}")
    if value.cols == 1:
        lines.append("    return [")
        lines += [f"        {sp.pycode(entry)}," for entry in reduced]
    else:
        lines.append("    return [")
        for i in range(value.rows):
            row = ", ".join(sp.pycode(reduced[i, j]) for j in range(value.cols))
            lines.append(f"        [{row}],")
    lines.append("    ]")
    return "\n".join(lines).replace("math.sin(", "sin(").replace("math.cos(", "cos(") + "\n"


def generate() -> str:
    """Text of the generated module, in the layout of ``ruff format``."""
    parts = [HEADER]
    parts += [emit(name, docstring, value) for name, (docstring, value) in derive().items()]
    text = "\n\n".join(parts)
    command = [sys.executable, "-m", "ruff", "format", "--line-length", "100", "-"]
    return subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout


def main() -> int:
    """Write the module, or compare it with ``--check``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare, do not write")
    check = parser.parse_args().check
    text = generate()
    if check:
        current = TARGET.exists() and TARGET.read_text() == text
        print(f"{TARGET.name} is {'current' if current else 'out of date'}")
        return 0 if current else 1
    TARGET.write_text(text)
    print(f"wrote {TARGET.name}: {len(text.splitlines())} lines")
    return 0


if __name__ == "__main__":
    sys.exit(main())
