"""The command `skyfix bag`; `sequences.cli` lists it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def bag(
    source: Annotated[
        Path, typer.Argument(help="ROS 1 .bag file, or folder of a ROS 2 bag (.db3 or .mcap).", metavar="BAG")
    ],
    target: Annotated[Path, typer.Argument(help="Folder of the drive: new, or with a map alone.", metavar="DIR")],
    scans: Annotated[
        str | None, typer.Option(help="Topic of the scans (PointCloud2). Default: the only one.", metavar="TOPIC")
    ] = None,
    odometry: Annotated[
        list[str] | None,
        typer.Option(
            help="Topic of an odometry (Odometry, PoseStamped); may be repeated. Default: all.", metavar="TOPIC"
        ),
    ] = None,
    every: Annotated[int, typer.Option(help="Keep every so many scans.", metavar="N")] = 1,
    frame: Annotated[
        str | None,
        typer.Option(
            help="Bring the scans to this frame (x forward, z up). Default: the odometry's body, if /tf_static says "
            "how the sensor is mounted on it, else the sensor.",
            metavar="NAME",
        ),
    ] = None,
    ground_z: Annotated[
        float | None,
        typer.Option(
            help="Height of the ground in that frame, metres. Default: estimated from the scans.", metavar="M"
        ),
    ] = None,
) -> None:
    """Write scans and odometry of a ROS bag as a drive's folder; `skyfix map` then adds its map.

    Takes the package rosbags (`pip install 'skyfix[ros]'`), and no ROS.
    """
    from rich.console import Console
    from rich.progress import Progress, TextColumn, TimeElapsedColumn

    from sequences.bag_folder import BagRequest, write_bag_folder
    from sequences.rosbag import open_bag

    request = BagRequest(scans, tuple(odometry) if odometry else None, every, frame, ground_z)
    columns = TextColumn("{task.completed} scans"), TimeElapsedColumn()
    with open_bag(source) as opened, Progress(*columns, console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task("scans", total=None)
        content = write_bag_folder(opened, target, request, lambda count: shown.update(task, completed=count))
    typer.echo(f"{target}: {content.scans} scans in frame {content.frame}, the ground at z {content.ground_z:g} m")
    for name, length_m in content.odometry.items():
        typer.echo(f"odometry {name}: {length_m:.0f} m")
    if content.skipped:
        print(f"{content.skipped} scans left out: unreadable, or not later than the one before", file=sys.stderr)
    if not content.mounted:
        print(
            f"the odometry is of another body and /tf_static does not say how {content.frame} is mounted on it: taken "
            "to point the same way",
            file=sys.stderr,
        )
    if not content.odometry:
        print(f"the bag has no odometry: put one at {target / 'odometry'}/NAME.tum", file=sys.stderr)
    at = "LAT LON" if content.first_fix is None else "{:.6f} {:.6f}".format(*content.first_fix)
    typer.echo(f"next, its map: skyfix map EXTRACT {target} --origin {at}")
