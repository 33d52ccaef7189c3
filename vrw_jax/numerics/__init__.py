"""Numerical methods for any system: hybrid flows, collocation, fixed points and continuation.

The entry points for any vector field, guards and resets are `simulate_hybrid`, `solve_fixed_point`,
`linearize_segments` with `product_multipliers`, `flow_jacobian_determinant`, `arclength` and
`enumerate_lcp_solutions`. The page docs/any_system.md shows examples.
"""

from vrw_jax.numerics import arclength, floquet
from vrw_jax.numerics.arclength import (
    AbstractFollowed,
    ArclengthOptions,
    Ending,
    Linear,
    MapFollowed,
    PathPoint,
    Plane,
    Section,
    Unknown,
)
from vrw_jax.numerics.codes import Code
from vrw_jax.numerics.collocation import (
    Constants,
    Linearised,
    Passage,
    Phase,
    PhaseSequence,
    Point,
    Solution,
    linearised_pass,
    mesh_error,
    walk_through,
)
from vrw_jax.numerics.complementarity import Answers, complementary
from vrw_jax.numerics.derivatives import (
    Forward,
    InForm,
    any_mode,
    on_branch,
    push,
    slopes_on_branch,
    with_jacobian,
    without_derivative,
)
from vrw_jax.numerics.events import (
    Field,
    PhaseEnd,
    integrate_phase,
    sample_phase,
    solver_named,
)
from vrw_jax.numerics.floquet import multipliers
from vrw_jax.numerics.gauss import (
    ENDS_ONCE,
    ENDS_TWICE,
    N_NODES,
    NODES,
    ONCE,
    TWICE,
    Mesh,
    differentiation,
    integrated,
    lagrange,
    transfer_matrix,
)
from vrw_jax.numerics.hybrid import Guard, Mode, Stop, time_errors, walk
from vrw_jax.numerics.lane_algebra import LaneArray, partials_of
from vrw_jax.numerics.lane_minima import Monitors
from vrw_jax.numerics.lanes import (
    LaneFunction,
    compiled_by_caller,
    if_any,
    in_batches,
    in_batches_of_numpy,
    in_blocks,
    joined,
    one_wheel,
    select,
    taken,
    two_fold,
    zeros_of,
)
from vrw_jax.numerics.levels import (
    AbstractLevel,
    LevelFollowed,
    LevelLinear,
    LevelPoint,
    margins_beside_fold,
)
from vrw_jax.numerics.march import LanePhase, integrate_lanes, sample_lanes, sampled
from vrw_jax.numerics.minima import ROUNDING, State, Watched
from vrw_jax.numerics.newton import SectionCycle, moved_cycle, newton_cycle
from vrw_jax.numerics.options import Engine, Options
from vrw_jax.numerics.roots import BIFURCATIONS, bifurcation_functions, brackets, locate, turns
from vrw_jax.numerics.saltation import volume_change
from vrw_jax.numerics.segments import product_multipliers, segment_maps
from vrw_jax.numerics.side_by_side import follow_many, solve, solve_many
from vrw_jax.numerics.tableaus import (
    Place,
    Slope,
    Tableau,
    below,
    change_of_length,
    explicit_tableau,
    parabola,
    real_stability_limit,
)
from vrw_jax.numerics.tangents import Balance, by_directions
from vrw_jax.numerics.trig import sine_cosine
from vrw_jax.numerics.types import Elementwise, Number, Scalar, Vector
