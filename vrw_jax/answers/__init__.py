"""Answers to within a tolerance, by the lowest rung that can be shown to give them."""

from vrw_jax.answers.asking import answer
from vrw_jax.answers.averages import Average, average
from vrw_jax.answers.lower import RIGID
from vrw_jax.answers.quantities import MADE
from vrw_jax.answers.result import Answer
