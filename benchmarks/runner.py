"""Timing: fresh state for every run, a warm-up, then median and least wall-clock time of runs taken in turns."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from statistics import median
from time import perf_counter
from typing import TypedDict

WARM_UP_RUNS = 2
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Row(TypedDict):
    """One line of the result, as it is written to the file."""

    benchmark: str
    case: str
    implementation: str
    size: int
    seconds_median: float
    seconds_min: float
    runs: int


@dataclass(frozen=True, slots=True)
class Candidate:
    """One implementation.

    Parameters
    ----------
    implementation
        What it is, for a person; says too where it does less or more than the others.
    prepare
        Called before every run, outside the clock; gives the work to time, on a state that no run has touched.
    """

    implementation: str
    prepare: Callable[[], Callable[[], object]]


@dataclass(frozen=True, slots=True)
class Case:
    """Implementations of the same work on the same input; the first is the one that the others are measured against.

    A run does the work `steps` times in a row; the times are those of one.
    """

    name: str
    size: int
    candidates: tuple[Candidate, ...]
    steps: int = 1


def time_case(benchmark: str, case: Case, runs: int) -> list[Row]:
    """Rows of one case, in the order of its candidates; `runs` is at least 1."""
    seconds: list[list[float]] = [[] for _ in case.candidates]
    for _ in range(WARM_UP_RUNS + runs):
        for taken, candidate in zip(seconds, case.candidates, strict=True):
            work = candidate.prepare()
            start = perf_counter()
            for _ in range(case.steps):
                work()
            taken.append((perf_counter() - start) / case.steps)
    return [
        Row(
            benchmark=benchmark,
            case=case.name,
            implementation=candidate.implementation,
            size=case.size,
            seconds_median=median(taken[WARM_UP_RUNS:]),
            seconds_min=min(taken[WARM_UP_RUNS:]),
            runs=runs,
        )
        for taken, candidate in zip(seconds, case.candidates, strict=True)
    ]


def thread_statement() -> str:
    """How many threads the numerical libraries were given, in one line."""
    limits = {name: os.environ[name] for name in _THREAD_VARIABLES if name in os.environ}
    if limits.get("OMP_NUM_THREADS") == "1":
        return "Wall-clock time on one thread (OMP_NUM_THREADS=1)."
    given = ", ".join(f"{name}={value}" for name, value in limits.items()) or "OMP_NUM_THREADS is not set"
    return f"Wall-clock time, NOT held to one thread ({given}): `make benchmark` holds it."


def markdown_table(rows: list[Row]) -> str:
    """Rows as Markdown; the last column is the median over that of the case's first implementation."""
    header = ["benchmark", "case", "size", "implementation", "median ms", "min ms", "runs", "time ratio"]
    lines = ["| " + " | ".join(header) + " |", "|---|---|--:|---|--:|--:|--:|--:|"]
    for _, group in groupby(rows, key=lambda row: (row["benchmark"], row["case"], row["size"])):
        reference: float | None = None
        for row in group:
            reference = reference or row["seconds_median"]
            cells = [row["benchmark"], row["case"], str(row["size"]), row["implementation"]]
            cells += [f"{1e3 * row['seconds_median']:.3g}", f"{1e3 * row['seconds_min']:.3g}", str(row["runs"])]
            lines.append("| " + " | ".join([*cells, f"{row['seconds_median'] / reference:.2f}"]) + " |")
    return "\n".join(lines) + "\n"
