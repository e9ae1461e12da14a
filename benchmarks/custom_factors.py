"""Whole likelihoods in GTSAM's own optimizer by way of `CustomFactor`: a callback into Python a factor and iteration.

What a user of GTSAM would write first. Every callback looks its likelihood up at the pose that it is given, by the
same code as skyfix's smoother does for all poses at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from fusion import se2
from fusion.arrays import FloatArray
from fusion.graph.measurements import Measurements
from fusion.graph.patch import LikelihoodPatch

_OUTLIER_PROBABILITY = 1e-6
_WINDOW = np.diag([0.4, 0.4, np.deg2rad(1.0)]) ** 2


def add_likelihoods(graph: gtsam.NonlinearFactorGraph, patches: Sequence[LikelihoodPatch]) -> None:
    """One factor a pose, keys from 0 on."""
    unit = gtsam.noiseModel.Unit.Create(3)
    for node, patch in enumerate(patches):
        graph.add(gtsam.CustomFactor(unit, [node], _error(patch)))


def _error(patch: LikelihoodPatch) -> Callable[[gtsam.CustomFactor, gtsam.Values, list[FloatArray] | None], FloatArray]:
    one = Measurements([patch], _OUTLIER_PROBABILITY, 0.0)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        at = values.atPose2(this.keys()[0])
        pose = np.array([at.x(), at.y(), at.theta()])
        precision, information = (part[0] for part in one.windowed(pose[None], _WINDOW[None])[0].factors())
        root = np.linalg.cholesky(precision)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(root.T @ se2.rotation(pose[2]))
        return -np.asarray(np.linalg.solve(root, information))

    return error
