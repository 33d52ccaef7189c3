"""Measures of samples on real ground to within a tolerance, by the lowest rung that gives them."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from vrw_jax.answers import RIGID, answer
from vrw_jax.models import UnilateralWheel
from vrw_jax.scans.evaluate import masked, numbers
from vrw_jax.scans.offer import error_of
from vrw_jax.wheel import WheelParams, wheel_of


class AnswerEngine:
    """Evaluates samples for a fixed set of measures; each is its own lane of `vrw.answer`."""

    def __init__(
        self, measures: tuple[str, ...], base: WheelParams, model: UnilateralWheel, tol: float
    ) -> None:
        self._measures, self._base, self._model, self._tol = measures, base, model, tol

    def __call__(self, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Results of the samples in `columns` (one value per sample of each swept parameter)."""
        *own, friction = numbers(columns, self._model, self._base).T
        params = wheel_of(tuple(map(jnp.asarray, own)), self._base.n_legs)
        stoppers = self._model.stoppers
        told = answer(self._measures, params, self._tol, friction=friction, stoppers=stoppers)
        results = {name: told.values[:, i] for i, name in enumerate(self._measures)}
        results |= {error_of(name): told.errors[:, i] for i, name in enumerate(self._measures)}
        rung = np.maximum(told.rungs - RIGID, 0).astype(np.int8)
        return masked(told.outcomes, results | {"rung": rung})
