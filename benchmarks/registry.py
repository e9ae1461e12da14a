"""The benchmarks by name, and the loop over them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from benchmarks import filter_step, fixed_lag, grid_filter, inference, smoother, translocnet
from benchmarks.runner import Case, Row, time_case
from fusion.errors import SkyfixError

BENCHMARKS: dict[str, Callable[[], Iterator[Case]]] = {
    "filter_step": filter_step.cases,
    "fixed_lag": fixed_lag.cases,
    "grid_filter": grid_filter.cases,
    "inference": inference.cases,
    "smoother": smoother.cases,
    "translocnet": translocnet.cases,
}
"""From a benchmark's name to its cases at their full sizes."""


def run_benchmarks(name: str | None, runs: int, progress: Callable[[str], None] = lambda line: None) -> list[Row]:
    """Time one benchmark, or all of them.

    Parameters
    ----------
    name
        A key of `BENCHMARKS`; None for all.
    runs
        Timed runs of each implementation.
    progress
        Is told in a line what is timed next.

    Raises
    ------
    SkyfixError
        If there is no benchmark of that name, or `runs` is not positive.
    """
    if name is not None and name not in BENCHMARKS:
        raise SkyfixError(f"benchmark: expected one of {', '.join(BENCHMARKS)}, got {name!r}")
    if runs < 1:
        raise SkyfixError(f"runs: expected >= 1, got {runs}")
    rows: list[Row] = []
    for benchmark in BENCHMARKS if name is None else [name]:
        for case in BENCHMARKS[benchmark]():
            progress(f"{benchmark}: {case.name}, size {case.size}")
            rows += time_case(benchmark, case, runs)
    return rows
