from vrw_jax.models.base import AbstractWheel


class RigidWheel(AbstractWheel):
    def advance(self, params, x, options):
        raise NotImplementedError

    def step(self, params, x, options):
        raise NotImplementedError

    def trace(self, params, x, options, n):
        raise NotImplementedError

    def start(self, params):
        raise NotImplementedError
