"""Same numbers whether the kernels were compiled in this process or loaded: a rule on how they call one another."""

import importlib
import pkgutil
from collections.abc import Iterator
from types import ModuleType

import numba
import pytest
from numba.core.registry import CPUDispatcher

import fusion
import learned
import sequences

_OF_OUR_OWN = ("fusion.", "learned.", "sequences.")


def compiled_functions() -> Iterator[CPUDispatcher]:
    """Every function that Numba compiles, once, from the module that it is written in."""
    for package in (fusion, learned, sequences):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if found.name.endswith("__main__"):
                continue
            try:
                module = importlib.import_module(found.name)
            except ModuleNotFoundError as missing:  # an extra that is not installed
                if str(missing.name).startswith(_OF_OUR_OWN):
                    raise
                continue
            yield from functions_of(module)


def functions_of(module: ModuleType) -> Iterator[CPUDispatcher]:
    for value in vars(module).values():
        if isinstance(value, CPUDispatcher) and value.py_func.__module__ == module.__name__:
            yield value


def called_by(function: CPUDispatcher) -> list[CPUDispatcher]:
    """What a function's code names that is compiled too."""
    named = (function.py_func.__globals__.get(name) for name in function.py_func.__code__.co_names)
    return [value for value in named if isinstance(value, CPUDispatcher)]


def broken_by(function: CPUDispatcher) -> list[str]:
    """Functions of free rounding that this one calls and that stay functions of their own."""
    return [
        f"{function.py_func.__qualname__} calls {callee.py_func.__module__}.{callee.py_func.__qualname__}"
        for callee in called_by(function)
        if callee.targetoptions.get("fastmath") and not is_inlined(callee)
    ]


def is_inlined(function: CPUDispatcher) -> bool:
    return bool(function.targetoptions.get("forceinline")) or function.targetoptions.get("inline") == "always"


def test_no_kernel_of_free_rounding_is_called_by_another() -> None:
    """The callee would exist twice, rounded in two ways; a process takes the one that it happens to have loaded."""
    functions = list(compiled_functions())
    assert len(functions) > 40
    assert [line for function in functions for line in broken_by(function)] == []


@numba.njit(fastmath=True)
def _apart(x: float) -> float:
    return x + 1.0


@numba.njit(fastmath=True, forceinline=True)
def _inlined(x: float) -> float:
    return x + 1.0


@numba.njit
def _calls_both(x: float) -> float:
    return float(_apart(x) + _inlined(x))


def test_the_rule_finds_what_breaks_it() -> None:
    assert broken_by(_calls_both) == [f"_calls_both calls {__name__}._apart"]


@pytest.mark.parametrize("options", [{}, {"fastmath": True}])
def test_functions_that_call_nothing_compiled_keep_the_rule(options: dict[str, bool]) -> None:
    assert broken_by(numba.njit(**options)(_apart.py_func)) == []
