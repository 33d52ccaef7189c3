"""Traced functions kept on disk beside JAX's compiled code, which saves Python's share of a start.

JAX's persistent cache spares the compiler but not the tracing, which for a limit cycle with
derivatives takes longer than a scan of thousands. Where that cache is on, its folder also keeps
traces, by a key of everything that they depend on, the library's source included.
"""

import functools
import hashlib
import os
import tempfile
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jax.sharding import SingleDeviceSharding

from vrw_jax.start import fusion_emitters


@functools.cache
def code_digest() -> str:
    """A digest of the library's source: other code may give other digits."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def compiled(
    function: Callable, arguments: tuple, settings: object, device: jax.Device
) -> Callable:
    """`function` compiled for arguments like these, on `device`.

    `settings` says by `repr` what the function closes over.

    The way leads through the exported trace whether or not it is kept, so that all runs compile the
    same program.
    """
    exported = _exported(function, arguments, settings)
    there = SingleDeviceSharding(device)
    placed = [jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=there) for x in exported.in_avals]
    program = jax.jit(exported.call).lower(*placed).compile(fusion_emitters(False))
    return lambda *arguments: program(*jax.tree.leaves(arguments))


def remembered(function: Callable, settings: object) -> Callable:
    """`function`, not traced where its trace is kept; to be called while a program is traced.

    For functions that are neither mapped nor differentiated from outside. As with `compiled`,
    first and later runs lead through the exported trace.
    """

    def call(*arguments: Any) -> Any:
        if _exporting.get() or not _folder():
            return function(*arguments)
        return _exported(function, arguments, settings).call(*jax.tree.leaves(arguments))

    return call


def _exported(function: Callable, arguments: tuple, settings: object) -> export.Exported:
    """The trace of `function` for arguments like these, as one of their leaves."""
    leaves, structure = jax.tree.flatten(arguments)
    shapes = [jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in leaves]
    told = (settings, str(structure), shapes, jax.__version__, jax.default_backend(), code_digest())
    name = f"vrw_trace_{hashlib.sha256(repr(told).encode()).hexdigest()}"
    trace = kept(name)
    exported = None if trace is None else export.deserialize(bytearray(trace))
    if exported is None:
        flat = jax.jit(lambda *leaves: function(*jax.tree.unflatten(structure, leaves)))
        outside = _exporting.set(True)  # what is remembered within is part of this trace
        try:
            exported = export.export(flat)(*shapes)
        finally:
            _exporting.reset(outside)
        keep(name, bytes(exported.serialize()))
    return exported


_exporting: ContextVar[bool] = ContextVar("_exporting", default=False)


def _folder() -> Any:
    return jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]


def kept(name: str) -> bytes | None:
    """What was kept under that name beside JAX's compiled code; None if nothing, or damaged."""
    place = _folder() and Path(_folder()) / name
    if not place or not place.exists():
        return None
    stored = place.read_bytes()
    digest, content = stored[:32], stored[32:]
    return content if hashlib.sha256(content).digest() == digest else None


def keep(name: str, content: bytes) -> None:
    """Written beside its place and renamed; a cache that can't be written is no error."""
    if not _folder():
        return
    place = Path(_folder()) / name
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        handle, unfinished = tempfile.mkstemp(dir=place.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(content).digest() + content)
        os.replace(unfinished, place)
    except OSError:
        return
