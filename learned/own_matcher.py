"""A matcher of one's own by name: `mine.py:MyNetwork` from a file, `my_package.networks:MyNetwork` from a module.

The name is of a class or a function that makes the matcher, called without arguments, or of a matcher.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from fusion.errors import SkyfixError
from learned.answers import failure_line
from learned.matcher import MapMatcher

_MEMBERS = ("name", "error_correlation_length_m", "match")


class OwnMatcher(NamedTuple):
    """Where a matcher is: a Python file or an importable module, and the name in it."""

    source: str
    attribute: str

    @property
    def label(self) -> str:
        """What a person calls it: by the file's name and its own."""
        return f"{Path(self.source).stem if self.is_file else self.source}:{self.attribute}"

    @property
    def is_file(self) -> bool:
        """Whether the source is a file and not a module's name."""
        return self.source.endswith(".py")


def own_matcher_named(text: str) -> OwnMatcher | None:
    """What a text such as `mine.py:MyNetwork` names; None for names and files of other kinds."""
    source, colon, attribute = text.rpartition(":")
    if not (colon and attribute.isidentifier()):
        return None
    own = OwnMatcher(source, attribute)
    return own if own.is_file or all(part.isidentifier() for part in source.split(".")) else None


def load_own_matcher(own: OwnMatcher) -> MapMatcher:
    """Import and make it. This runs the file's code, as importing any Python does.

    Raises
    ------
    SkyfixError
        If there is no such file, module or name, it cannot be imported or made, or what is made is no `MapMatcher`.
    """
    made = _made(_imported(own), own)
    missing = [name for name in _MEMBERS if not hasattr(made, name)]
    if missing:
        expected = "name, error_correlation_length_m and match(points, ground_z, map_raster, search)"
        raise SkyfixError(f"matcher {own.label}: expected {expected}, got a {type(made).__name__} without {missing[0]}")
    length_m = made.error_correlation_length_m
    if not (isinstance(length_m, int | float) and math.isfinite(length_m) and length_m >= 0.0):
        raise SkyfixError(f"matcher {own.label}: error_correlation_length_m: expected metres >= 0, got {length_m!r}")
    if not (isinstance(made.name, str) and made.name):
        raise SkyfixError(f"matcher {own.label}: name: expected a text, got {made.name!r}")
    matcher: MapMatcher = made
    return matcher


def _imported(own: OwnMatcher) -> ModuleType:
    path = Path(own.source)
    if own.is_file and not path.is_file():
        raise SkyfixError(f"matcher {own.label}: expected the Python file {path}, found none")
    folder = str(path.resolve().parent if own.is_file else Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)  # what the file imports from beside it, as for `python mine.py`
    try:
        return _from_file(path.resolve()) if own.is_file else importlib.import_module(own.source)
    except (Exception, SystemExit) as error:
        file = str(path.resolve()) if own.is_file else None
        raise SkyfixError(f"matcher {own.label}: cannot be imported: {failure_line(error, file)}") from error


def _from_file(path: Path) -> ModuleType:
    name = f"skyfix_matcher_{path.stem}"
    specification = importlib.util.spec_from_file_location(name, path)
    if specification is None or specification.loader is None:
        raise ImportError(f"{path} cannot be loaded as Python")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # dataclasses look their own module up
    specification.loader.exec_module(module)
    return module


def _made(module: ModuleType, own: OwnMatcher) -> Any:
    maker = getattr(module, own.attribute, None)
    if maker is None:
        there = [name for name, value in vars(module).items() if callable(value) and not name.startswith("_")]
        raise SkyfixError(f"matcher {own.label}: expected {own.attribute} there, got {', '.join(there) or 'nothing'}")
    if not isinstance(maker, type) and hasattr(maker, "match"):
        return maker
    try:
        return maker()
    except Exception as error:
        reason = failure_line(error, module.__file__)
        raise SkyfixError(f"matcher {own.label}: cannot be made without arguments: {reason}") from error
