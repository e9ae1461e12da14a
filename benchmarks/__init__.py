"""Benchmarks of skyfix beside peers that do the same work in the same run; `skyfix benchmark` prints and writes them.

Every case is timed in turns, one run of each implementation after the other, so that a busy machine slows all alike.
"""

from benchmarks.registry import BENCHMARKS, run_benchmarks
from benchmarks.runner import Candidate, Case, Row, markdown_table, thread_statement, time_case

__all__ = [
    "BENCHMARKS",
    "Candidate",
    "Case",
    "Row",
    "markdown_table",
    "run_benchmarks",
    "thread_statement",
    "time_case",
]
