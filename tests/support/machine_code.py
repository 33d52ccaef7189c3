"""A process that forgets its machine code, as another would not know it."""

import jax

from vrw_jax.simd import code_cache as code
from vrw_jax.simd import ffi_primitive as ffi
from vrw_jax.simd import program

_REGISTERED = ffi.LOADED_BY_NAME  # XLA never lets go, and takes one code of a name: it is the same


class CodeRegistrySpy:
    """`names` of machine code as it is registered; `forget()`, and all is as in another process."""

    def __init__(self, monkeypatch):
        self.names, self._monkeypatch = [], monkeypatch
        self._original_register = jax.ffi.register_ffi_target
        monkeypatch.setattr(jax.ffi, "register_ffi_target", self._register)
        self.reset_registry()

    def reset_registry(self):
        self._monkeypatch.setattr(code, "_made", {})
        registered = PersistentRegistry()
        for module in (ffi, program):
            self._monkeypatch.setattr(module, "registered", registered)

    def _register(self, name, *rest, **options):
        self.names.append(name)
        if name not in _REGISTERED:
            self._original_register(name, *rest, **options)


class PersistentRegistry(dict):
    """What is registered, which outlives the test."""

    def __setitem__(self, name, library):
        _REGISTERED.setdefault(name, library)
        super().__setitem__(name, library)
