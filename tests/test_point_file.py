"""Scans in the formats that point clouds are kept in: all read as the same points, broken ones are one line."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_drive import MadeDrive
from pypcd4 import Encoding, PointCloud

from fusion.errors import SkyfixError
from sequences.folder import FolderSequence
from sequences.point_file import read_points
from sequences.sequence import ScanError

POINTS = np.random.default_rng(0).uniform(0.0, 1.0, (60, 4)).astype(np.float32)
Write = Callable[[Path, np.ndarray, str], None]


def write_npy(path: Path, points: np.ndarray, reflectance: str) -> None:
    np.save(path, points)


def write_pcd(encoding: Encoding) -> Write:
    def write(path: Path, points: np.ndarray, reflectance: str) -> None:
        names = ("x", "y", "z", reflectance)[: points.shape[1]]
        cloud = PointCloud.from_points(points, names, (np.float32,) * points.shape[1])
        cloud.save(path, encoding=encoding)

    return write


def write_ply(kind: str) -> Write:
    def write(path: Path, points: np.ndarray, reflectance: str) -> None:
        names = ("x", "y", "z", reflectance)[: points.shape[1]]
        lines = ["ply", f"format {kind} 1.0", f"element vertex {len(points)}", *(f"property float {n}" for n in names)]
        body = points.astype("<f4" if "little" in kind else ">f4").tobytes()
        if kind == "ascii":
            body = "".join(" ".join(repr(float(value)) for value in point) + "\n" for point in points).encode()
        path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + body)

    return write


FORMATS = {
    "npy": (".npy", write_npy),
    "pcd ascii": (".pcd", write_pcd(Encoding.ASCII)),
    "pcd binary": (".pcd", write_pcd(Encoding.BINARY)),
    "pcd compressed": (".pcd", write_pcd(Encoding.BINARY_COMPRESSED)),
    "ply ascii": (".ply", write_ply("ascii")),
    "ply little": (".ply", write_ply("binary_little_endian")),
    "ply big": (".ply", write_ply("binary_big_endian")),
}


@pytest.fixture(params=FORMATS)
def form(request: pytest.FixtureRequest) -> tuple[str, Write]:
    return FORMATS[request.param]


def test_points_come_back(form: tuple[str, Write], tmp_path: Path) -> None:
    suffix, write = form
    for number, reflectance in enumerate(("intensity", "reflectivity")):
        path = tmp_path / f"{number}{suffix}"
        write(path, POINTS, reflectance)
        found = read_points(path)
        assert (found.shape, found.dtype) == ((60, 4), np.float32)
        np.testing.assert_allclose(found, POINTS, atol=1e-6)


def test_points_without_reflectance_have_none_and_missing_returns_are_left_out(
    form: tuple[str, Write], tmp_path: Path
) -> None:
    suffix, write = form
    bare = POINTS[:, :3].copy()
    bare[::2, 1] = np.nan
    write(tmp_path / f"a{suffix}", bare, "")
    found = read_points(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(found[:, :3], bare[1::2], atol=1e-6)
    assert (found[:, 3] == 0.0).all()


def test_reflectance_of_bytes_is_divided_by_their_largest(form: tuple[str, Write], tmp_path: Path) -> None:
    suffix, write = form
    write(tmp_path / f"a{suffix}", POINTS * [1.0, 1.0, 1.0, 255.0], "intensity")
    np.testing.assert_allclose(read_points(tmp_path / f"a{suffix}"), POINTS, atol=1e-5)


def test_a_folder_may_hold_them_instead(form: tuple[str, Write], made_drive: MadeDrive) -> None:
    suffix, write = form
    expected = [FolderSequence(made_drive.path).scan(index) for index in (0, 7)]
    for index in range(30):
        points = read_points(made_drive.scan_file(index))
        write(made_drive.scan_file(index).with_suffix(suffix), points, "intensity")
        made_drive.scan_file(index).unlink()
    sequence = FolderSequence(made_drive.path)
    for index, points in zip((0, 7), expected, strict=True):
        np.testing.assert_allclose(sequence.scan(index), points, atol=1e-5)
    made_drive.scan_file(3).with_suffix(suffix).unlink()
    with pytest.raises(SkyfixError, match=rf"expected 30 files, .* but 000003\{suffix} is missing \(1 in all\)"):
        FolderSequence(made_drive.path)


def test_missing_returns_of_a_bin_are_left_out_and_other_numbers_refused(tmp_path: Path) -> None:
    missing = np.insert(POINTS.astype(np.float32), 1, [np.nan, np.nan, np.nan, 0.0], axis=0)
    missing.tofile(tmp_path / "a.bin")
    np.testing.assert_array_equal(read_points(tmp_path / "a.bin"), POINTS.astype(np.float32))
    for wrong in (np.where(np.arange(4) == 1, np.nan, POINTS), POINTS * [np.inf, 1.0, 1.0, 1.0]):
        wrong.astype(np.float32).tofile(tmp_path / "a.bin")
        with pytest.raises(ScanError, match="expected finite points"):
            read_points(tmp_path / "a.bin")
    np.full((3, 4), np.nan, np.float32).tofile(tmp_path / "a.bin")
    with pytest.raises(ScanError, match="expected points, got none"):
        read_points(tmp_path / "a.bin")


@pytest.mark.parametrize("suffix", [".bin", ".npy"])
def test_coordinates_that_cannot_be_metres_are_refused(tmp_path: Path, suffix: str) -> None:
    millimetres = (np.array([[25.0, 1.0, 0.0, 0.5]]) * [1e3, 1e3, 1e3, 1.0]).astype(np.float32)
    write = {".bin": millimetres.tofile, ".npy": lambda path: np.save(path, millimetres)}[suffix]
    write(tmp_path / f"a{suffix}")
    strays = np.repeat(POINTS[:1], 1000, axis=0).astype(np.float32)
    strays[3, 0] = 65_535.0
    strays.tofile(tmp_path / "stray.bin")
    assert len(read_points(tmp_path / "stray.bin")) == 1000
    strays[:30, 0] = 65_535.0
    strays.tofile(tmp_path / "stray.bin")
    with pytest.raises(ScanError, match="expected metres about the sensor"):
        read_points(tmp_path / "stray.bin")
    with pytest.raises(ScanError, match=r"expected metres about the sensor.*2\.5e\+04"):
        read_points(tmp_path / f"a{suffix}")


def test_a_folder_of_two_formats_is_refused(made_drive: MadeDrive) -> None:
    np.save(made_drive.path / "scans" / "000030.npy", POINTS)
    with pytest.raises(SkyfixError, match=r"scans: expected files of one format, got \.bin and \.npy"):
        FolderSequence(made_drive.path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.bin", b"12345", r"scan a\.bin: expected a multiple of 16 bytes"),
        ("a.npy", b"12345", r"scan a\.npy: cannot be read as \.npy: "),
        ("a.pcd", b"\xbf12345", r"scan a\.pcd: cannot be read as \.pcd: "),
        ("a.ply", b"12345", r"scan a\.ply: cannot be read as \.ply: "),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n2\n", r"scan a\.ply: "),
        ("none.ply", None, r"scan none\.ply: cannot be read"),
    ],
)
def test_broken_files_are_one_line(tmp_path: Path, name: str, content: bytes | None, message: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ScanError, match=message) as caught:
        read_points(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_truncated_cloud_is_one_line(tmp_path: Path) -> None:
    for suffix, write in FORMATS.values():
        path = tmp_path / f"a{suffix}"
        write(path, POINTS, "intensity")
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(ScanError, match=rf"scan a\{suffix}: ") as caught:
            read_points(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (POINTS[:, :2], r"expected an array \(N, 3\) or \(N, 4\) of numbers, got \(60, 2\) float32"),
        (np.array(["a"]), r"expected an array \(N, 3\) or \(N, 4\) of numbers"),
        (np.full((5, 3), np.nan), "expected points, got none that is finite"),
        (np.zeros((0, 4)), "expected points, got none that is finite"),
        (np.array([[{}, 1, 2]], dtype=object), r"cannot be read as \.npy: "),
    ],
)
def test_arrays_that_are_no_scan_are_named(tmp_path: Path, points: np.ndarray, message: str) -> None:
    np.save(tmp_path / "a.npy", points, allow_pickle=True)
    with pytest.raises(ScanError, match=message):
        read_points(tmp_path / "a.npy")


@pytest.mark.parametrize(("suffix", "package"), [(".pcd", "pypcd4"), (".ply", "trimesh")])
def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, package: str) -> None:
    (tmp_path / f"a{suffix}").write_bytes(b"")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(SkyfixError, match=rf"{suffix} needs the package {package}: pip install 'skyfix\[clouds\]'"):
        read_points(tmp_path / f"a{suffix}")
