"""The command `skyfix emulate`; `sequences.cli` lists it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from fusion.errors import SkyfixError
from sequences.cli_options import JsonOption, PickleOption, SeedOption, write_json, write_text


def emulate(
    sequence: Annotated[Path, typer.Argument(help="Any drive with ground truth that track opens.", metavar="SEQUENCE")],
    odometry: Annotated[
        str | None, typer.Option(help="As for track. Default: the first that is not emulated.", metavar="NAME")
    ] = None,
    profile: Annotated[
        str,
        typer.Option(help="Whose published errors the measurements have: translocnet, fg2 or orienternet."),
    ] = "translocnet",
    correlation: Annotated[
        float,
        typer.Option(help="Of a measurement's error with the next one's, from 0 to below 1; the filter knows it."),
    ] = 0.0,
    measure_every_m: Annotated[
        float, typer.Option(help="A measurement every so many metres of odometry; 0: every frame.", metavar="M")
    ] = 4.0,
    particles: Annotated[int, typer.Option(help="How many particles the filter has.", metavar="N")] = 2000,
    seed: SeedOption = 0,
    allow_pickle: PickleOption = False,
    json_file: JsonOption = None,
    markdown_file: Annotated[
        Path | None, typer.Option("--markdown", help="Also write the tables to this file.", metavar="FILE")
    ] = None,
) -> None:
    """Fuse a drive's odometry with EMULATED measurements of a network with published errors: no network, no map.

    They are drawn about the ground truth. The second table is of a second run, with the odometry's errors as the
    first has found them, without the truth.
    """
    from fusion.emulation.error_profile import FG2_KITTI_SAME_AREA, ORIENTERNET_KITTI_SEQUENTIAL, TRANSLOCNET_KITTI
    from fusion.emulation.likelihood_emulator import EmulatorSettings
    from sequences.cli_track import default_odometry
    from sequences.drive import load_drive
    from sequences.emulated_run import EmulatedRunSettings, run_emulated
    from sequences.registry import OpenOptions, open_sequence
    from sequences.sequence import odometry_is_emulated

    profiles = {
        "translocnet": TRANSLOCNET_KITTI,
        "fg2": FG2_KITTI_SAME_AREA,
        "orienternet": ORIENTERNET_KITTI_SEQUENTIAL,
    }
    if profile not in profiles:
        raise SkyfixError(f"--profile: expected one of {', '.join(profiles)}, got {profile!r}")
    settings = EmulatedRunSettings(
        profiles[profile],
        EmulatorSettings(step_correlation=correlation),
        seed=seed,
        particles=particles,
        kept_particles=particles,
        measure_every_m=measure_every_m,
    )
    opened = open_sequence(sequence, OpenOptions(seed, allow_pickle))
    name = odometry or default_odometry(opened)
    truth = load_drive(opened, name).truth
    if truth is None:
        raise SkyfixError(f"{opened.name}: expected ground truth to draw measurements about, found none")
    path = opened.odometry(name)
    first = run_emulated(truth, path, settings)
    second = run_emulated(truth, path, replace(settings, calibration=first.filter_calibration))
    drifting = f"{name} (emulated from the truth)" if odometry_is_emulated(name) else name
    tables = (
        f"{opened.name}, odometry {drifting}, seed {seed}: {first.table()}\n"
        "Once more with the odometry's errors as that run has found them, without the truth\n\n"
        f"{opened.name}, odometry {drifting}, seed {seed}: {second.table()}"
    )
    typer.echo(tables, nl=False)
    write_json(json_file, {"emulated": first.name, "first": first.metrics, "calibrated": second.metrics})
    write_text(markdown_file, tables)
