"""How an experiment is called, and what it says where a package is missing."""

import argparse
import importlib
import sys
from pathlib import Path
from types import ModuleType

import vrw_jax as vrw

EXTRA = 'pip install -e ".[experiments]"'


def make_parser(doc: str | None) -> argparse.ArgumentParser:
    """A parser that tells the script's own docstring."""
    spec = sys.modules["__main__"].__spec__
    return argparse.ArgumentParser(
        f"python -m {spec.name}" if spec else None,
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def parse_and_start_jax(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """What is asked for, and JAX as the library's users start it."""
    chosen = parser.parse_args()
    vrw.start_jax()
    return chosen


def parse_folder_and_start_jax(doc: str | None) -> Path:
    """The folder that a script writes to: the one given, or `results`."""
    parser = make_parser(doc)
    parser.add_argument("folder", type=Path, nargs="?", default="results")
    return parse_and_start_jax(parser).folder


def require_extra(name: str, install: str = EXTRA) -> ModuleType:
    """A package that the library does without, or one sentence that says how to get it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as missing:
        raise SystemExit(f"This experiment needs {missing.name}: {install}") from None
