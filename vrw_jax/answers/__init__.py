"""Measures to within a tolerance, from the lowest model whose error can be bounded."""

from vrw_jax.answers.asking import answer
from vrw_jax.answers.averages import Average, average
from vrw_jax.answers.lower import RIGID
from vrw_jax.answers.quantities import MADE
from vrw_jax.answers.result import Answer
