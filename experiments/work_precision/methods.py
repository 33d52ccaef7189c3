"""Every way to a step, a limit cycle or its gradient that `run` compares.

A method's `make(setting, rows, starts)` prepares what its user would prepare and returns a function
without arguments that computes and returns an array with one row for each lane:

- step: (theta-, dtheta-, dL1-), durations of DLS, SLS-I, SLS-II, evaluations
- cycle: (theta+, dtheta+), durations, monodromy matrix row by row, evaluations
- gradient: d(DLS fraction)/d(VARIED), d(period)/d(VARIED), evaluations

Evaluations are those of the equations of motion; 0 where a method does not tell. A failed lane is
NaN. Rows hold VARIED, starts are section states.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import vrw_jax as vrw
from experiments.shared.wheels import PARAMETER_BOX, make_wheels
from experiments.speed import peers
from vrw_jax.flow import load_explicit_tableau
from vrw_jax.models.phase_sequence import make_element_phase
from vrw_jax.wheel import make_paper_phases, transitions

VARIED_PARAMETERS = tuple(PARAMETER_BOX)
Run = Callable[[], np.ndarray]


class Method(NamedTuple):
    """One curve of a chart."""

    group: str  # step, cycle or gradient
    family: str  # decides the colour
    name: str  # decides line and marker; with `family` it is the label
    precision: str
    settings: tuple  # tolerances, meshes or step lengths, loosest first
    make: Callable[[Any, np.ndarray, np.ndarray], Run]
    lanes: int = 256  # measured at once; the lanes of the reference, repeated or cut


# --- One step.


def stages(solver: str) -> int:
    """Return the evaluations per tried step, 0 for implicit solvers, which report none."""
    tableau = load_explicit_tableau(solver)
    return 0 if tableau is None else len(tableau.stage_nodes) - 1


def by_library(engine: str, solver: str, dtype: type = np.float64) -> Callable:
    """`vrw.steps` by an engine; settings are tolerances."""

    def make(tolerance: float, rows: np.ndarray, starts: np.ndarray) -> Run:
        as_given = functools.partial(np.asarray, dtype=dtype)
        options = vrw.StepOptions(solver=solver, rtol=as_given(tolerance), atol=as_given(tolerance))
        params, x = make_wheels(as_given(rows)), as_given(starts)
        params = jax.tree.map(lambda leaf: leaf.astype(dtype), params)

        def run() -> np.ndarray:
            batch_result = vrw.step_batch(params, x, options=options, engine=engine)
            parts = (
                batch_result.section_state,
                batch_result.durations,
                batch_result.solver_steps[:, None],
            )
            joined_values = np.concatenate([np.asarray(part, float) for part in parts], 1)
            joined_values[:, 6] *= stages(solver)
            joined_values[np.asarray(batch_result.outcome) != vrw.Outcome.STEPPED] = np.nan
            return joined_values

        return run

    return make


def single_step(solver: str) -> Callable:
    """`vrw.return_map` of the first lane alone, compiled."""

    @jax.jit
    def step(params: vrw.WheelParams, x: jax.Array, tolerance: jax.Array) -> Any:
        options = vrw.StepOptions(solver=solver, rtol=tolerance, atol=tolerance)
        return vrw.ViscoelasticWheel().advance(params, x, options)

    def make(tolerance: float, rows: np.ndarray, starts: np.ndarray) -> Run:
        params, x = make_wheels(rows[0]), jnp.asarray(starts[0])

        def run() -> np.ndarray:
            solution = jax.block_until_ready(step(params, x, tolerance))
            count = solution.solver_steps * stages(solver)
            return np.asarray([[*solution.section_state, *solution.durations, count]])

        return run

    return make


def by_diffeqsolve(solver: diffrax.AbstractAdaptiveSolver, fixed: bool) -> Callable:
    """Three `diffrax.diffeqsolve` with `diffrax.Event`; settings: tolerances or step lengths."""

    root_finder = optx.Newton(1e-12, 1e-12)

    def until(phase: Any, y: jax.Array, setting: jax.Array) -> tuple:
        controller: Any = diffrax.ConstantStepSize()
        if not fixed:
            controller = diffrax.PIDController(rtol=setting, atol=setting)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: phase.vector_field(y)),
            solver, 0.0, 20.0, setting if fixed else 5e-3, y,
            stepsize_controller=controller,
            event=diffrax.Event(
                lambda t, y, args, **_: phase.guards.evaluate_guards_and_margins(y)[0],
                root_finder, direction=False,
            ),
            max_steps=20_000, throw=False,
        )  # fmt: skip
        ended = solution.result == diffrax.RESULTS.event_occurred
        return (
            solution.ys[0],
            jnp.where(ended, solution.ts[0], jnp.nan),
            solution.stats["num_steps"],
        )

    def one(row: jax.Array, x: jax.Array, setting: jax.Array) -> jax.Array:
        s = make_wheels(row).symbols()
        landing = transitions.resolve_landing(s, *x)
        phases = make_paper_phases(s, landing.foot_distance, stop_at_lift_off=True)
        dls, sls1, sls2 = (make_element_phase(phase, records_margins=False) for phase in phases)
        y, first_time, n1 = until(
            dls, jnp.stack([landing.theta_after_landing, landing.motion_after.dtheta]), setting
        )
        m = dls.motion_unpacker(y)
        start = jnp.stack([y[0], m.L1, m.L2, m.dtheta, m.dL1, m.dL2])
        y, second, n2 = until(sls1, start, setting)
        hit = transitions.resolve_stopper_collision(s, sls1.motion_unpacker(y)).motion_after
        start = jnp.stack([y[0], hit.L1, hit.dtheta, hit.dL1])
        y, third, n3 = until(sls2, start, setting)
        times = first_time, second, third
        good = jnp.isfinite(sum(times))
        count = (n1 + n2 + n3) * float(stages(type(solver).__name__))
        stacked_values = jnp.stack([y[0], y[2], y[3], *times, count])
        return jnp.where(good, stacked_values, jnp.nan)

    steps = jax.jit(jax.vmap(one, (0, 0, None)))
    return lambda setting, rows, starts: lambda: np.asarray(steps(rows, starts, setting))


def plane_starts(rows: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(theta+, dtheta+) after the landing, and parameters packed for the peers."""
    params = make_wheels(rows)
    return compute_landing(params, starts), peers.pack(params)


def compute_landing(params: vrw.WheelParams, states: np.ndarray) -> np.ndarray:
    """(theta+, dtheta+) after the landing of section states."""
    return np.asarray(_compute_landing_columns(params, states))


@jax.jit
def _compute_landing_columns(params: vrw.WheelParams, states: jax.Array) -> jax.Array:
    landing = transitions.resolve_landing(params.symbols(), *states.T)
    return jnp.stack([landing.theta_after_landing, landing.motion_after.dtheta], 1)


def peer_steps(name: str, tolerance: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the batch step of another library."""
    if name == "numba":
        return lambda y, packed: peers.numba_steps(y, packed, tolerance)
    if name == "heyoka":
        return peers.Heyoka(tolerance)
    if name == "torchdiffeq":
        return lambda y, packed: peers.torch_steps(y, packed, tolerance)
    return lambda y, packed: peers.scipy_steps(y, packed, tolerance, name)


def by_peer(name: str) -> Callable:
    """Return the step of another library as a method, with tolerances as settings."""

    def make(tolerance: float, rows: np.ndarray, starts: np.ndarray) -> Run:
        y, packed = plane_starts(rows, starts)
        steps = peer_steps(name, tolerance)
        return lambda: steps(y, packed)

    return make


# --- Limit cycles.


def by_collocation(tolerance: float = 1e-10, dtype: type = np.float64) -> Callable:
    """`vrw.limit_cycle` from nothing; settings are meshes."""

    def make(mesh: tuple[int, int, int], rows: np.ndarray, starts: np.ndarray) -> Run:
        options = vrw.CycleOptions(mesh_intervals=mesh, tolerance=tolerance)
        given = np.asarray(rows, dtype)

        def one(row: jax.Array) -> tuple:
            params = jax.tree.map(lambda leaf: leaf.astype(dtype), make_wheels(row))
            cycle = vrw.limit_cycle(params, options=options)
            return (
                cycle.post_impact,
                cycle.durations,
                cycle.monodromy_value,
                cycle.n_newton_iterations,
                cycle.found,
            )

        find = jax.jit(jax.vmap(one) if len(rows) > 1 else one)

        def run() -> np.ndarray:
            with jax.enable_x64(dtype is np.float64):  # with it, the mesh would be float64
                solution = jax.block_until_ready(find(given if len(rows) > 1 else given[0]))
            y, durations, matrix, passes, good = (np.asarray(x, float) for x in solution)
            count = passes * 4.0 * sum(mesh)
            parts = y, durations, matrix.reshape(*matrix.shape[:-2], 4), count[..., None]
            result = np.atleast_2d(np.concatenate(parts, -1))
            result[np.atleast_1d(good) == 0.0] = np.nan
            return result

        return run

    return make


def cycle_of_map(row: jax.Array, start: jax.Array, options: vrw.StepOptions) -> tuple:
    """Find the cycle by Newton's method on the event-driven map; return Jacobian, durations and
    steps.
    """
    params, model = make_wheels(row), vrw.ViscoelasticWheel()
    s = params.symbols()

    def section(y: jax.Array) -> jax.Array:
        landing = transitions.resolve_landing(s, *y)
        return jnp.stack([landing.theta_after_landing, landing.motion_after.dtheta])

    fixed_point = vrw.solve_fixed_point(
        lambda x: model.advance(params, x, options).section_state,
        start,
        tolerance=1e-11,
        max_iterations=8,
    )
    last = model.advance(params, fixed_point.x, options)
    return section(fixed_point.x), fixed_point.jacobian, last.durations, fixed_point.converged


def by_newton(solver: str) -> Callable:
    """`vrw.newton_cycle` on the event-driven step from 1 % off; settings are tolerances."""

    def make(tolerance: float, rows: np.ndarray, starts: np.ndarray) -> Run:
        options = vrw.StepOptions(solver=solver, rtol=tolerance, atol=tolerance)
        options = jax.tree.map(np.asarray, options)
        find = eqx.filter_jit(eqx.filter_vmap(cycle_of_map, in_axes=(0, 0, None)))

        def run() -> np.ndarray:
            y, jacobian, durations, good = map(np.asarray, find(rows, starts, options))
            by_size = -np.sort(-np.abs(np.linalg.eigvals(jacobian)), 1)[:, :2]
            # A diagonal matrix of the same multipliers: this map's own has another frame.
            zero = np.zeros(len(rows))
            result = np.column_stack([y, durations, by_size[:, 0], zero, zero, by_size[:, 1], zero])
            result[~good] = np.nan
            return result

        return run

    return make


def differences(
    function: Callable, y: np.ndarray, packed: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """d(function)/dy by central differences, lanes first, and evaluations."""
    columns, count = [], np.zeros(len(y))
    for i in range(2):
        move = size * np.eye(2)[i]
        (up, n_up), (down, n_down) = function(y + move, packed), function(y - move, packed)
        columns.append((up - down) / (2.0 * size))
        count += n_up + n_down
    return np.stack(columns, -1), count


def plane_map(steps: Callable) -> Callable:
    """(theta+, dtheta+, durations) one step later, and evaluations, by a peer."""

    def function(y: np.ndarray, packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        batch_result = steps(y, packed)
        parameters = dict(zip(VARIED_PARAMETERS, unpack_parameters(packed).T, strict=True))
        after = compute_landing(vrw.WheelParams(**parameters), batch_result[:, :3])
        return np.concatenate([after, batch_result[:, 3:6]], 1), batch_result[:, 6]

    return function


def unpack_parameters(packed: np.ndarray) -> np.ndarray:
    """VARIED as they stand in the peers' parameters."""
    slope = np.arctan2(packed[:, 7], packed[:, 8])
    return np.stack([packed[:, 5], packed[:, 4], packed[:, 3], slope], 1)


def peer_cycle(
    name: str, tolerance: float, rows: np.ndarray, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Callable]:
    """Find the cycle by Newton's method with central differences of another library's step."""
    y, packed = plane_starts(rows, starts)
    function = plane_map(peer_steps(name, tolerance))
    size = max(tolerance, 1e-15) ** (1.0 / 3.0) * 0.1
    count = np.zeros(len(rows))
    for _ in range(8):
        slope, n = differences(function, y, packed, size)
        image, m = function(y, packed)
        count += n + m
        miss = image[:, :2] - y
        change = np.linalg.solve(np.eye(2) - slope[:, :2], miss[..., None])[..., 0]
        y = y + change
        if np.nanmax(np.abs(change)) < max(10.0 * tolerance, 1e-13):
            break
    return y, image[:, 2:], slope, count, function


def by_peer_cycle(name: str) -> Callable:
    """Return the cycle of another library as a method, with tolerances as settings."""

    def make(tolerance: float, rows: np.ndarray, starts: np.ndarray) -> Run:
        def run() -> np.ndarray:
            y, durations, slope, count, _ = peer_cycle(name, tolerance, rows, starts)
            matrix = slope[:, :2].reshape(-1, 4)
            return np.column_stack([y, durations, matrix, count])

        return run

    return make


# --- Gradients of a limit cycle.


def gradient_rows(d_durations: np.ndarray, durations: np.ndarray) -> np.ndarray:
    """d(DLS fraction), d(period) from d(durations)/d(VARIED), lanes first."""
    period = durations.sum(1)[:, None]
    d_period = d_durations.sum(1)
    fraction = (d_durations[:, 0] - durations[:, :1] / period * d_period) / period
    return np.concatenate([fraction, d_period], 1)


def by_columns(mode: str, tolerance: float = 1e-10, dtype: type = np.float64) -> Callable:
    """`jax.jacfwd` or `jax.jacrev` of `vrw.limit_cycle`; settings are meshes."""

    def make(mesh: tuple[int, int, int], rows: np.ndarray, starts: np.ndarray) -> Run:
        options = vrw.CycleOptions(mesh_intervals=mesh, tolerance=tolerance)
        given = np.asarray(rows, dtype)

        def measures(row: jax.Array) -> tuple:
            params = jax.tree.map(lambda leaf: leaf.astype(dtype), make_wheels(row))
            cycle = vrw.limit_cycle(params, options=options)
            return jnp.stack([cycle.dls_fraction, cycle.period]), cycle.found

        derive = jax.jacfwd if mode == "forward" else jax.jacrev
        one = derive(measures, has_aux=True)
        find = jax.jit(jax.vmap(one) if len(rows) > 1 else one)

        def run() -> np.ndarray:
            with jax.enable_x64(dtype is np.float64):
                solution, good = jax.block_until_ready(find(given if len(rows) > 1 else given[0]))
            result = np.asarray(solution, float).reshape(-1, 8)
            result = np.concatenate([result, np.zeros((len(result), 1))], 1)
            result[~np.atleast_1d(good)] = np.nan
            return result

        return run

    return make


def by_step_jacobian(solver: str) -> Callable:
    """Return the method that applies the implicit function theorem to the Jacobian of the step."""

    def make(tolerance: float, rows: np.ndarray, starts: np.ndarray) -> Run:
        options = jax.tree.map(
            np.asarray, vrw.StepOptions(solver=solver, rtol=tolerance, atol=tolerance)
        )
        model = vrw.ViscoelasticWheel()

        def one(row: jax.Array, start: jax.Array, options: vrw.StepOptions) -> tuple:
            def evaluate_gait(x: jax.Array, row: jax.Array) -> jax.Array:
                solution = model.advance(make_wheels(row), x, options)
                return jnp.concatenate([solution.section_state, solution.durations])

            params = make_wheels(row)
            fixed_point = vrw.solve_fixed_point(
                lambda x: model.advance(params, x, options).section_state,
                start,
                tolerance=1e-11,
                max_iterations=8,
            )
            by_x, by_row = jax.jacfwd(evaluate_gait, (0, 1))(fixed_point.x, row)
            dx = jnp.linalg.solve(jnp.eye(3) - by_x[:3], by_row[:3])
            return (
                by_row[3:] + by_x[3:] @ dx,
                evaluate_gait(fixed_point.x, row)[3:],
                fixed_point.converged,
            )

        find = eqx.filter_jit(eqx.filter_vmap(one, in_axes=(0, 0, None)))

        def run() -> np.ndarray:
            d_durations, durations, good = map(np.asarray, find(rows, starts, options))
            result = gradient_rows(d_durations, durations)
            result = np.concatenate([result, np.zeros((len(result), 1))], 1)
            result[~good] = np.nan
            return result

        return run

    return make


def by_peer_gradient(name: str) -> Callable:
    """Central differences of a peer's map at its cycle, and the implicit function theorem."""

    def make(tolerance: float, rows: np.ndarray, starts: np.ndarray) -> Run:
        size = max(tolerance, 1e-15) ** (1.0 / 3.0) * 0.1

        def run() -> np.ndarray:
            y, durations, slope, count, function = peer_cycle(name, tolerance, rows, starts)
            columns = []
            for i in range(len(VARIED_PARAMETERS)):
                ends = []
                for sign in (1.0, -1.0):
                    shifted = rows.copy()
                    shifted[:, i] *= 1.0 + sign * size
                    image, n = function(y, peers.pack(make_wheels(shifted)))
                    count = count + n
                    ends.append(image)
                columns.append((ends[0] - ends[1]) / (2.0 * size * rows[:, i : i + 1]))
            by_row = np.stack(columns, -1)
            dy = np.linalg.solve(np.eye(2) - slope[:, :2], by_row[:, :2])
            d_durations = by_row[:, 2:] + slope[:, 2:] @ dy
            return np.column_stack([gradient_rows(d_durations, durations), count])

        return run

    return make


LANES, ENGINE, COLLOCATION = "lane engine", "diffrax engine", "collocation"
BY_HAND, NUMBA, HEYOKA, SCIPY = "diffrax by hand", "numba", "heyoka", "SciPy"
TORCH = "torchdiffeq"
DEFAULT_MESH = vrw.CycleOptions().mesh_intervals
MESHES = ((3, 5, 2), DEFAULT_MESH, vrw.CycleOptions.tight().mesh_intervals)
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13)
EVERY_OTHER = (1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
LOOSE = (1e-3, 1e-4, 2e-5)  # float32 resolves no less
f32, f64 = "float32", "float64"

METHODS = (
    Method("step", NUMBA, "Dopri5", f64, TOLERANCES, by_peer("numba")),
    Method("step", HEYOKA, "Taylor", f64, (1e-3, 1e-6, 1e-9, 1e-12, 1e-15), by_peer("heyoka")),
    *(
        Method("step", SCIPY, name, f64, settings, by_peer(name))
        for name, settings in (
            ("RK45", (1e-4, 1e-6, 1e-8, 1e-10)),
            ("DOP853", (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)),
            ("LSODA", (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)),
            ("Radau", (1e-4, 1e-6, 1e-8)),
        )
    ),
    Method("step", TORCH, "dopri5", f64, (1e-4, 1e-6, 1e-8), by_peer("torchdiffeq")),
    *(
        Method("step", ENGINE, solver, f64, settings, by_library("diffrax", solver))
        for solver, settings in (
            ("Dopri8", (1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13)),
            ("Tsit5", EVERY_OTHER),
            ("Dopri5", EVERY_OTHER),
            ("Kvaerno3", (1e-3, 1e-4, 1e-6)),
            ("Kvaerno5", (1e-3, 1e-4, 1e-6, 1e-8, 1e-10)),
        )
    ),
    Method("cycle", COLLOCATION, "from nothing", f64, MESHES, by_collocation()),
    Method("cycle", NUMBA, "Newton, differences", f64, TOLERANCES, by_peer_cycle("numba")),
    Method(
        "cycle", HEYOKA, "Newton, differences", f64, (1e-6, 1e-9, 1e-12, 1e-15),
        by_peer_cycle("heyoka"),
    ),
    Method("cycle", ENGINE, "Newton, Dopri8", f64, (1e-6, 1e-8, 1e-10, 1e-12), by_newton("Dopri8")),
    Method("gradient", COLLOCATION, "forward", f64, MESHES, by_columns("forward")),
    Method("gradient", NUMBA, "differences", f64, TOLERANCES, by_peer_gradient("numba")),
    Method(
        "gradient", HEYOKA, "differences", f64, (1e-6, 1e-9, 1e-12, 1e-15),
        by_peer_gradient("heyoka"),
    ),
    Method("gradient", COLLOCATION, "reverse", f64, (DEFAULT_MESH,), by_columns("reverse")),
    Method(
        "gradient", ENGINE, "step's Jacobian, Dopri8", f64, (1e-6, 1e-8, 1e-10),
        by_step_jacobian("Dopri8"),
    ),
    # One wheel alone.
    Method(
        "step", ENGINE, "Dopri8", f64, (1e-4, 1e-6, 1e-8, 1e-10, 1e-12), single_step("Dopri8"), 1,
    ),
    Method("cycle", COLLOCATION, "from nothing", f64, MESHES[:2], by_collocation(), 1),
    Method("gradient", COLLOCATION, "forward", f64, (DEFAULT_MESH,), by_columns("forward"), 1),
    # float32: what it can reach at all.
    Method(
        "cycle", COLLOCATION, "from nothing", f32, MESHES[:2], by_collocation(1e-4, np.float32),
    ),
    Method(
        "gradient", COLLOCATION, "forward", f32, MESHES[:1],
        by_columns("forward", 1e-4, np.float32),
    ),
    Method("step", ENGINE, "Tsit5", f32, LOOSE, by_library("diffrax", "Tsit5", np.float32)),
    # What needs more of its user.
    Method(
        "step", BY_HAND, "Dopri8, Event", f64, (1e-4, 1e-6, 1e-8, 1e-10),
        by_diffeqsolve(diffrax.Dopri8(), False),
    ),
    Method(
        "step", BY_HAND, "Tsit5, fixed steps", f64, (3e-2, 1.5e-2, 8e-3, 4e-3, 2e-3),
        by_diffeqsolve(diffrax.Tsit5(), True),
    ),
    # Batches of steps.
    *(
        Method("step", LANES, solver, f64, TOLERANCES, by_library("lanes", solver), 2048)
        for solver in ("Tsit5", "Dopri5", "Dopri8")
    ),
    Method("step", LANES, "Tsit5", f32, LOOSE, by_library("lanes", "Tsit5", np.float32), 2048),
)  # fmt: skip
"""In the order in which they are measured."""

SIZES = (1, 16, 256, 2048, 16384)
BATCHES = (
    *(
        Method("step", family, name, f64, (setting,), make, size)
        for family, name, setting, make, sizes in (
            (NUMBA, "Dopri5", 1e-8, by_peer("numba"), SIZES),
            (HEYOKA, "Taylor", 1e-9, by_peer("heyoka"), SIZES[:4]),
            (SCIPY, "DOP853", 1e-9, by_peer("DOP853"), SIZES[:3]),
            (ENGINE, "Tsit5", 1e-8, by_library("diffrax", "Tsit5"), SIZES[:4]),
            (LANES, "Tsit5", 1e-8, by_library("lanes", "Tsit5"), SIZES),
        )
        for size in sizes
    ),
    Method("cycle", COLLOCATION, "from nothing", f64, (DEFAULT_MESH,), by_collocation(), 2048),
)
"""Time against the number of lanes, at p99 errors near 1e-8; METHODS has cycles of 1 and 256."""
