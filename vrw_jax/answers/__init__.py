"""Measures to within a tolerance, from the lowest model whose error can be bounded."""

from vrw_jax.answers.asking import measure_to_tolerance
from vrw_jax.answers.averages import MultifidelityMean, multifidelity_mean
from vrw_jax.answers.lower import RIGID_MODEL_INDEX
from vrw_jax.answers.quantities import MEASURE_FUNCTIONS
from vrw_jax.answers.result import MeasureResult
