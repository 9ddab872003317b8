"""Runs one method on one set, measures the time of each step, and scores the steps."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rcnn_odom.evaluation.drift import travelled
from rcnn_odom.evaluation.metrics import Report, planar_drift
from rcnn_odom.evaluation.relations import read_relations, score_relations, stamp_keys
from rcnn_odom.evaluation.scores import path_ratio, stretch_errors
from rcnn_odom.geometry import FloatArray, Steps, motions_of, wrap_angle
from rcnn_odom.models.contract import ScanTracker
from rcnn_odom.models.tracking import Tracking
from rcnn_odom.training.benchmark.sets import LoadedSet

WARM_UP = 20
"""Untimed scans at the beginning, in which code is compiled and caches are filled."""
FAILED = (0.5, np.deg2rad(5.0))
"""Error of a step, in metres and radians, above which it counts as a failure."""


@dataclass(frozen=True, eq=False)
class Timed:
    """The results of a method on a set of N scans.

    Attributes:
        steps: the N - 1 estimated steps.
        milliseconds: (N-1,) computing time of each step.
        errors: (N-1,) whether the method failed with an error at a scan after the first.
    """

    steps: Steps
    milliseconds: FloatArray
    errors: npt.NDArray[np.bool_]


@contextmanager
def one_core() -> Iterator[None]:
    """Binds this thread and its child threads to one core; some libraries have no option for that."""
    if not hasattr(os, "sched_setaffinity"):  # Only Linux has it.
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def run_timed(tracker: ScanTracker, loaded: LoadedSet) -> Timed:
    """Estimates and times the steps of all scans of a set, with the same code as ``rcnn-odom run``."""
    tracking = Tracking(tracker)
    for scan in loaded.scans[:WARM_UP]:
        tracking.step(scan)
    tracking.reset()
    found, milliseconds = [], []
    for scan in loaded.scans:
        start = time.perf_counter()
        found.append(tracking.step(scan))
        milliseconds.append(1e3 * (time.perf_counter() - start))
    errors = np.array([any(note.startswith("error:") for note in each.notes) for each in found[1:]])
    values = np.array([tracked.step.array() for tracked in found[1:]])
    covariances = np.array([tracked.step.covariance for tracked in found[1:]])
    return Timed(Steps(values, covariances), np.array(milliseconds[1:]), errors)


def score_timed(timed: Timed, loaded: LoadedSet) -> Report:
    """Scores a method on a set.

    Returns:
        ``scans``; ``drift`` (a ratio, None without a segment), ``rotation_deg_per_m`` and ``segments``;
        ``median_ms`` and ``p99_ms``; ``failures``, the number of steps with an error above ``FAILED`` or with
        an exception of the method; ``errors``, the number of exceptions; ``path_ratio``, the length of the
        estimated path divided by that of the true path; ``stretch`` (see
        :func:`rcnn_odom.evaluation.scores.stretch_errors`) and ``relations`` (see
        :func:`rcnn_odom.evaluation.relations.score_relations`) if the set has them.
    """
    drive, options, values = loaded.drive, loaded.options, timed.steps.values
    drift = planar_drift(drive, timed.steps, options["lengths"])
    off = np.hypot(*(values - drive.steps)[:, :2].T) > FAILED[0]
    off |= np.abs(wrap_angle(values[:, 2] - drive.steps[:, 2])) > FAILED[1]
    median, p99 = np.percentile(timed.milliseconds, [50, 99]).tolist()
    report: Report = {
        "scans": len(loaded.scans),
        "drift": drift.t_err,
        "rotation_deg_per_m": drift.r_err_deg_per_m,
        "segments": drift.segments,
        "median_ms": median,
        "p99_ms": p99,
        "failures": int((off | timed.errors).sum()),
        "errors": int(timed.errors.sum()),
        "path_ratio": path_ratio(timed.steps, drive),
    }
    if options["frames"]:
        first, last = options["frames"]
        stretch = slice(first - 1, last)
        report["stretch"] = stretch_errors(motions_of(values), drive.motions, stretch)
    if options["relations"]:
        report["relations"] = _score_relations(timed.steps.poses(), loaded)
    return report


def _score_relations(poses: FloatArray, loaded: LoadedSet) -> Report:
    """Compares poses with relations between scans of the whole recording; the drive may be a part of it."""
    recording, frames = loaded.recording, loaded.drive.frames
    every = np.full((len(recording), 4, 4), np.nan)
    every[frames if frames is not None else slice(None)] = poses
    assert recording.wheel_odometry is not None, "relations are of CARMEN logs, whose lines have it"
    driven = travelled(recording.wheel_odometry)
    relations = read_relations(loaded.options["relations"])
    return score_relations(relations, stamp_keys(recording.stamps), driven, every)
