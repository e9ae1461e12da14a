"""A cloud of weighted particles as the compiled step keeps it: float32, relative to an anchor, moved when asked for.

Moving, resampling and its kernel noise are written down when they are ordered and carried out by the next pass over
the particles, which is that of the next measurement, or of whoever looks at the cloud. The random numbers depend on
the key, on the number of the order and on the particle, so looking changes nothing.
"""

from math import cos, log, pi, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import Float32Array, FloatArray
from fusion.kernels import layout as at
from fusion.kernels.cloud_clusters import gather_copies
from fusion.kernels.moments import arc_blocks, combined
from fusion.kernels.step import step_blocks
from fusion.particles.arrangement import arrange, is_spread_out
from fusion.particles.lookup import NO_TABLE, NO_TABLES, Lookup
from fusion.particles.moments import Moments, lower_root, motion_root, wrapped
from fusion.particles.regularisation import cluster_kernels, silverman_bandwidth
from fusion.particles.shared_work import find_ancestors, share

_REACH_M = 64.0  # the anchor follows the cloud when its mean is farther away
_NOBODY = np.zeros(0, np.int32)
_STAY = np.zeros(0)
_EQUAL = np.zeros(0)
_STILL = [0.0] * at.MOTION_SIZE
_NOT_WEIGHED = [0.0] * at.WEIGH_SIZE
_WHOLE_CIRCLE = pi - 1e-5


class Cloud:
    """N weighted particles.

    Parameters
    ----------
    poses : (N, 3) float64
        x, y, yaw in the map frame, yaw wrapped.
    log_weights : (N,) float64 or None
        Up to a constant; None for equal ones.
    key : (4,) uint32
        Of the random numbers.
    threads : int
        How many share the work; the result does not depend on it.
    """

    def __init__(
        self, poses: FloatArray, log_weights: FloatArray | None, key: NDArray[np.uint32], threads: int = 1
    ) -> None:
        self._key, self._threads, self._epoch = key, threads, 0
        self._spare: dict[str, NDArray[Any]] = {}
        self.replace(poses, log_weights)

    def replace(
        self, poses: FloatArray, log_weights: FloatArray | None, anchor: tuple[float, float] | None = None
    ) -> None:
        """Go on with other particles, relative to an anchor or to where they are."""
        centre = np.rint(poses[:, :2].mean(axis=0)) if anchor is None else np.array(anchor)
        self._anchor = (float(centre[0]), float(centre[1]))
        xyt = np.empty((3, len(poses)), np.float32)
        xyt[:2] = (poses[:, :2] - centre).T
        np.clip(poses[:, 2], -pi, pi, out=xyt[2], casting="same_kind")
        self._xyt: Float32Array = xyt.reshape(-1)
        self._count = len(poses)
        self._log_weights = _EQUAL if log_weights is None else log_weights - log_weights.max()
        self._shift = 0.0
        self._ancestors = _NOBODY
        self._labels, self._clusters = _NOBODY, NO_TABLE
        self._motion: list[float] | None = None
        self._weights, self._sums = np.zeros(0, np.float32), np.zeros((0, at.SUMS))
        self._reference = (0.0, 0.0, float(poses[0, 2]))
        self._moments: Moments | None = self._pass(None, 0.0)
        self._reference = self._moments.mean

    def resume(self, poses: FloatArray, log_weights: FloatArray, anchor: FloatArray, moments: Moments) -> None:
        """Go on with particles that stand for given moments, as a cloud that was resampled stands for its own."""
        x, y = anchor.tolist()
        is_equal = bool((log_weights == log_weights[0]).all())
        self.replace(poses, None if is_equal else log_weights, (x, y))
        self._moments = moments

    def rekey(self, key: NDArray[np.uint32], epoch: int = 0) -> None:
        """Draw what is ordered from here on with another key."""
        self._settle()
        self._key, self._epoch = key, epoch

    def __len__(self) -> int:
        return self._count

    @property
    def key(self) -> NDArray[np.uint32]:
        """Of the random numbers."""
        return self._key

    @property
    def epoch(self) -> int:
        """Number of orders that have used the key."""
        return self._epoch

    @property
    def anchor(self) -> tuple[float, float]:
        """What positions are relative to."""
        return self._anchor

    def poses(self) -> FloatArray:
        """Poses (N, 3) float64 in the map frame."""
        self._settle()
        xyt = self._xyt.reshape(3, -1).astype(np.float64)
        xyt[0] += self._anchor[0]
        xyt[1] += self._anchor[1]
        np.copyto(xyt[2], -pi, where=(xyt[2] >= pi) | (xyt[2] < -pi))
        return np.ascontiguousarray(xyt.T)

    def log_weights(self) -> FloatArray:
        """Normalised log weights (N,)."""
        self._settle()
        if len(self._log_weights) == 0:
            return np.full(self._count, -log(self._count))
        return self._log_weights - self._log_total

    def moments(self) -> Moments:
        """Moments of the prediction or of the posterior; resampling, which only adds noise, leaves them as they are."""
        if self._moments is None:
            self._moments = self._pass(None, 0.0)
        return self._moments

    def move(self, delta: list[float], covariance: list[list[float]]) -> None:
        """Order a motion: an increment and its covariance, on the axes of every particle's body."""
        if self._motion is not None and self._motion[at.MOVED] > 0.0:
            self._settle()
        motion = self._order()
        motion[at.DELTA : at.DELTA + 3] = delta
        motion[at.ROOT : at.ROOT + 9] = motion_root(covariance)
        motion[at.MOVED] = 1.0
        self._moments = None

    def weigh(self, lookup: Lookup, outlier_probability: float) -> float:
        """Carry out all orders, weigh by a likelihood and give the log evidence."""
        before = self._log_total - self._shift
        self._moments = self._pass(lookup, outlier_probability)
        self._reference = self._moments.mean
        return self._log_total - before

    def add_log_likelihood(self, log_likelihood: FloatArray) -> float:
        """Weigh by ln densities (N,) of the particles as they are now and give the log evidence."""
        self._settle()
        before = self._log_total - self._shift
        known = self._log_weights if len(self._log_weights) else np.zeros(self._count)
        self._log_weights = (known - self._shift) + log_likelihood
        largest = self._shift = float(self._log_weights.max())
        self._moments = self._pass(None, 0.0)
        self._reference = self._moments.mean
        return self._log_total + largest - before

    def resample(self, count: int, offset: float) -> None:
        """Order systematic resampling to `count` equally weighted particles."""
        self._settle()
        ancestors = self._buffer("ancestors", count, np.int32)
        find_ancestors(self._threads, self._weights, self._sums, offset, ancestors)
        self.keep(ancestors)

    def keep(self, ancestors: NDArray[np.int32]) -> None:
        """Order the copies `ancestors` (n,) with equal weights in place of the cloud; they stand for its moments."""
        self._settle()
        if len(self._log_weights):
            self._spare["log weights"] = self._log_weights
        self._ancestors, self._count = ancestors, len(ancestors)
        self._log_weights, self._shift, self._log_total = _EQUAL, 0.0, log(len(ancestors))
        self._epoch += 1

    def arrange(self) -> None:
        """Put the copies just ordered in the order of their places, if that is worth it: it means nothing else."""
        if is_spread_out(self._count, self.moments()):
            tiles, ordered = (self._buffer(name, self._count, np.int32) for name in ("tiles", "ordered"))
            arrange(self._threads, self._xyt, self._ancestors, self.moments(), tiles, ordered)
            self._spare["tiles"], self._spare["ordered"] = tiles, self._ancestors
            self._ancestors = ordered

    def regularise(self, width: float) -> None:
        """Order kernel noise of `width` standard deviations, with shrinkage, on top of resampling."""
        moments, motion = self.moments(), self._order()
        motion[at.CENTRE : at.CENTRE + 3] = moments.mean
        motion[at.SHRINK] = sqrt(1.0 - width * width)
        motion[at.KERNEL_ROOT : at.KERNEL_ROOT + 9] = [width * value for value in lower_root(moments.covariance)]
        motion[at.KIND] = at.ONE_KERNEL

    def regularise_in_clusters(self, scale: float) -> None:
        """Order kernel noise of `scale` times Silverman's bandwidth for each cluster of what resampling has kept."""
        if len(self._ancestors):
            gathered = self._buffer("cloud", 3 * self._count, np.float32)
            gather_copies(self._xyt, self._ancestors, gathered)
            self._spare["cloud"], self._xyt = self._xyt, gathered
            self._spare["ancestors"], self._ancestors = self._ancestors, _NOBODY
        found = cluster_kernels(self._xyt, scale)
        if found is None:
            self.regularise(scale * silverman_bandwidth(self._count, 3))
        else:
            self._labels, self._clusters = found
            self._order()[at.KIND] = at.CLUSTER_KERNELS

    def _order(self) -> list[float]:
        if self._motion is None:
            self._motion = _STILL.copy()
        return self._motion

    def _settle(self) -> None:
        """Carry out what has been ordered."""
        if self._motion is not None or len(self._ancestors):
            moments = self._pass(None, 0.0)
            if self._moments is None:
                self._moments = moments

    def _pass(self, lookup: Lookup | None, outlier_probability: float) -> Moments:
        """Carry out the orders in one pass, weigh if there is a lookup, and give the moments."""
        source, ancestors, before = self._xyt, self._ancestors, self._log_weights
        order = self._order() if len(ancestors) else self._motion
        cloud, motion = source, _STAY
        if order is not None:
            self._go_on(order)
            cloud, motion = self._buffer("cloud", 3 * self._count, np.float32), np.array(order)
        out = self._buffer("log weights", self._count, np.float64)
        weigh = _NOT_WEIGHED if lookup is None else lookup.arguments(self._anchor, outlier_probability)
        look = np.array((*weigh, *self._reference, self._shift))
        sums = self._step(source, motion, cloud, lookup, look, out)
        if order is not None:
            self._spare["cloud"], self._xyt = source, cloud
            if len(ancestors):
                self._spare["ancestors"] = ancestors
            self._epoch += order[at.MOVED] > 0.0
            self._ancestors = self._labels = _NOBODY
            self._clusters, self._motion = NO_TABLE, None
        if lookup is not None or len(before):
            self._spare["log weights"], self._log_weights = before, out
        else:
            self._spare["log weights"] = out
        return self._summary(sums, weigh, look)

    def _go_on(self, motion: list[float]) -> None:
        """Move the reference pose along, and the anchor when the cloud has left it behind.

        The anchor moves with the cloud only: whoever looks at a cloud that has been resampled finds the moments that
        are known already relative to the same anchor.
        """
        x, y, yaw = self._reference
        dx, dy, turn = motion[at.DELTA : at.DELTA + 3]
        if motion[at.MOVED] > 0.0 and (abs(x) > _REACH_M or abs(y) > _REACH_M):
            east, north = (float(round(at)) if abs(at) > _REACH_M else 0.0 for at in (x, y))
            motion[at.SHIFT : at.SHIFT + 2] = east, north
            self._anchor = (self._anchor[0] + east, self._anchor[1] + north)
            x, y = x - east, y - north
        along, across = cos(yaw), sin(yaw)
        self._reference = (x + along * dx - across * dy, y + across * dx + along * dy, wrapped(yaw + turn))

    def _step(
        self,
        source: Float32Array,
        motion: FloatArray,
        cloud: Float32Array,
        lookup: Lookup | None,
        look: FloatArray,
        out: FloatArray,
    ) -> tuple[float, ...]:
        blocks = -(-self._count // at.BLOCK)
        if len(self._sums) != blocks:
            self._sums = np.zeros((blocks, at.SUMS))
        if len(self._weights) != self._count:
            self._weights = np.empty(self._count, np.float32)
        ordered = (source, self._ancestors, self._labels, self._clusters, motion, self._key, self._epoch, cloud)
        weigh = NO_TABLES if lookup is None else (lookup.mode, lookup.table, lookup.location, lookup.slots)
        summed = (look, self._log_weights, out, self._weights, self._sums)
        share(self._threads, step_blocks, blocks, *ordered, *weigh, *summed)
        return combined(self._sums, look)

    def _summary(self, sums: tuple[float, ...], weigh: list[float], look: FloatArray) -> Moments:
        """Moments from the sums; about the mean itself where the reference was too far from it to be accurate."""
        x, y, yaw = self._reference
        if (sums[3] - x) ** 2 > 1e3 * sums[6] or (sums[4] - y) ** 2 > 1e3 * sums[8]:
            x, y, yaw = self._reference = sums[3], sums[4], wrapped(yaw + sums[5])
            look = np.array((*weigh, x, y, yaw, 0.0))
            weights = self._log_weights
            out = weights if len(weights) else self._buffer("log weights", self._count, np.float64)
            sums = self._step(self._xyt, _STAY, self._xyt, None, look, out)
            if len(weights) == 0:
                self._spare["log weights"] = out
        if sums[12] + abs(sums[5]) >= _WHOLE_CIRCLE:
            low, high = (-4.0, sums[5] - pi) if sums[5] > 0.0 else (sums[5] + pi, 4.0)
            share(self._threads, arc_blocks, len(self._sums), self._xyt, self._weights, look, low, high, self._sums)
            sums = combined(self._sums, look)
        largest, self._log_total, size, x, y, turned, xx, xy, yy, xt, yt, tt, _ = sums
        self._shift = largest if len(self._log_weights) else 0.0
        return Moments(size, (x, y, wrapped(yaw + turned)), [[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])

    def _buffer(self, name: str, size: int, kind: Any) -> NDArray[Any]:
        """Memory that was used before, when it has the right size: fresh memory costs more than the step."""
        spare = self._spare.pop(name, None)
        return spare if spare is not None and len(spare) == size else np.empty(size, kind)
