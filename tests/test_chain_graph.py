"""The compiled chain is GTSAM's graph: steps, covariances, determinants and costs, with calibrations and without."""

import numpy as np
import pytest

from fusion import OdometryDrift, SkyfixError, SmootherSettings, UniformPrior, se2
from fusion.graph.assembly import gtsam_graph, pose_graph
from fusion.graph.chain import Chain
from fusion.graph.chain_graph import ChainGraph
from fusion.graph.inverses import inverses
from fusion.graph.sites import Sites, no_sites

DRIFT = OdometryDrift(stretch_m=10.0)
PRIOR = UniformPrior(np.array([3.0, -2.0, 3.0]), 5.0, 0.5)


def drive(count, seed):
    """A chain with a slip, poses near it, and sites on every third pose, of which one has no precision at all."""
    rng = np.random.default_rng(seed)
    deltas = np.array([1.5, 0.1, 0.2]) + rng.normal(0.0, [0.3, 0.1, 0.1], (count - 1, 3))
    roots = rng.normal(0.0, 0.3, (count - 1, 3, 3)) + np.eye(3)
    scale = np.diag([0.2, 0.1, 0.03])
    covariances = scale @ roots @ roots.swapaxes(1, 2) @ scale
    poses = [np.array([3.0, -2.0, 3.0])]
    for delta in deltas:
        poses.append(se2.compose(poses[-1], delta))
    poses = np.array(poses) + rng.normal(0.0, [0.3, 0.3, 0.05], (count, 3))
    poses[:, 2] = se2.wrap(poses[:, 2])
    if count > 4:
        deltas[count // 2] += [4.0, 1.0, 0.3]
    nodes = np.arange(0, count, 3)
    own = rng.normal(0.0, 1.0, (len(nodes), 3, 3)) * np.array([1.0, 1.0, 0.3])
    precision = own.swapaxes(1, 2) @ own
    precision[1:][-1:] = 0.0
    sites = Sites(
        poses[nodes] + rng.normal(0.0, 0.1, (len(nodes), 3)), precision, rng.normal(0.0, 1.0, (len(nodes), 3))
    )
    return Chain(deltas, covariances), poses, nodes, sites


@pytest.mark.parametrize("count", [1, 2, 3, 40])
@pytest.mark.parametrize("drift", [None, DRIFT])
@pytest.mark.parametrize("kernel", ["none", "huber"])
def test_marginals_determinants_costs_and_the_end_are_gtsams(count, drift, kernel):
    """GTSAM adds a step along its twist, so that the way to the end differs in second order."""
    chain, poses, nodes, sites = drive(count, count)
    settings = SmootherSettings(odometry_kernel=kernel, odometry_kernel_width=1.5, drift=drift)
    graphs = [make(chain, PRIOR, settings) for make in (pose_graph, gtsam_graph)]
    assert isinstance(graphs[0], ChainGraph)
    own, reference = (graph.at(poses, nodes, sites) for graph in graphs)
    np.testing.assert_allclose(own.cost, reference.cost, rtol=1e-10)
    for step in range(20):
        own, reference = (graph.step(at, nodes, sites) for graph, at in zip(graphs, (own, reference), strict=True))
        if step in (0, 19):  # from the same poses
            np.testing.assert_allclose(own.covariances, reference.covariances, rtol=1e-5, atol=1e-8)
            spreads = own.calibration_covariances, reference.calibration_covariances
            np.testing.assert_allclose(*spreads, rtol=1e-5, atol=1e-9)
            np.testing.assert_allclose(own.half_log_det, reference.half_log_det, rtol=1e-8)
    np.testing.assert_allclose(own.poses, reference.poses, atol=1e-6)
    np.testing.assert_allclose(own.calibrations, reference.calibrations, atol=1e-6)
    np.testing.assert_allclose(own.cost, reference.cost, rtol=1e-8)


def test_a_step_that_makes_the_cost_grow_is_halved():
    """From a start that is far off in heading the cost never grows."""
    chain, poses, nodes, sites = drive(30, 5)
    poses[:, 2] = se2.wrap(poses[:, 2] + np.linspace(0.0, 2.5, 30))
    graph = pose_graph(chain, PRIOR, SmootherSettings())
    at, costs = graph.at(poses, nodes, sites), []
    for _ in range(8):
        at = graph.step(at, nodes, sites, marginals=False)
        costs.append(at.cost)
    assert (np.diff(costs) <= 1e-6 * np.abs(costs[:-1])).all()
    assert at.covariances is None


def test_what_cannot_be_solved_is_refused_in_a_line():
    chain, poses, nodes, sites = drive(6, 6)
    graph = pose_graph(chain, PRIOR, SmootherSettings())
    wrong = Sites(sites.reference, sites.precision - 1e6 * np.eye(3), sites.information)
    with pytest.raises(SkyfixError, match=r"^smoother: expected a solvable graph, got one without a unique solution$"):
        graph.step(graph.at(poses, nodes, no_sites(poses[nodes])), nodes, wrong)
    poses[3, 0] = np.nan
    with pytest.raises(SkyfixError, match=r"^smoother: expected"):
        graph.step(graph.at(poses, nodes, sites), nodes, sites)


def test_inverses_are_numpys():
    rng = np.random.default_rng(7)
    matrices = rng.normal(size=(50, 3, 3)) + 3.0 * np.eye(3)
    np.testing.assert_allclose(inverses(matrices), np.linalg.inv(matrices), rtol=1e-9, atol=1e-12)
    assert inverses(np.zeros((0, 3, 3))).shape == (0, 3, 3)
