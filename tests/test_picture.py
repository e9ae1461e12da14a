"""Pictures from files: eight bits a colour, and one line about anything else."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fusion.errors import SkyfixError
from sequences.picture import read_indices, read_photograph


def test_a_photograph_has_three_colours_however_it_is_stored(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (3, 4, 3), dtype=np.uint8)
    Image.fromarray(rgb).save(tmp_path / "rgb.png")
    Image.fromarray(np.dstack([rgb, np.full((3, 4), 7, np.uint8)])).save(tmp_path / "rgba.png")
    Image.fromarray(rgb[..., 0]).save(tmp_path / "grey.png")
    for name in ("rgb", "rgba"):
        np.testing.assert_array_equal(read_photograph(tmp_path / f"{name}.png"), rgb)
    np.testing.assert_array_equal(read_photograph(tmp_path / "grey.png"), np.repeat(rgb[..., :1], 3, axis=2))
    np.testing.assert_array_equal(read_indices(tmp_path / "grey.png"), rgb[..., 0])


@pytest.mark.parametrize("kind", [np.uint16, np.int32, np.float32])
def test_a_deeper_photograph_is_refused_and_not_cut_off(tmp_path: Path, kind: type) -> None:
    path = tmp_path / "deep.tif"
    Image.fromarray(np.full((3, 4), 40_000, kind)).save(path)
    with pytest.raises(SkyfixError, match=r"deep\.tif: expected 8 bits a colour, got an image of mode [IF]"):
        read_photograph(path)


def test_what_is_no_picture_is_named(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("nothing")
    for read in (read_photograph, read_indices):
        with pytest.raises(SkyfixError, match=r"text\.png: cannot be read: not a readable image"):
            read(tmp_path / "text.png")
        with pytest.raises(SkyfixError, match=r"none\.png: cannot be read: No such file"):
            read(tmp_path / "none.png")


def test_indices_are_given_as_they_are_stored(tmp_path: Path) -> None:
    deep = np.array([[0, 300], [65_535, 1]], np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    np.testing.assert_array_equal(read_indices(tmp_path / "deep.png"), deep)


def test_a_picture_that_is_far_too_large_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.fromarray(np.zeros((30, 40), np.uint8)).save(tmp_path / "large.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    for read in (read_photograph, read_indices):
        with pytest.raises(SkyfixError, match=r"large\.png: .*1200 pixels"):
            read(tmp_path / "large.png")
