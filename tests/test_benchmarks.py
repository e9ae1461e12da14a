"""The benchmarks: rows of the stated shape, and peers that give skyfix's answer, or else a ratio would say nothing."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_translocnet import TINY as TINY_NETWORK

from benchmarks import (
    BENCHMARKS,
    Candidate,
    Case,
    filter_step,
    fixed_lag,
    grid_filter,
    inference,
    markdown_table,
    smoother,
    thread_statement,
    time_case,
    translocnet,
)
from benchmarks.filter_model import cloud, example_volume
from benchmarks.filter_packages import missing_packages, package_candidates
from benchmarks.plots import write_plots
from benchmarks.runner import WARM_UP_RUNS
from benchmarks.training_cost import training_cost
from fusion import GridFilter, ParticleFilter, se2
from learned.bev import BevSettings
from learned.rotmatch import RotMatchNet, RotMatchSettings
from sequences.cli import main

COLUMNS = {"benchmark", "case", "implementation", "size", "seconds_median", "seconds_min", "runs"}
TINY_VOLUME = example_volume(cells=32, bins=36)
TINY_VOTING = RotMatchNet(RotMatchSettings(4, (4, 4, 8, 8), BevSettings(16.0)))
TINY: dict[str, Callable[[], Iterator[Case]]] = {
    "filter_step": lambda: filter_step.cases([50, 200], TINY_VOLUME, [8, 16]),
    "fixed_lag": lambda: fixed_lag.cases([5, 20], 5),
    "grid_filter": lambda: grid_filter.cases([24], headings=64),
    "inference": lambda: inference.cases(TINY_VOTING, position_half_m=4.0, headings=(3,)),
    "smoother": lambda: smoother.cases([5, 20]),
    "translocnet": lambda: translocnet.cases([TINY_NETWORK]),
}


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command with every benchmark at a tiny size."""
    for name, cases in TINY.items():
        monkeypatch.setitem(BENCHMARKS, name, cases)


def skyfix_benchmark(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int | str | None:
    monkeypatch.setattr(sys, "argv", ["skyfix", "benchmark", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return caught.value.code


def test_every_benchmark_is_tried_here() -> None:
    assert set(TINY) == set(BENCHMARKS)


@pytest.mark.parametrize("name", TINY)
def test_rows_have_the_stated_shape(name: str) -> None:
    for case in TINY[name]():
        rows = time_case(name, case, runs=2)
        assert len(rows) == len(case.candidates) >= 2
        assert rows[0]["implementation"].startswith("skyfix")
        assert len({row["implementation"] for row in rows}) == len(rows)
        for row in rows:
            assert set(row) == COLUMNS
            assert (row["benchmark"], row["case"], row["size"], row["runs"]) == (name, case.name, case.size, 2)
            assert 0.0 < row["seconds_min"] <= row["seconds_median"]


def test_runs_take_turns_on_fresh_states_and_only_work_is_on_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    now, seen = [0.0], []
    monkeypatch.setattr("benchmarks.runner.perf_counter", lambda: now[0])

    def candidate(name: str, seconds: Iterator[float]) -> Candidate:
        def prepare() -> Callable[[], object]:
            now[0] += 100.0
            taken = next(seconds)

            def work() -> None:
                seen.append(name)
                now[0] += taken

            return work

        return Candidate(name, prepare)

    warm_up = [50.0] * WARM_UP_RUNS
    slow, quick = candidate("slow", iter([*warm_up, 4.0, 2.0, 9.0])), candidate("quick", iter([*warm_up, 1, 1, 1]))
    rows = time_case("made", Case("up", 7, (slow, quick)), runs=3)
    assert seen == ["slow", "quick"] * (WARM_UP_RUNS + 3)
    assert [(row["seconds_median"], row["seconds_min"]) for row in rows] == [(4.0, 2.0), (1.0, 1.0)]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown_table(rows).splitlines()]
    assert cells[2] == ["made", "up", "7", "slow", "4e+03", "2e+03", "3", "1.00"]
    assert cells[3][-1] == "0.25"


def test_a_run_of_several_steps_is_timed_by_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("benchmarks.runner.perf_counter", lambda: now[0])

    def work() -> None:
        now[0] += 3.0

    rows = time_case("made", Case("again", 7, (Candidate("ours", lambda: work),), steps=4), runs=2)
    assert (rows[0]["seconds_median"], rows[0]["seconds_min"], now[0]) == (3.0, 3.0, 3.0 * 4 * (WARM_UP_RUNS + 2))


def test_a_cloud_all_over_the_crop_stays_there_for_the_steps_that_are_timed() -> None:
    volume, count = filter_step._flat(example_volume()), 2000
    particles = ParticleFilter(cloud(volume, count, spread=True), 0, filter_step.SAME_WORK)
    for _ in range(filter_step.SPREAD_STEPS):
        _, covariance = filter_step.skyfix_step(particles, volume)
    assert (np.sqrt(np.diag(covariance)) > [12.0, 12.0, 1.5]).all()


def test_thread_statement_does_not_claim_one_thread_that_was_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert "on one thread" in thread_statement()
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    assert "NOT held to one thread (OMP_NUM_THREADS=4" in thread_statement()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    assert "OMP_NUM_THREADS is not set" in thread_statement()


@pytest.mark.parametrize("spread", [False, True])
def test_the_filter_s_peers_give_the_same_estimate(spread: bool) -> None:
    """Means within 5 standard errors of sampling, spreads within 15 %: a step left out would be far outside."""
    count = 4000
    particles = cloud(TINY_VOLUME, count, spread)
    candidates = filter_step._steps(particles, TINY_VOLUME)
    answers = {one.implementation: one.prepare()() for one in candidates if not one.implementation.startswith("floor")}
    pose, covariance = answers.pop("skyfix")
    assert len(answers) >= 5
    weights = np.exp(filter_step.NumpyLookup.of(TINY_VOLUME)(particles))
    sigma, size = np.sqrt(np.diag(covariance)), weights.sum() ** 2 / (weights**2).sum()
    for name, (mean, spread_out) in answers.items():
        off = np.array(mean) - pose
        off[2] = se2.wrap(off[2])
        assert (np.abs(off) < 5.0 * np.sqrt(2.0 / size) * sigma + 0.002).all(), name
        np.testing.assert_allclose(np.sqrt(np.diag(spread_out)), sigma, rtol=0.15 + 4.0 / np.sqrt(size), err_msg=name)


def test_packages_that_are_not_installed_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.filter_packages.find_spec", lambda name: None)
    particles = cloud(TINY_VOLUME, 10, spread=False)
    assert list(package_candidates(particles, filter_step.NumpyLookup.of(TINY_VOLUME))) == []
    assert missing_packages() == ["particles", "stonesoup"]


@pytest.mark.parametrize("lookup", [filter_step.ScipyLookup, filter_step.NumpyLookup])
def test_the_peers_lookups_are_the_volume_s_inside_at_the_seam_and_outside(lookup: Any) -> None:
    poses = np.random.default_rng(1).uniform([-10, -10, -np.pi], [10, 10, np.pi], (5000, 3))
    poses[:100, 2] = np.linspace(-0.2, 0.0, 100)  # between the last heading and the first
    values = TINY_VOLUME.log_density(poses)
    assert TINY_VOLUME.floor in values
    np.testing.assert_allclose(lookup.of(TINY_VOLUME)(poses), values, atol=1e-4)


def test_the_grid_filter_s_peer_has_the_same_moments_and_evidence() -> None:
    """scipy's narrow blurs are a little too narrow, and its cells stay in place: 1 % of a deviation, 0.05 nats."""
    volume = grid_filter.example_volume(80, 64)
    ours = GridFilter.from_prior(grid_filter.PRIOR, volume.grid, 64)
    ours.update(volume)
    peer = grid_filter.ScipyFilter.of(ours)
    start, _ = grid_filter.estimate(peer.mass, peer.lattice)
    for _ in range(2):
        evidence, peer_evidence = grid_filter.skyfix_step(ours, volume), peer.step(volume)
        assert evidence == pytest.approx(peer_evidence, abs=0.05)
    pose, covariance = grid_filter.estimate(ours.probabilities, ours.lattice)
    peer_pose, peer_covariance = grid_filter.estimate(peer.mass, peer.lattice)
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(peer_pose / scale, pose / scale, atol=0.01)
    np.testing.assert_allclose(peer_covariance / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.01)
    assert np.linalg.norm((pose - start)[:2]) > 0.3  # it did move


def test_fixed_lag_smoothers_find_the_same_poses() -> None:
    """Over several lags; GTSAM relinearises only what has moved by a tenth."""
    ours, peer = fixed_lag.SkyfixRun(lambda one: one), fixed_lag.GtsamRun()
    whole, kept = fixed_lag.SkyfixRun(smoother.patch_around), fixed_lag.IncrementalRun()
    for size in (1, 90, 210):
        found = ours.after(size).estimate().pose
        np.testing.assert_allclose(found, fixed_lag.truth_at(size), atol=1.5)
        np.testing.assert_allclose(whole.after(size).estimate().pose, found, atol=0.02)
        if size == 210:
            np.testing.assert_allclose(kept.prepare(size - 20)(), found, atol=0.02)
        peer.prepare(size)
        np.testing.assert_allclose(peer.pose, found, atol=0.01)


@pytest.mark.parametrize("nodes", [2, 60])
def test_the_smoother_s_peers_find_the_same_poses(nodes: int) -> None:
    drive = smoother.example_drive(nodes)
    ours = smoother.skyfix_smooth(drive)
    assert ours.converged
    assert (ours.chosen == 0).all()
    peers = (smoother.scipy_least_squares, smoother.scipy_gauss_newton, smoother.gtsam_levenberg_marquardt)
    for peer in peers:
        off = peer(drive) - ours.trajectory.poses
        off[:, 2] = se2.wrap(off[:, 2])
        np.testing.assert_allclose(off, 0.0, atol=1e-4)
    patches = smoother.whole_likelihoods(drive)
    whole = smoother.skyfix_whole(drive, patches).trajectory.poses
    by_callbacks = smoother.gtsam_levenberg_marquardt(drive, patches)
    np.testing.assert_allclose(se2.between(by_callbacks, whole), 0.0, atol=1e-2)
    np.testing.assert_allclose(se2.between(ours.trajectory.poses, whole), 0.0, atol=5e-3)
    moved = drive.start.poses - ours.trajectory.poses
    assert np.linalg.norm(moved[:, :2], axis=1).max() > 0.1  # the start was not the answer


def test_the_jacobian_is_that_of_the_residuals() -> None:
    drive = smoother.example_drive(6)
    problem = smoother.LeastSquares.of(drive)
    x = drive.start.poses.ravel()
    step = 1e-6 * np.eye(len(x))
    numerical = [(problem.residuals(x + h) - problem.residuals(x - h)) / 2e-6 for h in step]
    np.testing.assert_allclose(problem.jacobian(x).toarray(), np.transpose(numerical), atol=1e-4)


def test_the_yardstick_of_the_network_multiplies_as_often() -> None:
    layer, x = torch.nn.Conv2d(3, 8, 3, padding=1), torch.rand(1, 3, 16, 16)
    assert translocnet.multiplications(lambda: layer(x)) == 3 * 8 * 9 * 16 * 16
    work = translocnet.matrix_products(3 * 512**3)
    assert translocnet.multiplications(work) == 3 * 512**3


def test_the_cost_of_training_is_of_this_process() -> None:
    seconds, megabytes = training_cost(TINY_NETWORK, 1, bfloat16=True)
    assert 0.0 < seconds < 60.0
    assert megabytes > 100.0  # torch alone is more


@pytest.mark.usefixtures("tiny")
def test_command_prints_a_table_and_writes_the_rows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "timings.json"
    assert skyfix_benchmark(monkeypatch, "--runs", "1", "--json", str(file)) == 0
    rows = json.loads(file.read_text())
    assert {row["benchmark"] for row in rows} == set(BENCHMARKS)
    assert all(set(row) == COLUMNS for row in rows)
    assert "thread" in (printed := capsys.readouterr()).out.splitlines()[0]
    assert printed.out.endswith(markdown_table(rows))
    assert skyfix_benchmark(monkeypatch, "smoother", "--runs", "1", "--json", str(file)) == 0
    assert {row["benchmark"] for row in json.loads(file.read_text())} == {"smoother"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["nonsense"],
            (
                "benchmark: expected one of filter_step, fixed_lag, grid_filter, inference, smoother, translocnet, "
                "got 'nonsense'"
            ),
        ),
        (["smoother", "--runs", "0"], "runs: expected >= 1, got 0"),
    ],
)
@pytest.mark.usefixtures("tiny")
def test_bad_requests_are_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert skyfix_benchmark(monkeypatch, *arguments) == 2
    assert capsys.readouterr().err == f"skyfix: error: {message}\n"


def test_plots_are_written_beside_the_file(tmp_path: Path) -> None:
    rows = [row for case in TINY["filter_step"]() if case.name.startswith("step") for row in time_case("f", case, 1)]
    written = write_plots(rows, tmp_path / "timings.json")
    assert [path.name for path in written] == ["timings-particles.png", "timings-map.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)
    assert write_plots([row for row in rows if row["size"] < 0], tmp_path / "timings.json") == []
