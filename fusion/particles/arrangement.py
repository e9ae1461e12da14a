"""When and how the particles of a cloud are put in the order of their places.

The order of particles means nothing to a filter, and a lot to a processor: a cloud all over a map reads cells of a
likelihood that are in no cache. So when such a cloud is resampled its copies are lined up by tiles of the map.
Systematic resampling from a cloud in order also varies less.

Source: Gerber, Chopin, Whiteley, "Negative association, ordering and convergence of resampling methods", Annals of
Statistics 47, 2019.
"""

from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import Float32Array
from fusion.kernels.layout import BLOCK
from fusion.kernels.places import SIDE, find_tiles, sort_by_tile
from fusion.particles.moments import Moments
from fusion.particles.shared_work import share

LEAST_PARTICLES = 8192
LEAST_VOLUME = 500.0
"""m^2 rad. What lies within two standard deviations is half a megabyte at half a metre and a degree."""


def is_spread_out(count: int, moments: Moments) -> bool:
    """Whether `count` particles with such moments are worth being put in order."""
    (xx, _, _), (_, yy, _), (_, _, tt) = moments.covariance
    return count >= LEAST_PARTICLES and 16.0 * sqrt(xx * yy) * min(4.0 * sqrt(tt), 2.0 * pi) >= LEAST_VOLUME


def arrange(
    threads: int,
    cloud: Float32Array,
    ancestors: NDArray[np.int32],
    moments: Moments,
    tiles: NDArray[np.int32],
    ordered: NDArray[np.int32],
) -> None:
    """Write the copies `ancestors` (N,) of a cloud (3 M,) into `ordered` (N,), place by place; `tiles` (N,) is scratch.

    The moments are those of the copies.
    """
    half_x, half_y = 2.0 * sqrt(moments.covariance[0][0]), 2.0 * sqrt(moments.covariance[1][1])
    x, y, _ = moments.mean
    box = np.array((x - half_x, y - half_y, 0.5 * SIDE / half_x, 0.5 * SIDE / half_y))
    share(threads, find_tiles, -(-len(ancestors) // BLOCK), cloud, ancestors, box, tiles)
    sort_by_tile(ancestors, tiles, ordered)
