"""Force peaks of gaits are those of the five-coordinate reference, exact and differentiable."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Chebyshev, Polynomial
from reference_code import five_coordinates

import vrw_jax as vrw
from vrw_jax.flow.extrema import NODE_FRACTIONS, find_extrema
from vrw_jax.models import FORCE_PEAK_MEASURES

TABLE_1 = vrw.WheelParams()
TWO_PEAKS = vrw.WheelParams(stiffness=2500.0, damping=100.0, natural_length=1.0, slope=0.075)
WHEELS = {
    "two peaks": TWO_PEAKS,
    "softer": vrw.WheelParams(stiffness=2000.0, damping=50.0, natural_length=1.0, slope=0.05),
    "softest": vrw.WheelParams(stiffness=1500.0, damping=75.0, natural_length=1.0, slope=0.06),
    "Table 1": TABLE_1,
}
WHEELS_BY_PLACE = {
    "end of the step": vrw.WheelParams(stiffness=505.6, damping=17.3),
    "just after the landing": vrw.WheelParams(  # of this foot alone, without double support
        stiffness=2350.0, damping=290.0, natural_length=1.026, slope=0.0925
    ),
    "jump at take-off": vrw.WheelParams(
        stiffness=619.0, damping=288.0, natural_length=1.02, slope=0.0842
    ),
    "jump at the stopper": vrw.WheelParams(
        stiffness=549.0, damping=187.0, natural_length=1.047, slope=0.08
    ),
}
"""Wheels by the place of the largest force on the fore foot, which is no smooth maximum."""
N_COEFFICIENTS = 80
"""Chebyshev coefficients of the force in a phase: the last ones of these wheels are round-off."""


def reference_step(params: vrw.WheelParams, x: np.ndarray) -> dict:
    fields = {f.name: getattr(params, f.name) for f in dataclasses.fields(params) if f.init}
    numbers = {name: float(value) for name, value in fields.items()} | {"n_legs": params.n_legs}
    return five_coordinates.step(numbers, x)


def force_polynomials(step: dict, multipliers: tuple[int, ...]) -> list[Chebyshev]:
    """The sum of multipliers in each phase of a reference step, as a polynomial of time, N."""
    wheel = five_coordinates.Wheel(five_coordinates.TABLE_1 | step["params"])
    polynomials = []
    for phase in filter(lambda phase: phase.duration > 0.0, step["phases"]):
        force = lambda t, phase=phase: sum(
            wheel.acceleration(*phase.sample(float(t)), phase.name)[1][i]
            for i in multipliers
            if i < 2 or phase.name == "DLS"
        )
        sample = np.vectorize(force)
        domain = [0.0, phase.duration]
        polynomials.append(Chebyshev.interpolate(sample, N_COEFFICIENTS, domain))
    return polynomials


def inner_zeros(polynomial: Chebyshev) -> np.ndarray:
    roots = polynomial.roots()
    real = np.sort(roots[np.abs(roots.imag) < 1e-9].real)
    begin, end = polynomial.domain
    return real[(real > begin) & (real < end)]


def reference_extrema(polynomials: list[Chebyshev]) -> tuple[np.ndarray, np.ndarray]:
    """The force at its smooth extrema, N, and the sign of its second derivative."""
    values, signs = [], []
    for polynomial in polynomials:
        times = inner_zeros(polynomial.deriv())
        values += polynomial(times).tolist()
        signs += np.sign(polynomial.deriv(2)(times)).tolist()
    return np.array(values), np.array(signs)


@pytest.fixture(scope="module")
def cycles():
    wheels = WHEELS | WHEELS_BY_PLACE
    return {name: vrw.limit_cycle(params) for name, params in wheels.items()}


@pytest.fixture(scope="module")
def peaks_by_wheel(cycles):
    return {
        name: {key: float(value) for key, value in cycle.measures(FORCE_PEAK_MEASURES).items()}
        for name, cycle in cycles.items()
    }


@pytest.fixture(scope="module", params=WHEELS | WHEELS_BY_PLACE, ids=str)
def compared(request, cycles, peaks_by_wheel):
    params, cycle = (WHEELS | WHEELS_BY_PLACE)[request.param], cycles[request.param]
    step = reference_step(params, np.asarray(cycle.section_state))
    step["params"] = {
        name: float(getattr(params, name))
        for name in ("stiffness", "damping", "natural_length", "slope")
    }
    np.testing.assert_allclose(step["section_state"], cycle.section_state, atol=1e-8)
    polynomials = {chosen: force_polynomials(step, chosen) for chosen in ((1,), (1, 3))}
    return polynomials, peaks_by_wheel[request.param], step


def test_peaks_and_trough_of_the_fore_foot_are_those_of_the_reference(compared):
    polynomials, peaks, _ = compared
    values, signs = reference_extrema(polynomials[1,])
    maxima = values[signs < 0.0]
    assert peaks["n_force_peaks"] == len(maxima)
    highest = maxima.max() if maxima.size else np.nan
    np.testing.assert_allclose(peaks["smooth_peak_force"], highest, rtol=1e-8)
    troughs = [
        min(values[:i][signs[:i] < 0.0].max(), values[i:][signs[i:] < 0.0].max()) - values[i]
        for i in np.flatnonzero(signs > 0.0)
        if np.any(signs[:i] < 0.0) and np.any(signs[i:] < 0.0)
    ]
    assert abs(peaks["force_trough_depth"] - max(troughs, default=0.0)) < 1e-6


def test_peaks_of_the_total_force_are_those_of_the_reference(compared):
    polynomials, peaks, _ = compared
    values, signs = reference_extrema(polynomials[1, 3])
    assert peaks["n_total_force_peaks"] == np.sum(signs < 0.0)
    highest = values[signs < 0.0].max() if np.any(signs < 0.0) else np.nan
    np.testing.assert_allclose(peaks["smooth_peak_total_force"], highest, rtol=1e-8)


def test_the_largest_force_is_that_of_fine_samples_of_the_reference_wherever_it_occurs(compared):
    """Samples of every phase include both ends. Near a maximum, 4,000 samples err by 1e-6 of it."""
    polynomials, peaks, _ = compared
    for chosen, name in (((1,), "peak_force"), ((1, 3), "peak_total_force")):
        samples = [force.linspace(4000)[1] for force in polynomials[chosen]]
        assert abs(peaks[name] / np.max(samples) - 1.0) < 1e-6, name


def test_without_a_smooth_maximum_the_peak_force_is_not_zero(peaks_by_wheel):
    """At damping 17.3 and stiffness 505.6 the largest force is 0.908 body weights."""
    peaks = peaks_by_wheel["end of the step"]
    assert abs(peaks["peak_force"] / (18.0 * 9.81) - 0.908) < 5e-4
    assert peaks["n_force_peaks"] == 0.0
    assert np.isnan(peaks["smooth_peak_force"])


def test_the_largest_later_rate_is_that_of_the_reference(compared):
    polynomials, peaks, _ = compared
    rates, first_peak, start = [], np.inf, 0.0
    for polynomial in polynomials[1,]:
        times = inner_zeros(polynomial.deriv())
        maxima = times[polynomial.deriv(2)(times) < 0.0] + start
        first_peak = min([first_peak, *maxima])
        times = inner_zeros(polynomial.deriv(2))
        times = times[(polynomial.deriv(3)(times) < 0.0) & (times + start > first_peak)]
        rates += polynomial.deriv()(times).tolist()
        start += polynomial.domain[1]
    if rates:
        assert abs(peaks["second_peak_rate"] / max(rates) - 1.0) < 1e-7
    else:
        assert np.isnan(peaks["second_peak_rate"])


def test_the_landing_impulse_is_that_of_the_reference(compared):
    _, peaks, step = compared
    assert abs(peaks["landing_impulse"] / step["lambda_impulse_applied"][1] - 1.0) < 1e-8


def test_the_table_of_two_peaks_has_the_published_digits(peaks_by_wheel):
    """Maximum, minimum, maximum of the fore foot's force: the independent code's table."""
    expected = {"two peaks": (223.20, 25.34), "softer": (227.36, 55.32), "softest": (208.18, 21.02)}
    for name, (peak, depth) in expected.items():
        measures = peaks_by_wheel[name]
        assert abs(measures["peak_force"] - peak) < 0.01, name
        assert abs(measures["force_trough_depth"] - depth) < 0.02, name


@pytest.mark.slow  # its program compiles for a minute on a busy machine
def test_derivatives_are_central_differences(cycles):
    names = tuple(name for name in FORCE_PEAK_MEASURES if not name.startswith("n_"))
    cycle = cycles["two peaks"]
    table = vrw.sensitivities(
        TWO_PEAKS,
        measures=(*names, "n_force_peaks"),
        guess=cycle,
        options=cycle.system.cycle_options,
    )
    np.testing.assert_allclose(table.value[-1], 2.0)
    np.testing.assert_array_equal(table.derivative[-1], 0.0)
    for parameter, h in (("stiffness", 1.0), ("slope", 1e-4), ("leg_mass", 1e-3)):
        value = float(getattr(TWO_PEAKS, parameter))

        def measures(shift, parameter=parameter, value=value):
            wheel = dataclasses.replace(TWO_PEAKS, **{parameter: jnp.asarray(value + shift)})
            shifted = vrw.limit_cycle(wheel, guess=cycle, options=cycle.system.cycle_options)
            return np.array(list(shifted.measures(names).values()), float)

        outer, inner = ((measures(k * h) - measures(-k * h)) / (2.0 * k * h) for k in (2.0, 1.0))
        expected = (4.0 * inner - outer) / 3.0
        exact = table.derivative.sel(measure=list(names), parameter=parameter)
        np.testing.assert_allclose(exact, expected, rtol=2e-6, err_msg=parameter)


@pytest.mark.slow  # its program compiles for a minute on a busy machine
@pytest.mark.parametrize("place", WHEELS_BY_PLACE)
def test_derivatives_of_the_largest_force_are_central_differences_at_every_place(cycles, place):
    """Richardson's formula has an error of 1e-8 at these steps."""
    wheel, cycle = WHEELS_BY_PLACE[place], cycles[place]
    names, options = ("peak_force", "peak_total_force"), cycle.system.cycle_options
    table = vrw.sensitivities(wheel, measures=names, guess=cycle, options=options)
    for parameter, h in (("stiffness", 0.2), ("slope", 1e-5)):

        def measure(shift, parameter=parameter):
            value = jnp.asarray(getattr(wheel, parameter) + shift)
            shifted = dataclasses.replace(wheel, **{parameter: value})
            gait = vrw.limit_cycle(shifted, guess=cycle, options=options)
            return np.array(list(gait.measures(names).values()), float)

        outer, inner = ((measure(k * h) - measure(-k * h)) / (2.0 * k * h) for k in (2.0, 1.0))
        exact = table.derivative.sel(measure=list(names), parameter=parameter)
        np.testing.assert_allclose(exact, (4.0 * inner - outer) / 3.0, rtol=1e-7)


@pytest.mark.slow  # its program compiles for a minute on a busy machine
def test_a_scan_of_peaks_has_those_of_each_gait(tmp_path):
    names = ["n_force_peaks", "peak_force", "second_peak_rate"]
    options = vrw.limit_cycle(TABLE_1).system.cycle_options
    scan = vrw.scan(
        vrw.grid(damping=[100.0, 200.0]), names, store=tmp_path / "scan", cycle_options=options
    )
    for damping, i in ((100.0, 0), (200.0, 1)):
        cycle = vrw.limit_cycle(vrw.WheelParams(damping=damping), options=options)
        for name, value in cycle.measures(names).items():
            np.testing.assert_allclose(scan[name].values[i], value, rtol=1e-9, err_msg=name)
    assert scan.peak_force.attrs["units"] == "N"


@pytest.mark.slow
def test_second_derivatives_of_peaks_are_refused():
    def peak(damping):
        return vrw.limit_cycle(vrw.WheelParams(damping=damping)).force_peaks["peak_force"]

    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.hessian(peak)(165.0)


@pytest.mark.parametrize("distance", [0.1, 1e-2, 1e-3])
def test_a_peak_and_a_trough_close_to_each_other_are_both_found(distance):
    """Where a second peak appears, its trough is at the same time."""
    middle, duration = 0.45, 2.0
    force = Polynomial.fromroots([middle - distance / 2, middle + distance / 2]).integ()
    times = NODE_FRACTIONS * duration
    samples = jnp.asarray(force(times)[None]), jnp.asarray(force.deriv()(times)[None])
    extrema = find_extrema(*samples, jnp.full(1, duration))
    expected = [middle - distance / 2, middle + distance / 2]
    is_extremum = extrema.is_maximum | extrema.is_minimum
    np.testing.assert_allclose(extrema.times[is_extremum], expected, atol=1e-10)
    assert extrema.is_maximum[is_extremum].tolist() == [True, False]


def test_forces_of_a_step_that_the_solver_does_not_finish_are_nan():
    model, x = vrw.ViscoelasticWheel(), vrw.paper_start()
    finished, unfinished = (
        model.measure_force_peaks(TABLE_1, x, vrw.StepOptions(max_solver_steps=n))
        for n in (1000, 5)
    )
    assert np.isfinite(finished["peak_force"])
    assert np.isnan(unfinished["peak_force"])
