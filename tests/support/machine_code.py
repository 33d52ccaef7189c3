"""Replace the registry of machine code by one that can be emptied, as in a new process."""

import jax

from vrw_jax.simd import code_cache as code
from vrw_jax.simd import ffi_primitive as ffi
from vrw_jax.simd import program

_REGISTERED = ffi.LOADED_CODE_BY_FFI_TARGET  # XLA never releases code and accepts one code per name


class CodeRegistrySpy:
    """Record of the `names` of registered code; `reset_registry()` gives the state of a new
    process."""

    def __init__(self, monkeypatch):
        self.names, self._monkeypatch = [], monkeypatch
        self._original_register = jax.ffi.register_ffi_target
        monkeypatch.setattr(jax.ffi, "register_ffi_target", self._register)
        self.reset_registry()

    def reset_registry(self):
        self._monkeypatch.setattr(code, "_machine_code_by_record_name", {})
        registered = PersistentRegistry()
        for module in (ffi, program):
            self._monkeypatch.setattr(module, "LOADED_CODE_BY_FFI_TARGET", registered)

    def _register(self, name, *rest, **options):
        self.names.append(name)
        if name not in _REGISTERED:
            self._original_register(name, *rest, **options)


class PersistentRegistry(dict):
    """Loaded code by name, whose registrations outlive the test."""

    def __setitem__(self, name, library):
        _REGISTERED.setdefault(name, library)
        super().__setitem__(name, library)
