"""Bad input raises one clear sentence: the given value, the allowed values, the remedy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from support.batched import compute_full_steps, make_parameter_rows

import vrw_jax as vrw
from vrw_jax.models import embed_section_states


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: vrw.WheelParams(damping=-1.0), ("damping is -1", "[0, 1e+60) N s/m")),
        (lambda: vrw.WheelParams(leg_mass=0.0), ("leg_mass is 0", "[1e-15, 1e+60) kg")),
        (lambda: vrw.WheelParams(slope=2.0), ("slope is 2", "1.5708", "rad")),
        (lambda: vrw.WheelParams(stiffness=float("nan")), ("stiffness is nan",)),
        (lambda: vrw.WheelParams(leg_com=1.5), ("leg_com is 1.5", "leg_com < locked_length")),
        (lambda: vrw.WheelParams(n_legs=3), ("n_legs is 3", "at least 5")),
        (lambda: vrw.StepOptions(rtol=0.0), ("rtol is 0", "positive")),
        (lambda: vrw.StepOptions(max_solver_steps=0), ("max_solver_steps is 0", "at least 1")),
        (lambda: vrw.step(vrw.WheelParams(), [0.1, 1.6]), ("shape (2,)", "jax.vmap")),
        (
            lambda: vrw.step(vrw.WheelParams(damping=jnp.ones(3)), vrw.paper_start()),
            ("damping has shape (3,)", "vrw.scan"),
        ),
        (
            lambda: vrw.step(
                vrw.WheelParams(), vrw.paper_start(), options=vrw.StepOptions(solver="RK9")
            ),
            ("solver is 'RK9'", "'Dopri8'"),
        ),
        (
            lambda: vrw.step(
                vrw.WheelParams(), vrw.paper_start(), options=vrw.StepOptions(rtol=1e-17)
            ),
            ("rtol is 1e-17", "float64", "Options("),
        ),
        (lambda: vrw.walk(vrw.WheelParams(), vrw.paper_start(), 0), ("n_steps is 0",)),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else None,
)
def test_a_wrong_number_gets_one_sentence(call, words):
    with pytest.raises(ValueError, match=r"\w") as caught:
        call()
    message = str(caught.value)
    for word in words:
        assert word in message
    assert "\n" not in message


def test_a_dictionary_instead_of_parameters_gets_one_sentence():
    # Undecorated: under pytest the annotations would speak first.
    with pytest.raises(Exception, match="params"):
        vrw.step({"damping": 200.0}, vrw.paper_start())


def test_float32_is_refused_at_tolerances_it_cannot_resolve():
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), vrw.WheelParams())
    start = vrw.paper_start().astype(jnp.float32)
    with pytest.raises(ValueError, match="float32") as caught:
        vrw.step(params, start)
    assert "vrw.start_jax()" in str(caught.value)


def test_arguments_of_both_precisions_are_computed_in_double_precision():
    start = np.array([0.125, 1.5, -0.125])
    mixed, double = (
        vrw.step(vrw.WheelParams(damping=precision(150.0)), start.astype(precision))
        for precision in (np.float32, np.float64)
    )
    assert int(double.outcome) == vrw.Outcome.STEPPED
    jax.tree.map(functools.partial(np.testing.assert_array_equal, strict=True), mixed, double)


def test_a_batch_with_a_slope_for_each_step_is_printed_with_its_domain():
    params = vrw.WheelParams(damping=[150.0, -1.0], slope=np.full((2, 3), 0.3))
    assert params.is_in_domain().tolist() == [[True] * 3, [False] * 3]
    assert "6 values from 0.3" in str(params)


@pytest.fixture
def switched_off():
    """Return a wheel, lanes of wheels, a start and a gait of 64 bits, and then switch JAX to 32
    bits."""
    made = (
        vrw.WheelParams(),
        vrw.WheelParams(damping=np.array([100.0, 150.0])),
        vrw.paper_start(),
        vrw.limit_cycle(vrw.WheelParams()),
    )
    jax.config.update("jax_enable_x64", False)
    try:
        yield made
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.filterwarnings("ignore:Explicitly requested dtype")
@pytest.mark.parametrize(
    "call",
    [
        lambda one, many, x, gait: vrw.limit_cycle(one),
        lambda one, many, x, gait: vrw.limit_cycle(one, guess=gait),
        lambda one, many, x, gait: vrw.limit_cycle(one, model=vrw.UnilateralWheel(friction=0.7)),
        lambda one, many, x, gait: vrw.limit_cycle(one, model=vrw.RigidWheel()),
        lambda one, many, x, gait: vrw.limit_cycles(many),
        lambda one, many, x, gait: jax.jit(lambda p: vrw.limit_cycle(p).speed)(one),
        lambda one, many, x, gait: jax.grad(lambda p: vrw.limit_cycle(p).speed)(one),
        lambda one, many, x, gait: jax.vmap(vrw.limit_cycle, in_axes=(many.in_axes,))(many),
        lambda one, many, x, gait: vrw.sensitivities(one, measures=["speed"]),
        lambda one, many, x, gait: vrw.step(one, x),
        lambda one, many, x, gait: vrw.return_map(one, x),
        lambda one, many, x, gait: vrw.walk(one, x, 2),
        lambda one, many, x, gait: vrw.simulate(one, x, n_steps=1),
        lambda one, many, x, gait: vrw.choose_model(one, x),
        lambda one, many, x, gait: vrw.step_batch(many, np.tile(np.asarray(x), (2, 1)), 2),
        lambda one, many, x, gait: vrw.basin(
            one, {"theta_touchdown": 0.09, "dtheta_touchdown": [1.6], "dL1_touchdown": -0.1}
        ),
        lambda one, many, x, gait: vrw.continue_branch(one, "damping", (190.0, 230.0)),
        lambda one, many, x, gait: vrw.continue_branches(many, "stiffness", (400.0, 600.0)),
        lambda one, many, x, gait: vrw.continue_special_point("fold", ("damping", "slope"), gait),
        lambda one, many, x, gait: vrw.tune(
            one, "dls_fraction", ("damping",), {"damping": (150.0, 200.0)}
        ),
        lambda one, many, x, gait: vrw.scan(vrw.grid(damping=[150.0]), ["speed"], base=one),
        lambda one, many, x, gait: vrw.measure_to_tolerance("speed", one, 1e-3, friction=50.0),
    ],
)
def test_numbers_of_64_bits_are_not_computed_in_32_without_a_word(switched_off, call):
    with pytest.raises(ValueError, match=r"float32 numbers.*vrw\.start_jax"):
        call(*switched_off)


def test_a_program_that_a_process_made_in_32_bits_is_not_used_in_64():
    rows = np.asarray(make_parameter_rows(damping=[150.0, 160.0])).T
    states = np.tile(np.asarray(vrw.paper_start()), (2, 1))
    n_legs = 10  # no other test has made this program
    with jax.enable_x64(False):
        assert embed_section_states(rows, states, n_legs).dtype == np.float32
    assert embed_section_states(rows, states, n_legs).dtype == np.float64


@pytest.mark.slow
def test_float32_works_if_requested():
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), vrw.WheelParams())
    start = vrw.paper_start().astype(jnp.float32)
    options = vrw.StepOptions(solver="Bosh3", rtol=2e-5, atol=2e-5)
    single = vrw.return_map(params, start, options=options)
    assert single.dtype == jnp.float32
    double = vrw.return_map(vrw.WheelParams(), vrw.paper_start())
    # Tolerance times a dozen steps, and round-off of 1e-7 through event times.
    np.testing.assert_allclose(single, double, atol=1e-3)
    for engine in ("lanes", "diffrax"):
        batch_result = vrw.step_batch(params, start[None], options=options, engine=engine)
        assert batch_result.section_state.dtype == batch_result.durations.dtype == jnp.float32
        np.testing.assert_allclose(batch_result.section_state[0], double, atol=1e-3)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: vrw.WheelParams(c=100), "c is called damping: write damping"),
        (lambda: vrw.WheelParams(Ls=1.02), "Ls is called natural_length"),
        (lambda: vrw.WheelParams(n=8), "n is called n_legs"),
        (lambda: vrw.scan(vrw.grid(c=[100.0, 150.0])), "c is called damping"),
        (
            lambda: vrw.scan(vrw.sobol({"mu": (0.5, 0.8)}, n=4), model=vrw.UnilateralWheel()),
            "mu is called friction",
        ),
        (lambda: vrw.continue_branch(vrw.WheelParams(), "k", (400.0, 600.0)), "k is called stiff"),
        (
            lambda: vrw.tune(vrw.WheelParams(), "speed", ("c",), {"c": (150.0, 200.0)}),
            "c is called damping",
        ),
        (lambda: vrw.WheelParams(dampin=100.0), r"did you mean 'damping'.*n_legs\."),
        (lambda: vrw.WheelParams(mu=0.7), "'mu' is no parameter of the wheel"),
    ],
)
def test_a_symbol_of_the_paper_gets_the_name_of_its_parameter(call, sentence):
    with pytest.raises((TypeError, ValueError), match=sentence):
        call()


@pytest.mark.parametrize("dtype", [">f8", ">f4", ">i4"])
def test_numbers_in_another_byte_order_are_the_same_numbers(dtype):
    """Reference: the same numbers in the byte order of the machine."""
    damping = np.array([150.0, 160.0], dtype)
    native = damping.astype(damping.dtype.newbyteorder("="))
    for foreign in (damping, list(damping.reshape(2, 1)), xr.DataArray(damping)):
        values = vrw.WheelParams(damping=foreign).damping
        np.testing.assert_array_equal(np.ravel(values), native)
    np.testing.assert_array_equal(vrw.grid(damping=damping).values_by_parameter["damping"], native)
    start = np.asarray(vrw.paper_start())[None].astype(">f8")
    batch_result = vrw.step_batch(vrw.WheelParams(), start)
    assert batch_result.outcome[0] == vrw.Outcome.STEPPED


def test_a_masked_array_without_masked_entries_is_an_array():
    values = np.ma.array([150.0, 160.0], mask=False)
    np.testing.assert_array_equal(vrw.WheelParams(damping=values).damping, [150.0, 160.0])
    start = np.ma.array(np.asarray(vrw.paper_start())[None])
    assert vrw.step_batch(vrw.WheelParams(), start).outcome[0] == vrw.Outcome.STEPPED


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_wheel_in_single_precision_is_printed_without_a_warning():
    """Parameters may be larger in double precision than single precision has numbers."""
    with jax.enable_x64(False):
        assert "damping c: 200 N s/m" in str(vrw.WheelParams())
        too_large = vrw.WheelParams(damping=np.array([200.0, 1e10, np.inf]))
        assert too_large.is_in_domain().tolist() == [True, False, False]
        options = vrw.StepOptions(rtol=1e-3, atol=1e-3)
        take_step = functools.partial(vrw.step, options=options)
        step = jax.eval_shape(take_step, vrw.WheelParams(), vrw.paper_start())
        assert step.durations.dtype == np.float32


@pytest.mark.slow
def test_invalid_numbers_in_a_batch_have_outcomes():
    vectors = make_parameter_rows(damping=[200.0, -1.0, np.nan])
    outcomes = compute_full_steps(vectors, vrw.paper_start()).outcome
    assert outcomes.tolist() == [
        vrw.Outcome.STEPPED,
        vrw.Outcome.BAD_INPUT,
        vrw.Outcome.BAD_INPUT,
    ]
