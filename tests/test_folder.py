"""The folder format: what is written comes back, scans are simulated where there are none, and again the same."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from made_drive import GROUND_Z, MadeDrive, made_scan

from fusion.errors import SkyfixError
from sequences.folder import FolderSequence, write_folder
from sequences.sequence import ScanError


def test_a_folder_is_read_as_it_was_written(made_drive: MadeDrive) -> None:
    sequence = FolderSequence(made_drive.path)
    assert sequence.name == "made_drive"
    assert sequence.ground_z == GROUND_Z
    assert not sequence.scans_simulated
    assert sequence.odometry_names == ("wheels",)
    np.testing.assert_array_equal(sequence.stamps_ns, made_drive.truth.stamp_ns)
    np.testing.assert_array_equal(sequence.scan(7), made_scan(7))
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.poses, made_drive.truth.poses, atol=1e-8)
    np.testing.assert_allclose(sequence.odometry("wheels").poses, made_drive.odometry.poses, atol=1e-8)


def test_any_sequence_can_be_converted(made_drive: MadeDrive, tmp_path: Path) -> None:
    original = FolderSequence(made_drive.path)
    write_folder(tmp_path / "copy", original)
    copy = FolderSequence(tmp_path / "copy")
    assert original.map.classes is not None
    assert copy.map.grid == original.map.grid
    np.testing.assert_array_equal(copy.map.classes, original.map.classes)
    np.testing.assert_array_equal(copy.stamps_ns, original.stamps_ns)
    assert (copy.ground_z, copy.scans_simulated) == (original.ground_z, False)
    assert copy.odometry_names == original.odometry_names
    for index in (0, len(copy.stamps_ns) - 1):
        np.testing.assert_array_equal(copy.scan(index), original.scan(index))
    with pytest.raises(SkyfixError, match="expected a new or empty folder"):
        write_folder(tmp_path / "copy", original)


def test_scans_are_simulated_where_there_are_none_and_stay_marked_so(made_drive: MadeDrive, tmp_path: Path) -> None:
    shutil.rmtree(made_drive.path / "scans")
    (made_drive.path / "sensor.json").unlink()
    sequence = FolderSequence(made_drive.path, seed=5)
    assert sequence.scans_simulated
    np.testing.assert_array_equal(sequence.stamps_ns, made_drive.truth.stamp_ns)
    scan = sequence.scan(3)
    assert scan.dtype == np.float32
    assert len(scan) > 1000
    near = scan[np.hypot(scan[:, 0], scan[:, 1]) < 6.0]
    assert np.median(near[:, 2]) == pytest.approx(sequence.ground_z, abs=0.3)
    write_folder(tmp_path / "kept", sequence)
    kept = FolderSequence(tmp_path / "kept")
    assert kept.scans_simulated
    np.testing.assert_array_equal(kept.scan(3), scan)


def test_a_simulated_scan_depends_on_seed_and_index_alone(made_drive: MadeDrive) -> None:
    shutil.rmtree(made_drive.path / "scans")
    one, other = FolderSequence(made_drive.path, seed=5), FolderSequence(made_drive.path, seed=5)
    later = one.scan(9)
    other.scan(2)
    np.testing.assert_array_equal(other.scan(9), later)
    reseeded = FolderSequence(made_drive.path, seed=6).scan(9)
    assert reseeded.shape != later.shape or not np.array_equal(reseeded, later)


def test_a_bad_scan_is_an_error_of_that_scan_alone(made_drive: MadeDrive) -> None:
    sequence = FolderSequence(made_drive.path)
    broken = made_scan(4)
    broken[17, 1] = np.nan
    broken.tofile(made_drive.scan_file(4))
    made_drive.scan_file(5).write_bytes(b"")
    made_drive.scan_file(6).write_bytes(bytes(33))
    made_drive.scan_file(8).unlink()
    for index, reason in [
        (4, "1 of 200 with NaN"),
        (5, "expected points, got none"),
        (6, "multiple of 16 bytes"),
        (8, "read"),
    ]:
        with pytest.raises(ScanError, match=rf"scan 00000{index}\.bin: .*{reason}"):
            sequence.scan(index)
    assert len(sequence.scan(7)) == 200


def test_truth_may_be_denser_than_the_scans(made_drive: MadeDrive) -> None:
    keep = np.arange(0, len(made_drive.truth), 3)
    lines = (made_drive.path / "scans" / "times.txt").read_text().splitlines()
    (made_drive.path / "scans" / "times.txt").write_text("\n".join(lines[index] for index in keep) + "\n")
    for index in range(len(keep), len(made_drive.truth)):
        made_drive.scan_file(index).unlink()
    sequence = FolderSequence(made_drive.path)
    assert sequence.ground_truth is not None
    assert len(sequence.stamps_ns) == len(keep)
    at_scans = sequence.ground_truth.interpolate(sequence.stamps_ns)
    np.testing.assert_allclose(at_scans, made_drive.truth.poses[keep], atol=1e-8)


def test_what_a_folder_must_have(made_drive: MadeDrive) -> None:
    path = made_drive.path
    (path / "sensor.json").write_text(json.dumps({"height": 1.7}))
    with pytest.raises(SkyfixError, match=r"sensor\.json: ground_z: expected a finite number, got None"):
        FolderSequence(path)
    (path / "sensor.json").unlink()
    with pytest.raises(SkyfixError, match=r"sensor\.json: cannot be read"):
        FolderSequence(path)
    shutil.rmtree(path / "scans")
    (path / "ground_truth.tum").unlink()
    with pytest.raises(SkyfixError, match=r"expected scans/, or ground_truth\.tum to simulate scans at, found neither"):
        FolderSequence(path)


def test_scans_of_a_vehicle_off_the_map_cannot_be_simulated(made_drive: MadeDrive) -> None:
    shutil.rmtree(made_drive.path / "scans")
    truth = (made_drive.path / "ground_truth.tum").read_text().splitlines()
    stamp = float(truth[-1].split()[0]) + 1.0
    (made_drive.path / "ground_truth.tum").write_text("\n".join([*truth, f"{stamp} 500 0 0 0 0 0 1"]) + "\n")
    sequence = FolderSequence(made_drive.path)
    with pytest.raises(ScanError, match="outside the map"):
        sequence.scan(len(sequence.stamps_ns) - 1)
