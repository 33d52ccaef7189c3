"""Measures to a required tolerance from the simplest sufficient model, and multifidelity means."""

from vrw_jax.tolerance.lower_fidelity import ModelIndex
from vrw_jax.tolerance.measure_result import MeasureResult
from vrw_jax.tolerance.multifidelity import MultifidelityMean, multifidelity_mean
from vrw_jax.tolerance.step_quantities import MEASURE_FUNCTIONS
from vrw_jax.tolerance.tolerance_request import measure_to_tolerance
