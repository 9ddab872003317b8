"""One method on one set: its steps with the time that each takes, and their scores."""

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
"""Scans before the clock starts: code is compiled, memory and caches find their places."""
FAILED = (0.5, np.deg2rad(5.0))
"""Metres and radians from which on a step's error counts as a failure."""


@dataclass(frozen=True, eq=False)
class Timed:
    """What a method made of a set.

    Attributes:
        steps: N - 1 of them.
        milliseconds: (N-1,) that each took, from the scan to the step.
        errors: (N-1,) which scans but the first the method could not take.
    """

    steps: Steps
    milliseconds: FloatArray
    errors: npt.NDArray[np.bool_]


@contextmanager
def one_core() -> Iterator[None]:
    """Binds this thread, and those that it starts, to one core; not all libraries can be told otherwise."""
    if not hasattr(os, "sched_setaffinity"):  # only Linux has it
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def run_timed(tracker: ScanTracker, loaded: LoadedSet) -> Timed:
    """Steps of all scans of a set, the very code of ``rcnn-odom run``, each with its time."""
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
    """What the table holds of a method on a set.

    Returns:
        ``scans``; ``drift`` (a ratio, None without a segment), ``rotation_deg_per_m`` and ``segments``;
        ``median_ms`` and ``p99_ms``; ``failures``, steps that are off by more than ``FAILED`` or that the
        method could not make, and ``errors``, the latter alone; ``path_ratio``, the length of the
        estimated path over that of the true one; where the set has them ``stretch`` (see
        :func:`rcnn_odom.evaluation.scores.stretch_errors`) and ``relations`` (see
        :func:`rcnn_odom.evaluation.relations.score_relations`).
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
    """Against relations between scans of the whole recording, of which the drive may be a part."""
    recording, frames = loaded.recording, loaded.drive.frames
    every = np.full((len(recording), 4, 4), np.nan)
    every[frames if frames is not None else slice(None)] = poses
    assert recording.wheel_odometry is not None, "relations are of CARMEN logs, whose lines have it"
    driven = travelled(recording.wheel_odometry)
    relations = read_relations(loaded.options["relations"])
    return score_relations(relations, stamp_keys(recording.stamps), driven, every)
