"""Small scenes of wall blocks seen by a vehicle among them, and what every voting network has to do with them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from fusion import se2
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from learned.bev import BANDS_M, BevSettings, log_density
from learned.calibration import Calibration
from learned.losses import HeadingQuadrature
from learned.map_raster import CLASS_INDEX, PALETTE, MapRaster
from learned.matcher import SearchRegion, load_matcher
from learned.network import Architecture, Batch, LocalizationNet, NetworkMatcher, picture_tensor

BEV = BevSettings(half_extent_m=16.0)
CROP_PX = 96
BLIND_NLL = math.log(((CROP_PX - BEV.size) * BEV.metres_per_pixel) ** 2 * 2 * math.pi)
"""Negative log density of a pose that may be anywhere in the crop and head anywhere."""


@dataclass(frozen=True)
class Scene:
    """Counts (bands, n, n), classes (m, m), and where the vehicle stands: continuous pixels and yaw."""

    counts: np.ndarray
    classes: np.ndarray
    row: float
    col: float
    yaw: float

    @property
    def raster(self) -> MapRaster:
        """The map, its lower left corner at the origin."""
        return MapRaster.from_classes(MapGrid(CROP_PX, CROP_PX, BEV.metres_per_pixel, 0.0, 0.0), self.classes)

    @property
    def pose(self) -> np.ndarray:
        """(3,), map frame."""
        return np.array([*self.raster.grid.xy_from_pixel((self.row, self.col)), self.yaw])


def scene(seed: int, yaw: float | None = None, blocks: int = 14) -> Scene:
    """Blocks 2 m wide at random places around the vehicle; the ground between them returns too."""
    rng = np.random.default_rng(seed)
    row, col = CROP_PX / 2 + rng.uniform(-10, 10, 2)
    yaw = float(rng.uniform(-math.pi, math.pi)) if yaw is None else yaw
    n, cells = BEV.size, np.arange(CROP_PX) + 0.5
    classes = np.zeros((CROP_PX, CROP_PX), np.uint8)
    counts = np.zeros((len(BANDS_M), n, n), np.float32)
    counts[0] = 3.0
    for ahead, left in rng.uniform(-n / 2 - 8, n / 2 + 8, (blocks, 2)):
        top = row - (math.sin(yaw) * ahead + math.cos(yaw) * left)
        side = col + (math.cos(yaw) * ahead - math.sin(yaw) * left)
        classes[np.hypot(cells[:, None] - top, cells[None, :] - side) < 2.2] = CLASS_INDEX["wall"]
        v, u = n / 2 - left - (np.arange(n) + 0.5), n / 2 + ahead - (np.arange(n) + 0.5)
        block = np.hypot(v[:, None], u[None, :]) < 2.2
        counts[1:3, block], counts[0, block] = 30.0, 0.0
    return Scene(counts, classes, float(row), float(col), yaw)


def batch_of(scenes: list[Scene]) -> Batch:
    """The scenes side by side."""
    row, col, yaw = (
        torch.tensor([getattr(one, name) for one in scenes], dtype=torch.float64) for name in ("row", "col", "yaw")
    )
    density = torch.from_numpy(np.stack([log_density(one.counts) for one in scenes]))
    return Batch(density, torch.stack([picture_tensor(PALETTE[one.classes]) for one in scenes]), row, col, yaw, yaw)


def matched(matcher: NetworkMatcher, one: Scene, half_extent_m: float = 5.0) -> LikelihoodVolume:
    """The likelihood over a square about a place near the vehicle's, all headings."""
    search = SearchRegion(one.pose + [1.0, -1.5, 0.0], half_extent_m)
    return matcher.match_counts(one.counts, one.raster, search)


def assert_finds(matcher: NetworkMatcher, one: Scene, metres: float, degrees: float) -> None:
    """The highest mode is at the true pose."""
    best = matched(matcher, one).modes(1).means[0]
    assert np.hypot(*(best - one.pose)[:2]) < metres
    assert abs(se2.wrap(best[2] - one.yaw)) < math.radians(degrees)


QUICK = HeadingQuadrature(fine=5, fine_step_deg=4.0, coarse=6)
"""Few headings, which is enough for a scene or two."""
QUADRANTS = tuple(math.radians(degrees) for degrees in (40.0, 125.0, -140.0, -35.0))


def fit(net: LocalizationNet, batch: Batch, steps: int, learning_rate: float = 1e-2) -> list[float]:
    """Train on one batch; the total loss of every step."""
    optimizer = torch.optim.Adam(net.parameters(), lr=learning_rate)
    net.train()
    totals = []
    for step in range(steps):
        total = net.losses(batch, torch.Generator().manual_seed(step))["total"]
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(float(total.detach()))
    net.eval()
    return totals


def assert_gradients_reach_everything(net: torch.nn.Module, batch: Batch) -> None:
    """Every parameter's gradient is finite and not zero."""
    net.zero_grad()
    net.losses(batch, torch.Generator().manual_seed(1))["total"].backward()
    missed = [name for name, p in net.named_parameters() if p.grad is None or not float(p.grad.abs().max()) > 0]
    assert missed == []
    assert all(bool(torch.isfinite(p.grad).all()) for p in net.parameters())


def assert_a_batch_is_the_sum_of_its_parts(net: torch.nn.Module, batch: Batch) -> None:
    """`truth_nll` of a batch is that of its examples one by one, each told its place in the step."""
    net.eval()
    with torch.inference_mode():
        together = net.truth_nll(batch, torch.Generator().manual_seed(3))
        one_by_one = []
        for index in range(len(batch)):
            images = (batch.density[index : index + 1], batch.picture[index : index + 1])
            truth = (values[index : index + 1] for values in (batch.row, batch.col, batch.yaw, batch.prior_yaw))
            one_by_one.append(net.truth_nll(Batch(*images, *truth, first=index), torch.Generator().manual_seed(3)))
    torch.testing.assert_close(together, torch.cat(one_by_one), rtol=1e-4, atol=1e-4)


def assert_refuses_bad_images(net: torch.nn.Module, matcher: NetworkMatcher, one: Scene) -> None:
    """Images of a wrong size and scans with NaN give one line that says what was expected."""
    batch = batch_of([one])
    cases = [
        (batch.density[:, :, :-2], batch.picture, r"scan image: expected \(B, 4, 64, 64\), got \(1, 4, 62, 64\)"),
        (batch.density[:, :3], batch.picture, r"scan image: expected \(B, 4, 64, 64\), got \(1, 3, 64, 64\)"),
        (batch.density, batch.picture[:, :, :90], r"map image: expected .* multiples of 16 .* got \(1, 3, 90, 96\)"),
        (batch.density, batch.picture[:, :, :48, :48], "at least 64"),
        (batch.density * torch.nan, batch.picture, "scan image: expected finite values"),
        (batch.density, batch.picture * torch.inf, "map image: expected finite values"),
    ]
    for density, picture, message in cases:
        broken = Batch(density, picture, batch.row, batch.col, batch.yaw, batch.yaw)
        with pytest.raises(SkyfixError, match=message) as caught:
            net.losses(broken, torch.Generator())
        assert "\n" not in str(caught.value)
    counts = one.counts.copy()
    counts[1, 3, 4] = np.nan
    search = SearchRegion(one.pose, 5.0)
    with pytest.raises(SkyfixError, match="scan image: expected finite values"):
        matcher.match_counts(counts, one.raster, search)
    points = np.full((10, 4), np.nan, np.float32)
    with pytest.raises(SkyfixError, match="scan: expected finite coordinates"):
        matcher.match(points, -1.7, one.raster, search)


def assert_checkpoint_round_trip(architecture: Architecture, net: LocalizationNet, one: Scene, folder: Path) -> None:
    """A saved network loads as a matcher that says the same."""
    from learned.checkpoint import save_network

    calibration = Calibration(1.7, 9.0)
    path = folder / "net.safetensors"
    save_network(path, architecture, net, calibration, {"seed": 4})
    again, before = load_matcher(str(path)), architecture.matcher(net, calibration)
    assert again.name == before.name == architecture.name
    assert again.error_correlation_length_m == 9.0
    np.testing.assert_array_equal(matched(again, one).log_prob, matched(before, one).log_prob)
