"""`skyfix sweep`: many drives tracked in many ways, in one table.

Every run has a run directory of its own, as of `skyfix track`; one that is there is not tracked again. Tables and
picture are made anew after every run: they are of use before the last is done. A run that fails is listed with its
reason, and the others go on.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import yaml
from rich.console import Console

from fusion.errors import SkyfixError
from learned.matcher import MapMatcher, load_matcher
from learned.own_matcher import own_matcher_named
from learned.training import make_folder
from sequences.dotted_keys import dotted
from sequences.localize import track
from sequences.progress import ConsoleProgress
from sequences.registry import OpenOptions, open_sequence
from sequences.run_directory import write_run
from sequences.run_files import CONFIG_FILE, METRICS_FILE, config_text, is_run_directory
from sequences.sweep_plan import SweepOptions, SweepRun, plan_runs
from sequences.sweep_tables import write_sweep


def sweep(
    drives: Sequence[Path],
    options: SweepOptions,
    out_dir: Path,
    *,
    jobs: int = 1,
    quiet: bool = False,
    report: Callable[[str], None] = lambda line: None,
) -> Path:
    """Track everything; goes on where it was stopped.

    Parameters
    ----------
    drives
        As `sequences.registry.open_sequence` takes them, with ground truth.
    options
        What is varied.
    out_dir
        Gets runs/DRIVE-ODOMETRY-MATCHER-SETTINGS/seed-N, sweep.md, sweep.json and sweep.png.
    jobs
        So many runs at once, each a process.
    quiet
        No bar of a run's frames; there is none either with several at once.
    report
        Told of every run, as it begins or, with several at once, ends.

    Returns
    -------
    Path of sweep.md.

    Raises
    ------
    SkyfixError
        Before anything is tracked, if the plan is none or `out_dir` holds other runs; afterwards, if runs failed.
    """
    if jobs < 1:
        raise SkyfixError(f"--jobs: expected 1 or more, got {jobs}")
    matchers = {name: load_matcher(name) for name in options.matchers}
    runs = plan_runs(drives, options, out_dir)
    waiting = [run for run in runs if not _is_done(run, matchers[run.matcher])]
    make_folder(out_dir)
    failed: dict[str, str] = {}
    if len(waiting) < len(runs):
        report(f"{len(runs) - len(waiting)} of {len(runs)} runs are there already")
        write_sweep(out_dir, runs, failed)
    for number, (run, reason) in enumerate(_outcomes(waiting, jobs, quiet, report), start=1):
        if reason is not None:
            failed[run.label] = reason
            report(f"{run.label}: failed: {reason}")
        elif jobs > 1:
            report(f"{run.label}: done ({number} of {len(waiting)})")
        write_sweep(out_dir, runs, failed)
    if failed:
        label, reason = next(iter(failed.items()))
        raise SkyfixError(f"{len(failed)} of {len(runs)} runs failed, see {out_dir / 'sweep.md'}; {label}: {reason}")
    return out_dir / "sweep.md"


def _is_done(run: SweepRun, matcher: MapMatcher) -> bool:
    """Whether it is on disk, as it would be made now; SkyfixError if something else is in its place."""
    if not is_run_directory(run.folder):
        return False
    try:
        there = (run.folder / CONFIG_FILE).read_text(encoding="utf-8")
        made_at = (run.folder / METRICS_FILE).stat().st_mtime
        own = own_matcher_named(run.matcher)
        weights = Path(run.matcher if own is None else own.source)
        weights_at = weights.stat().st_mtime if weights.exists() else made_at
    except OSError as error:
        raise SkyfixError(f"{run.folder}: cannot be read: {error.strerror}") from error
    wanted = config_text(run.name, matcher.name, run.settings)
    if there != wanted:
        before, now = (dotted(yaml.safe_load(text)) for text in (there, wanted))
        key = next(key for key in [*now, *before] if before.get(key) != now.get(key))
        raise SkyfixError(
            f"{run.folder}: was tracked with {key} {before.get(key)} and not {now.get(key)}; choose another --out"
        )
    if weights_at > made_at:
        raise SkyfixError(f"{run.folder}: is older than {run.matcher}; choose another --out")
    return True


def _outcomes(
    runs: Sequence[SweepRun], jobs: int, quiet: bool, report: Callable[[str], None]
) -> Iterator[tuple[SweepRun, str | None]]:
    """Every run as it is done, with the reason if it failed."""
    if jobs == 1:
        for number, run in enumerate(runs, start=1):
            report(f"{run.label} ({number} of {len(runs)})")
            yield run, _track(run, quiet)
        return
    threads = max(1, (os.cpu_count() or 1) // jobs)
    fresh = multiprocessing.get_context("spawn")  # forked, a process would have half of torch's threads
    with ProcessPoolExecutor(jobs, fresh, initializer=_use_threads, initargs=(threads,)) as pool:
        futures = {pool.submit(partial(_track, run, quiet=True)): run for run in runs}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _use_threads(threads: int) -> None:
    import torch

    torch.set_num_threads(threads)


def _track(run: SweepRun, quiet: bool) -> str | None:
    """Track a run and write its directory; the reason if that fails."""
    try:
        drive = open_sequence(run.drive, OpenOptions(run.settings.seed))
        with ConsoleProgress(Console(stderr=True, quiet=quiet), run.name) as progress:
            result = track(drive, load_matcher(run.matcher), run.settings, progress)
        write_run(result, run.folder)
    except SkyfixError as error:
        return str(error)
    return None
