"""The one-channel scan image: bands, size, and which way it turns."""

import math

import numpy as np
import pytest
import torch

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.bev import BODY, FACADE, GROUND, BevSettings, bev_counts, log_density
from learned.scan_image import heading_bin, scan_image


def density_of(points: list[tuple[float, float, float]], settings: BevSettings) -> torch.Tensor:
    scan = np.array([[x, y, z, 0.0] for x, y, z in points for _ in range(10)], dtype=np.float32)
    return torch.from_numpy(log_density(bev_counts(scan, -1.7, settings)))[None]


@pytest.mark.parametrize("yaw_deg", [0, 30, 90, 160, -100, 180, -45])
@pytest.mark.parametrize("size", [40, 64])
def test_a_point_lies_where_the_pose_puts_it_on_the_map(yaw_deg: float, size: int) -> None:
    """The image of a vehicle at (0, 0, yaw), as a raster of the map about it, in every quadrant."""
    yaw, body = math.radians(yaw_deg), np.array([6.25, 2.25])
    image = scan_image(density_of([(*body, 0.8)], BevSettings(12.0, 0.5)), torch.tensor([yaw]), size)[0, 0].numpy()
    grid = MapGrid(size, size, 0.5, -size / 4, -size / 4)
    x = math.cos(yaw) * body[0] - math.sin(yaw) * body[1]
    y = math.sin(yaw) * body[0] + math.cos(yaw) * body[1]
    rows, cols = np.nonzero(image > 0)
    weights = image[rows, cols]
    centre = grid.xy_from_pixel(np.stack([rows, cols], 1) + 0.5)
    np.testing.assert_allclose((weights[:, None] * centre).sum(axis=0) / weights.sum(), [x, y], atol=0.05)


def test_bands_above_the_ground_are_counted_together() -> None:
    counts = np.zeros((1, 4, 4, 4), np.float32)
    counts[0, BODY, 1, 2], counts[0, FACADE, 1, 2], counts[0, GROUND, 1, 2], counts[0, GROUND, 3, 3] = 3, 4, 9, 9
    image = scan_image(torch.from_numpy(log_density(counts)), torch.zeros(1), 4)[0, 0]
    assert float(image[1, 2]) == pytest.approx(math.log1p(7) / 3, rel=1e-5)
    assert int((image > 1e-6).sum()) == 1


@pytest.mark.parametrize("size", [4, 8, 12])
def test_scans_are_cut_or_padded_about_the_vehicle(size: int) -> None:
    density = torch.zeros(1, 4, 8, 8)
    density[0, BODY, 3, 3] = 0.5  # left of and behind the vehicle, which stands on a corner of this pixel
    image = scan_image(density, torch.zeros(1), size)[0, 0]
    assert image.shape == (size, size)
    assert float(image[size // 2 - 1, size // 2 - 1]) == pytest.approx(0.5, rel=1e-5)
    assert int((image > 1e-6).sum()) == 1


def test_every_scan_of_a_batch_is_turned_by_its_own_heading() -> None:
    density = torch.rand(3, 4, 8, 8)
    yaw = torch.tensor([0.0, 1.0, math.pi / 2])
    together = scan_image(density, yaw, 8)
    for k in range(3):
        torch.testing.assert_close(together[k], scan_image(density[k : k + 1], yaw[k : k + 1], 8)[0])
    unturned = scan_image(density, torch.zeros(3), 8)
    torch.testing.assert_close(together[2, 0], torch.rot90(unturned[2, 0]), atol=1e-5, rtol=0)


def test_heading_bins_are_nearest_and_wrap() -> None:
    yaw = torch.tensor([0.0, 0.04, -0.04, -0.3, 6.27, -math.pi, 3 * math.pi], dtype=torch.float64)
    assert heading_bin(yaw, 72).tolist() == [0, 0, 0, 69, 0, 36, 36]


def test_bad_scans_are_one_line() -> None:
    density = torch.zeros(2, 4, 8, 8)
    density[1, 2, 3, 4] = math.nan
    with pytest.raises(SkyfixError, match="scan density: expected finite values, got 1 of 512 not finite"):
        scan_image(density, torch.zeros(2), 8)
    with pytest.raises(SkyfixError, match=r"scan density: expected \(B, 4, n, n\), got \(1, 3, 8, 8\)"):
        scan_image(torch.zeros(1, 3, 8, 8), torch.zeros(1), 8)
    with pytest.raises(SkyfixError, match="expected an even number of cells, got 7 for 8"):
        scan_image(torch.zeros(1, 4, 7, 7), torch.zeros(1), 8)
