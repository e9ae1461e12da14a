"""Training samples: a scan's bird's-eye view, the map around the truth, and what augmentation does to them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.errors import SkyfixError
from learned.bev import log_density
from learned.map_raster import CLASS_INDEX, CLASSES, PALETTE

SAMPLE_METRES_PER_PIXEL = 0.5
"""Resolution of a sample's class raster and of its bird's-eye view."""

UNKNOWN_PLACE = (math.nan, math.nan)

_DROPPED_TOGETHER = (
    ("wall", "fence", "hedge"),
    ("tree",),
    ("grass", "forest"),
    ("road",),
    ("path", "parking"),
    ("building",),
)


@dataclass(frozen=True, slots=True)
class Sample:
    """One scan and the class raster around it.

    Attributes
    ----------
    counts
        (bands, n, n) uint8 point counts (capped at 255), body frame.
    classes
        (m, m) uint8 class indices, north up; large enough for every crop that training takes.
    row, col
        Where the vehicle truly is, continuous pixel coordinates of `classes`.
    yaw
        True heading, radians.
    place
        Where it was taken, metres in a frame that all samples share; NaN where that is not known.
    """

    counts: NDArray[np.uint8]
    classes: NDArray[np.uint8]
    row: float
    col: float
    yaw: float
    place: tuple[float, float] = UNKNOWN_PLACE


@dataclass(frozen=True, slots=True)
class Augmentation:
    """How samples are varied; probabilities apply to each sample.

    Attributes
    ----------
    max_offset_px, crop_px
        The crop's side, and how far its middle lies from the vehicle at most.
    drop_class
        Probability that a group of classes is blanked on the map.
    thin, shorten, drop_sector, drop_band
        Probabilities of each impoverishment of the scan.
    half_heading_deg
        The heading known beforehand is uniform within this of the truth; 180: unknown.
    rotate, rotate_deg
        Probability that the map is turned about the vehicle, by an angle uniform within +-rotate_deg.
    colour_jitter
        Brightness, contrast and saturation of the picture are scaled by factors uniform in 1 +- this.
    """

    max_offset_px: int = 40
    crop_px: int = 256
    drop_class: float = 0.12
    thin: float = 0.3
    shorten: float = 0.2
    drop_sector: float = 0.15
    drop_band: float = 0.1
    half_heading_deg: float = 180.0
    rotate: float = 0.0
    rotate_deg: float = 60.0
    colour_jitter: float = 0.0

    def __post_init__(self) -> None:
        for name in ("drop_class", "thin", "shorten", "drop_sector", "drop_band", "rotate", "colour_jitter"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise SkyfixError(f"augmentation {name}: expected 0 to 1, got {getattr(self, name)}")
        for name, largest in (("half_heading_deg", 180.0), ("rotate_deg", 180.0)):
            if not 0.0 <= getattr(self, name) <= largest:
                raise SkyfixError(f"augmentation {name}: expected 0 to {largest:g}, got {getattr(self, name)}")
        if self.max_offset_px < 0 or self.crop_px < 1:
            raise SkyfixError(
                f"augmentation: expected max_offset_px >= 0 and crop_px >= 1, got {self.max_offset_px}, {self.crop_px}"
            )


@dataclass(frozen=True, slots=True)
class Example:
    """What the network is given and what it should find.

    Attributes
    ----------
    density
        (bands, n, n) float32 log densities.
    picture
        (crop, crop, 3) uint8.
    row, col, yaw
        The truth in the crop: continuous pixel coordinates, radians.
    prior_yaw
        The heading that is known beforehand, radians.
    place
        The sample's.
    """

    density: NDArray[np.float32]
    picture: NDArray[np.uint8]
    row: float
    col: float
    yaw: float
    prior_yaw: float
    place: tuple[float, float] = UNKNOWN_PLACE


def augment(sample: Sample, rng: np.random.Generator, settings: Augmentation) -> Example:
    """Turn, mirror, crop and impoverish a sample; deterministic in the generator."""
    counts, classes, row, col, yaw = sample.counts, sample.classes, sample.row, sample.col, sample.yaw
    size = classes.shape[0]
    if rng.random() < 0.5:  # mirror about the east axis: north <-> south on the map, left <-> right of the vehicle
        counts, classes, row, yaw = counts[:, ::-1], classes[::-1], size - row, -yaw
    turns = int(rng.integers(4))
    for _ in range(turns):  # rot90 turns the picture counter-clockwise
        row, col = size - col, row
    classes, yaw = np.rot90(classes, turns), yaw + turns * math.pi / 2
    offset = rng.integers(-settings.max_offset_px, settings.max_offset_px + 1, size=2)
    top, left = (round(v) - settings.crop_px // 2 + int(d) for v, d in zip((row, col), offset, strict=True))
    top, left = (min(max(v, 0), size - settings.crop_px) for v in (top, left))
    density = log_density(_impoverish_scan(counts.astype(np.float32), rng, settings))
    kept = _kept_classes(rng, settings.drop_class)
    # Draws above make up what networks were trained on: new ones go below, so that old runs can be made again.
    prior_yaw = yaw + rng.uniform(-1.0, 1.0) * math.radians(settings.half_heading_deg)
    if settings.rotate > 0 and rng.random() < settings.rotate:
        angle = rng.uniform(-1.0, 1.0) * math.radians(settings.rotate_deg)
        classes, yaw, prior_yaw = _turn_about(classes, row, col, angle), yaw + angle, prior_yaw + angle
    picture = PALETTE[kept[classes[top : top + settings.crop_px, left : left + settings.crop_px]]]
    if settings.colour_jitter > 0:
        picture = _jitter_colours(picture, rng, settings.colour_jitter)
    truth = row - top, col - left, float(se2.wrap(yaw))
    return Example(density, picture, *truth, float(se2.wrap(prior_yaw)), sample.place)


def _turn_about(classes: NDArray[np.uint8], row: float, col: float, angle: float) -> NDArray[np.uint8]:
    """Turn a class raster counter-clockwise about a point, nearest cell; what turns in from outside is void."""
    cos, sin = math.cos(angle), math.sin(angle)
    turned = np.array([[cos, sin], [-sin, cos]])  # in image axes (x right, y down) a turn to the left has this sign
    centre = np.array([col - 0.5, row - 0.5])  # OpenCV has integers at the centres of pixels
    affine = np.column_stack([turned, centre - turned @ centre])
    size = (classes.shape[1], classes.shape[0])
    # The raster is mirrored and turned by views; OpenCV wants it in one piece.
    source = np.ascontiguousarray(classes)
    return np.asarray(cv2.warpAffine(source, affine, size, flags=cv2.INTER_NEAREST, borderValue=0), dtype=np.uint8)


def _jitter_colours(picture: NDArray[np.uint8], rng: np.random.Generator, strength: float) -> NDArray[np.uint8]:
    """Scale brightness, contrast (about the mean grey) and saturation (about each pixel's grey)."""
    brightness, contrast, saturation = 1.0 + rng.uniform(-strength, strength, size=3)
    values = picture.astype(np.float32) * np.float32(brightness)
    grey = values @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    values = grey.mean() + (values - grey.mean()) * np.float32(contrast)
    grey = values @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    values = grey[..., None] + (values - grey[..., None]) * np.float32(saturation)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _kept_classes(rng: np.random.Generator, probability: float) -> NDArray[np.uint8]:
    """Class -> itself or void: whole groups are blanked, so that no class is relied upon alone; draws are as many."""
    lookup = np.arange(len(CLASSES), dtype=np.uint8)
    for group, drawn in zip(_DROPPED_TOGETHER, rng.random(len(_DROPPED_TOGETHER)), strict=True):
        rarer = 0.4 if group == ("building",) else 1.0
        if drawn < probability * rarer:
            lookup[[CLASS_INDEX[name] for name in group]] = CLASS_INDEX["void"]
    return lookup


def _impoverish_scan(
    counts: NDArray[np.float32], rng: np.random.Generator, settings: Augmentation
) -> NDArray[np.float32]:
    """Thin the beams, shorten the range, hide a sector (a lorry alongside), lose a height band."""
    size = counts.shape[-1]
    if rng.random() < settings.thin:
        counts = rng.binomial(counts.astype(np.int64), rng.uniform(0.3, 1.0)).astype(np.float32)
    offsets = np.arange(size) + 0.5 - size / 2
    x, y = np.meshgrid(offsets, -offsets)
    if rng.random() < settings.shorten:
        counts = counts * (np.hypot(x, y) < rng.uniform(0.5, 1.0) * size / 2)
    if rng.random() < settings.drop_sector:
        away = se2.wrap(np.arctan2(y, x) - rng.uniform(-math.pi, math.pi))
        counts = counts * (np.abs(away) > rng.uniform(0.1, 0.5))
    if rng.random() < settings.drop_band:
        counts = counts.copy()
        counts[int(rng.integers(1, len(counts)))] = 0.0
    return np.ascontiguousarray(counts, dtype=np.float32)


def cut_sample(
    counts: NDArray[np.float32], classes: NDArray[np.uint8], row: float, col: float, yaw: float, size: int
) -> Sample:
    """Cut `size` x `size` pixels about the vehicle out of a larger class raster (void outside) and pack the counts."""
    top, left = round(row) - size // 2, round(col) - size // 2
    padded = cv2.copyMakeBorder(
        classes,
        max(0, -top),
        max(0, top + size - classes.shape[0]),
        max(0, -left),
        max(0, left + size - classes.shape[1]),
        cv2.BORDER_CONSTANT,
        value=0,
    )
    cut = padded[max(top, 0) : max(top, 0) + size, max(left, 0) : max(left, 0) + size]
    packed = np.minimum(counts, 255).astype(np.uint8)
    return Sample(packed, np.ascontiguousarray(cut, dtype=np.uint8), row - top, col - left, yaw)
