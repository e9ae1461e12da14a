"""One trial of a recovery: track a drive that goes wrong, and say when the estimate was right again."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import chi2, rankdata

from benchmarks.recovery_drives import Incident, IncidentMaker
from fusion.arrays import BoolArray, FloatArray
from fusion.odometry import increments_at
from learned.matcher import MapMatcher
from sequences.drive import load_drive
from sequences.filter_pass import FilterPass
from sequences.start import start_prior
from sequences.track_settings import TrackSettings

RIGHT_M = 2.0
"""An estimate this near to the truth is right."""
LOST_M = 5.0
"""A frame with a larger error is a lost one."""
STAY_M = {"kidnap": 10.0, "anywhere": 50.0, "outage": 10.0}
"""It is right again when it has stayed so for so many metres."""
ALLOWED_M = {"kidnap": 100.0, "anywhere": 300.0, "outage": 30.0}
WATCH_M = {"kidnap": 4.0, "anywhere": 0.0, "outage": 0.0}
"""A scan is compared with the whole map every so many metres, as with `skyfix track --watch-map-every`."""
_JUMP_M = 200.0
_BEFORE_M, _BLIND_M = 80.0, 300.0

Trial = dict[str, Any]


def make_incident(kind: str, maker: IncidentMaker, seed: int, trial: int) -> Incident:
    """Trial number `trial` of a kind."""
    rng = np.random.default_rng([seed, trial])
    end_m = ALLOWED_M[kind] + STAY_M[kind]
    if kind == "kidnap":
        return maker.kidnapping(rng, _JUMP_M, end_m)
    if kind == "anywhere":
        return maker.anywhere(rng, end_m)
    return maker.outage(rng, _BEFORE_M, _BLIND_M, end_m)


def run_trial(kind: str, incident: Incident, matcher: MapMatcher, settings: TrackSettings) -> Trial:
    """Track it until it has been right for long enough, or the drive ends.

    Returns
    -------
    `right_after_m`, metres driven after the incident until the estimate was right and stayed so, or None; `noticed_m`,
    until the lost score was above the threshold, or None; per frame `error_m`, `lost_score` and `covered` (by the 95 %
    ellipse); `log`; `cpu_s`.
    """
    begin = time.process_time()
    if kind == "anywhere":
        settings = replace(settings, start_anywhere=True)
    drive = load_drive(incident.sequence, "spliced")
    assert drive.truth is not None  # a spliced sequence has one
    increments = increments_at(drive.stamps_ns, drive.odometry, settings.noise)
    online = FilterPass(drive, increments, matcher, start_prior(drive, settings), settings)
    errors: list[float] = []
    covered: list[bool] = []
    since = incident.way_m - incident.way_m[min(incident.last, len(incident.way_m) - 1)]
    map_error = settings.map_error_m**2 * np.eye(2)
    for frame in range(len(drive.indices)):
        online.step(frame)
        estimate = online.estimates[frame]
        offset = estimate.pose[:2] - drive.truth.poses[frame, :2]
        errors.append(float(np.hypot(*offset)))
        squared = offset @ np.linalg.solve(estimate.covariance[:2, :2] + map_error, offset)
        covered.append(bool(squared <= chi2.ppf(0.95, 2)))
        right = right_after(np.array(errors), since[: frame + 1], incident.last, STAY_M[kind])
        if right is not None:
            break
    scores = [estimate.lost_score for estimate in online.estimates]
    noticed = [frame for frame in range(incident.last, len(scores)) if scores[frame] > settings.search.lost_threshold]
    return {
        "right_after_m": right,
        "noticed_m": float(since[noticed[0]]) if noticed else None,
        "first": incident.first,
        "last": incident.last,
        "error_m": [round(error, 3) for error in errors],
        "lost_score": [round(score, 6) for score in scores],
        "measured": [row.measured for row in online.rows],
        "covered": covered,
        "start": [round(float(value), 2) for value in drive.truth.poses[incident.last]],
        "log": online.log,
        "cpu_s": round(time.process_time() - begin, 2),
    }


def right_after(errors: FloatArray, since_m: FloatArray, last: int, stay_m: float) -> float | None:
    """Way after frame `last` from which on the error has been below `RIGHT_M` for `stay_m` metres; None before that."""
    wrong = np.flatnonzero(errors[last:] >= RIGHT_M)
    first = last + (int(wrong[-1]) + 1 if len(wrong) else 0)
    if first >= len(errors) or since_m[len(errors) - 1] - since_m[first] < stay_m:
        return None
    return round(float(since_m[first]), 2)


def auroc(scores: FloatArray, positive: BoolArray) -> float | None:
    """Area under the ROC curve: the chance that a positive scores above a negative; None without both."""
    count = int(positive.sum())
    if count in (0, len(positive)):
        return None
    ranks = rankdata(scores)
    return float((ranks[positive].sum() - count * (count + 1) / 2) / (count * (len(positive) - count)))


def summary(kind: str, trials: list[Trial]) -> dict[str, Any]:
    """Shares and medians over the trials of one kind."""
    after = [trial["right_after_m"] for trial in trials]
    good = [value is not None and value <= ALLOWED_M[kind] for value in after]
    noticed = [trial["noticed_m"] for trial in trials if trial["noticed_m"] is not None]
    found = [value for value, is_good in zip(after, good, strict=True) if is_good]
    errors = np.concatenate([trial["error_m"] for trial in trials])
    scores = np.concatenate([trial["lost_score"] for trial in trials])
    measured = np.concatenate([trial["measured"] for trial in trials])
    blind = np.concatenate([trial["covered"][trial["first"] : trial["last"]] for trial in trials])
    return {
        "trials": len(trials),
        "right": int(sum(good)),
        "share": sum(good) / len(good),
        "within_m": ALLOWED_M[kind],
        "median_m": float(np.median(found)) if found else None,
        "worst_m": max(found) if found else None,
        "median_noticed_m": float(np.median(noticed)) if noticed and kind == "kidnap" else None,
        "lost_score_auroc": auroc(scores, errors > LOST_M),
        "lost_score_auroc_measured_frames": auroc(scores[measured], (errors > LOST_M)[measured]),
        "coverage95_outage": float(blind.mean()) if len(blind) else None,
        "cpu_s_per_trial": float(np.mean([trial["cpu_s"] for trial in trials])),
        "failed": [number for number, is_good in enumerate(good) if not is_good],
    }
