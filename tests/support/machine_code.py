"""Replace the registry of machine code by one that can be emptied, as in a new process."""

import contextlib
from collections import OrderedDict

import jax
from jax.experimental.compilation_cache import compilation_cache

from vrw_jax.lanes import machine_code as code
from vrw_jax.lanes import program

_REGISTERED = (
    program.LOADED_CODE_BY_FFI_TARGET
)  # XLA never releases code and accepts one code per name


@contextlib.contextmanager
def use_cache_folder(folder):
    """Let JAX and the library keep their code in a folder."""
    wait_for_compiler()  # It saves code in the folder of the time when it ends.
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", folder and str(folder))
    compilation_cache.reset_cache()  # It may have opened another folder.
    yield folder
    wait_for_compiler()
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


def wait_for_compiler():
    code._llvm_compiler_pool.submit(lambda: None).result()


def disable_machine_code(monkeypatch):
    """Let XLA compute everything."""
    monkeypatch.setattr(program, "_machine_code_failure_reasons", ["a test"])


class CodeRegistrySpy:
    """Record of the `names` of registered code and of the number of traces for machine code.

    `reset_registry()` gives the state of a new process.
    """

    def __init__(self, monkeypatch):
        self.names, self._monkeypatch = [], monkeypatch
        self.n_traces, self._original_trace = 0, code.trace_for_machine_code
        monkeypatch.setattr(code, "trace_for_machine_code", self._trace)
        self._original_register = jax.ffi.register_ffi_target
        monkeypatch.setattr(jax.ffi, "register_ffi_target", self._register)
        self.reset_registry()

    def reset_registry(self):
        for name in ("_machine_code_by_name", "_lane_program_by_index_name"):
            self._monkeypatch.setattr(code, name, {})
        self._monkeypatch.setattr(code, "_recent_traces", OrderedDict())
        self._monkeypatch.setattr(program, "_lane_kernels", {})
        registered = PersistentRegistry()
        self._monkeypatch.setattr(program, "LOADED_CODE_BY_FFI_TARGET", registered)

    def _trace(self, *arguments):
        self.n_traces += 1
        return self._original_trace(*arguments)

    def _register(self, name, *rest, **options):
        self.names.append(name)
        if name not in _REGISTERED:
            self._original_register(name, *rest, **options)


class PersistentRegistry(dict):
    """Loaded code by name, whose registrations outlive the test."""

    def __setitem__(self, name, library):
        _REGISTERED.setdefault(name, library)
        super().__setitem__(name, library)
