"""Drift against the length of a segment and against its speed, as KITTI's devkit plots it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import SegmentErrors, segment_errors, travelled
from rcnn_odom.evaluation.sweep_report.folders import Run
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.trajectory import file_name, flatten, read_kitti

LEAST_SEGMENTS = 3
"""Fewer make no point of a curve, as in the devkit."""

SLOW = 5.0
"""A drive that never gets faster than this (m/s) is a robot's, whose speeds want finer steps."""


@dataclass(frozen=True)
class Segments:
    """All segments of a run's test sequences, S in all; every field has shape (S,).

    Attributes:
        length: nominal length in metres.
        speed: length of the true path between the ends over its duration, metres a second; nan where
            the times are not known.
        t_err: error between the ends as a ratio of the length.
        r_err_deg_per_m: angle between the ends in degrees per metre of length.
    """

    length: FloatArray
    speed: FloatArray
    t_err: FloatArray
    r_err_deg_per_m: FloatArray


@dataclass(frozen=True)
class Curve:
    """Means over a run's segments at P places, each field (P,): ``x`` in metres or metres a second."""

    x: FloatArray
    t_err: FloatArray
    r_err_deg_per_m: FloatArray


def trajectory(run: Run, sequence: str) -> tuple[FloatArray, FloatArray]:
    """True and estimated camera poses (N, 4, 4) of a test sequence, flattened to the plane.

    Raises:
        InputError: a file is not there or not a trajectory.
    """
    folder, name = run.folder / "trajectories", file_name(sequence)
    return flatten(read_kitti(folder / f"{name}_truth.txt")), flatten(read_kitti(folder / f"{name}.txt"))


def run_segments(run: Run, sequences: Sequence[str]) -> Segments:
    """The segments of a finished run's trajectories, by the lengths that its drift has.

    Raises:
        InputError: a trajectory is not there, or cannot be read.
    """
    parts = []
    for sequence in sequences:
        truth, estimate = trajectory(run, sequence)
        errors = segment_errors(truth, estimate, run.metrics.lengths)
        stamps = _read_stamps(run.folder / "trajectories" / f"{file_name(sequence)}.tum", len(truth))
        speed = _speeds(errors, travelled(truth), stamps)
        parts.append([errors.length, speed, errors.t_err, np.degrees(errors.r_err)])
    return Segments(*np.concatenate(parts, axis=1))


def _read_stamps(path: Path, frames: int) -> FloatArray:
    """Times (N,) of a TUM file; nan where it is not there or does not fit."""
    try:
        stamps = np.loadtxt(path, usecols=0, ndmin=1)
    except (OSError, ValueError, IndexError):
        return np.full(frames, np.nan)
    return stamps if len(stamps) == frames else np.full(frames, np.nan)


def _speeds(errors: SegmentErrors, distance: FloatArray, stamps: FloatArray) -> FloatArray:
    path, duration = (values[errors.end] - values[errors.start] for values in (distance, stamps))
    speed: FloatArray = np.divide(path, duration, out=np.full(len(path), np.nan), where=duration > 0)
    return speed


def by_length(segments: Segments) -> Curve:
    """Means over the segments of each length."""
    return _means(segments, np.unique(segments.length), lambda length: segments.length == length)


def by_speed(segments: Segments) -> Curve:
    """Means over segments within 2 m/s of 2, 4, 6 ... m/s, as in `saveErrorPlots` of KITTI's devkit.

    Neighbouring places share segments. Drives below ``SLOW`` have places every 0.1 m/s. Unlike in the
    devkit, a speed is the true path over the recorded duration, not the nominal length over 0.1 s a frame,
    and the places have no upper end.
    """
    fastest = np.nanmax(segments.speed, initial=0.0)
    step = 2.0 if fastest > SLOW else 0.1
    places = step * np.arange(1.0, int(fastest / step) + 2)
    return _means(segments, places, lambda place: np.abs(segments.speed - place) < step)


def _means(
    segments: Segments, places: npt.NDArray[Any], chosen: Callable[[float], npt.NDArray[np.bool_]]
) -> Curve:
    rows = []
    for place in places:
        here = chosen(place)
        if here.sum() >= LEAST_SEGMENTS:
            rows.append([place, segments.t_err[here].mean(), segments.r_err_deg_per_m[here].mean()])
    return Curve(*np.array(rows).reshape(-1, 3).T)


def read_curves(runs: Sequence[Run], sequences: Sequence[str]) -> tuple[list[Segments], list[str]]:
    """The segments of several runs, and one line for each run that has none to show."""
    found, problems = [], []
    for run in runs:
        try:
            found.append(run_segments(run, sequences))
        except InputError as error:
            problems.append(f"{run.name}: {error}")
    return found, problems
