"""Which reader opens a path. `skyfix track`, `evaluate` and `convert` open what any of them recognises.

Another package adds a reader by an entry point of the group `skyfix.sequences` that is a `Reader`:

    [project.entry-points."skyfix.sequences"]
    mine = "my_package.reader:READER"

Such readers are asked first. What nobody recognises is opened as a folder in skyfix's own format, whose errors say what
it expected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path

from fusion.errors import SkyfixError
from sequences.frame_set import FrameSet
from sequences.sequence import Sequence

GROUP = "skyfix.sequences"


@dataclass(frozen=True, slots=True)
class OpenOptions:
    """What a reader may need besides the path.

    Attributes
    ----------
    seed
        Of scans that are simulated and odometry that is emulated.
    allow_pickle
        Scans may be unpickled, which runs code of their author.
    """

    seed: int = 0
    allow_pickle: bool = False


@dataclass(frozen=True, slots=True)
class Reader:
    """A format.

    Attributes
    ----------
    name
        Short name.
    recognises
        Whether a path looks like this format; quick, and never raises.
    open
        Open a path; raises `SkyfixError` with one line when it cannot.
    """

    name: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, OpenOptions], Sequence | FrameSet]


def open_any(path: Path, options: OpenOptions | None = None) -> Sequence | FrameSet:
    """Open a path with the first reader that recognises it; `demo` is the embedded drive.

    Raises
    ------
    SkyfixError
        If the reader cannot open it, or one that another package adds cannot be loaded.
    """
    options = options or OpenOptions()
    for reader in (*_added(), *_built_in()):
        if reader.recognises(path):
            return reader.open(path, options)
    return _open_folder(path, options)


def open_sequence(path: Path, options: OpenOptions | None = None) -> Sequence:
    """Open a drive; `SkyfixError` also when the path holds single frames, which are no drive."""
    opened = open_any(path, options)
    if isinstance(opened, FrameSet):
        raise SkyfixError(f"{path}: expected a drive, got single frames with a map each; `skyfix evaluate` takes them")
    return opened


def _added() -> Iterator[Reader]:
    for point in entry_points(group=GROUP):
        try:
            reader = point.load()
        except Exception as error:  # another package's code
            raise SkyfixError(f"reader {point.name!r}: cannot be loaded from {point.value}: {error}") from error
        if not isinstance(reader, Reader):
            raise SkyfixError(f"reader {point.name!r}: expected a Reader at {point.value}, got {type(reader).__name__}")
        yield reader


def _built_in() -> tuple[Reader, ...]:
    from sequences.carla import CarlaRoute, is_carla_route
    from sequences.kitti import KittiDrive, is_kitti_drive
    from sequences.kitti_crossview import KittiCrossview
    from sequences.kitti_odometry import KittiOdometrySequence, is_kitti_odometry

    return (
        Reader("demo", lambda path: path == Path("demo"), _open_demo),
        Reader("folder", lambda path: (path / "map.json").is_file(), _open_folder),
        Reader("kitti", is_kitti_drive, lambda path, options: KittiDrive(path, options.seed)),
        Reader("kitti_odometry", is_kitti_odometry, lambda path, options: KittiOdometrySequence(path, options.seed)),
        Reader("carla", is_carla_route, lambda path, options: CarlaRoute(path, options.seed, options.allow_pickle)),
        Reader("kitti_crossview", _is_list, lambda path, options: KittiCrossview(path)),
    )


def _is_list(path: Path) -> bool:
    return path.suffix == ".txt" and path.is_file()


def _open_demo(path: Path, options: OpenOptions) -> Sequence:
    from sequences.demo import DemoSequence

    return DemoSequence(options.seed)


def _open_folder(path: Path, options: OpenOptions) -> Sequence:
    from sequences.folder import FolderSequence

    return FolderSequence(path, options.seed)
