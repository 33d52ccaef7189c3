"""A process that forgets its machine code, as another would not know it."""

import jax

from vrw_jax.simd import code, ffi, program

_REGISTERED = ffi.registered  # XLA never lets go, and takes one code of a name: it is the same


class Forgetful:
    """`names` of machine code as it is registered; `forget()`, and all is as in another process."""

    def __init__(self, monkeypatch):
        self.names, self._patch = [], monkeypatch
        self._once = jax.ffi.register_ffi_target
        monkeypatch.setattr(jax.ffi, "register_ffi_target", self._register)
        self.forget()

    def forget(self):
        self._patch.setattr(code, "_made", {})
        registered = Keeping()
        for module in (ffi, program):
            self._patch.setattr(module, "registered", registered)

    def _register(self, name, *rest, **named):
        self.names.append(name)
        if name not in _REGISTERED:
            self._once(name, *rest, **named)


class Keeping(dict):
    """What is registered, which outlives the test."""

    def __setitem__(self, name, loaded):
        _REGISTERED.setdefault(name, loaded)
        super().__setitem__(name, loaded)
