"""Does a lost vehicle find back? Kidnappings, starts anywhere and outages on a real drive with real odometry.

    python -m benchmarks.recovery kidnap --sequence drives/kitti_00 --odometry sptam --trials 40 --out kidnap.json
    python -m benchmarks.recovery anywhere --sequence drives/kitti_00
    python -m benchmarks.recovery outage --sequence drives/kitti_00 --odometry stereo_dso_keyframes

A trial is a random piece of the drive, tracked as `skyfix track` does. kidnap: after 60 to 100 m the drive goes on
about 200 m away, and the odometry reports nothing of it; asked is an error below 2 m within 100 m. anywhere: nothing
is known of the start, not even the heading; below 2 m within 300 m. outage: no scan for 300 m of way; below 2 m
within 30 m of its end, and the truth inside the 95 % ellipse during it. With --out every trial is written when it is
done, and a run that was stopped goes on. Scans may be simulated from the map; the table says so.
"""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from benchmarks.command import run
from benchmarks.recovery_drives import IncidentMaker
from benchmarks.recovery_trials import WATCH_M, Trial, make_incident, run_trial, summary
from fusion.errors import SkyfixError
from learned.matcher import load_matcher
from sequences.drive import load_drive
from sequences.registry import OpenOptions, open_sequence
from sequences.track_settings import TrackSettings


class Kind(StrEnum):
    """What goes wrong."""

    kidnap = "kidnap"
    anywhere = "anywhere"
    outage = "outage"


def main(
    kind: Annotated[Kind, typer.Argument(help="What goes wrong.")],
    sequence: Annotated[Path, typer.Option(help="Drive with ground truth.", metavar="DIR")],
    odometry: Annotated[str, typer.Option(help="One of the drive's.", metavar="NAME")] = "sptam",
    trials: Annotated[int, typer.Option(help="How many.", metavar="N")] = 40,
    seed: Annotated[int, typer.Option(help="Of pieces, scans and particles.")] = 0,
    matcher: Annotated[str, typer.Option(help="As for skyfix track.", metavar="NAME|FILE")] = "rotmatch",
    out: Annotated[Path | None, typer.Option(help="Write trials and summary as JSON; resumes.", metavar="FILE")] = None,
) -> None:
    """Run trials and print their table."""
    if trials < 1:
        raise SkyfixError(f"trials: expected >= 1, got {trials}")
    opened = open_sequence(sequence, OpenOptions(seed))
    of: dict[str, Any] = {
        "kind": kind.value,
        "sequence": opened.name,
        "odometry": odometry,
        "matcher": matcher,
        "seed": seed,
    }
    of |= {"scans_simulated": opened.scans_simulated, "watch_map_every_m": WATCH_M[kind.value]}
    done = _resumed(out, of)
    maker, loaded = IncidentMaker(load_drive(opened, odometry)), load_matcher(matcher)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(kind.value, total=trials, completed=min(len(done), trials))
        for number in range(len(done), trials):
            incident = make_incident(kind.value, maker, seed, number)
            settings = TrackSettings("spliced", seed=seed + number, snapshots=0, map_check_every_m=WATCH_M[kind.value])
            done.append(run_trial(kind.value, incident, loaded, settings))
            bar.update(task, completed=number + 1)
            _write(out, of, kind.value, done)
    typer.echo(_table(of, summary(kind.value, done[:trials])), nl=False)


def _resumed(out: Path | None, of: dict[str, Any]) -> list[Trial]:
    """Trials of an earlier run of the same thing."""
    if out is None or not out.exists():
        return []
    try:
        content = json.loads(out.read_text(encoding="utf-8"))
        before, trials = content["of"], content["trials"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SkyfixError(f"{out}: expected trials of this benchmark to go on from, got {error!r}") from error
    if before != of:
        raise SkyfixError(f"{out}: expected trials of {of} to go on from, got {before}")
    return list(trials)


def _write(out: Path | None, of: dict[str, Any], kind: str, trials: list[Trial]) -> None:
    if out is None:
        return
    beside = out.with_name(out.name + ".part")
    content = {"of": of, "summary": summary(kind, trials), "trials": trials}
    beside.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    beside.replace(out)


def _table(of: dict[str, Any], found: dict[str, Any]) -> str:
    scans = "simulated from the map" if of["scans_simulated"] else "measured"
    lines = [f"{of['kind']}: {of['sequence']}, odometry {of['odometry']}, {of['matcher']}, scans {scans}", ""]
    lines += ["| figure | value |", "|---|--:|"]
    for name, value in found.items():
        shown = f"{value:.3g}" if isinstance(value, float) else value if value is not None else "-"
        lines.append(f"| {name.replace('_', ' ')} | {shown} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    run(main, "recovery")
