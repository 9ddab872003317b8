"""A run in rerun's viewer, or as a file for it: ``rcnn-odom run --view`` and ``--rerun``."""

import importlib.util
import os
import sys
from abc import ABC, abstractmethod
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from rcnn_odom.deployment.odometer import Odometer, Pose
from rcnn_odom.deployment.output import (
    LocalMaps,
    OutputFile,
    Remarks,
    Stamps,
    add_bearings,
    is_passed_over,
)
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import covariance_ellipse
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

FILE_OPTION, VIEW_OPTION = "--rerun", "--view"
DISTRIBUTIONS, EXTRA, REQUIREMENT = ("rcnn-odom", "rcnn-odom-robot"), "view", "rerun-sdk>=0.41,<0.42"
"""The distributions that hold this file, their extra that installs rerun, and what it requires."""
ODOM, LASER, ROBOT = "odom", "odom/laser", "odom/base_link"
PATH, MAP, ELLIPSE, MARKS = "odom/path", "odom/local_map", "odom/covariance", "marks"
"""Entity paths of the recording."""
SCAN_TIMELINE, STAMP_TIMELINE = "scan", "stamp"
"""Timelines: the number of the scan from 1, which is also that of its line in steps.jsonl, and its stamp."""
EPOCH = 1e8
"""Seconds; larger stamps are dates, smaller ones count from the start of some device."""
DEVIATIONS = 3.0
"""Half axes of the ellipse in standard deviations."""
PORT = 9876
"""TCP port of the viewer, rerun's default."""
PATIENCE = 20.0
"""Maximum number of seconds for a viewer to start, or to receive the remaining data at the end."""
BATCH_ROWS, BATCH_BYTES, BATCH_SECONDS = 1000, 1 << 20, 5.0
"""Size of the batches in a file; with many small batches it would be several times larger."""
COLORS = {"scan": (255, 140, 0), PATH: (80, 160, 255), MAP: (150, 150, 150), ELLIPSE: (230, 60, 120)}


class RerunLog(ABC):
    """Logs scans, path, local map, ellipses of three standard deviations and remarks during the run.

    A scan that was passed over, whose pose is the last one again, only appears in the remarks.

    Raises:
        InputError: rerun is not installed.
    """

    def __init__(self) -> None:
        self._rerun = _import_rerun()
        self._recording: Any = None

    def open(self, stream: ScanStream, odometer: Odometer) -> None:
        """Prepares for a run that begins."""
        self._name, self._odometer = stream.name, odometer
        self._stamps, self._remarks = Stamps(odometer.tracker.period), Remarks()
        self._maps, self._number = LocalMaps(odometer), 0
        self._has_dates: bool | None = None  # unknown until a scan has a stamp
        self._last: tuple[float, float, float] | None = None
        self._has_ellipse = False
        self._body = ROBOT if odometer.laser_pose else LASER
        self._laser = f"{ROBOT}/laser" if odometer.laser_pose else LASER

    def add(self, pose: Pose, scan: Scan) -> None:
        """Logs one more pose and its scan.

        Raises:
            InputError: the file cannot be written, or the viewer does not start.
        """
        scan, seconds = add_bearings(scan, self._odometer), self._stamps.next(pose.stamp)
        points = scan.points() if scan.bearings is not None else np.empty((0, 2))
        if self._has_dates is None and self._stamps.is_recorded:
            self._has_dates = seconds > EPOCH
        if self._recording is None:
            self._recording = self._start_recording()
            self._log_static_data()
        self._number += 1
        self._set_time(seconds)
        for remark in self._remarks.add(pose.degraded):
            level = "WARN" if remark.is_warning else "INFO"
            self._log(MARKS, self._rerun.TextLog(remark.text, level=level))
        if is_passed_over(pose):
            return
        self._log_pose(pose)
        self._log(f"{self._laser}/scan", self._rerun.Points3D(_add_height(points)))
        if (map_points := self._maps.add()) is not None:
            self._log(MAP, self._rerun.Points3D(_add_height(map_points)))

    def finish(self, keep: bool) -> None:
        """Waits until all data has arrived.

        Raises:
            OSError: a file can no longer be written.
        """
        if self._recording is not None:
            self._flush()
            self._recording.disconnect()

    def _flush(self) -> None:
        self._recording.flush(timeout_sec=PATIENCE)

    @abstractmethod
    def _start_recording(self) -> Any:
        """Opens a recording that is connected to a file or a viewer.

        Raises:
            InputError: the file cannot be written, or the viewer does not start.
        """

    def _new_recording(self, **options: Any) -> Any:
        recording = self._rerun.RecordingStream("rcnn-odom", **options)
        recording.set_log_time_enabled(False)
        return recording

    def _log(self, entity: str, data: Any, static: bool = False) -> None:
        self._recording.log(entity, data, static=static)

    def _set_time(self, seconds: float) -> None:
        self._recording.set_time(SCAN_TIMELINE, sequence=self._number)
        if self._has_dates is not None:
            kind = "timestamp" if self._has_dates else "duration"
            self._recording.set_time(STAMP_TIMELINE, **{kind: float(seconds)})

    def _log_static_data(self) -> None:
        """Logs data for the whole run: axes, colours, and the pose of the laser on the robot."""
        rerun, thin, thick = self._rerun, -1.5, -2.5  # negative radii are in units of the screen
        self._recording.send_recording_name(self._name.encode("utf-8", "replace").decode())
        self._log(ODOM, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        scan = rerun.Points3D.from_fields(colors=COLORS["scan"], radii=thick)
        self._log(f"{self._laser}/scan", scan, static=True)
        self._log(MAP, rerun.Points3D.from_fields(colors=COLORS[MAP], radii=thin), static=True)
        self._log(PATH, rerun.LineStrips3D.from_fields(colors=COLORS[PATH], radii=thin), static=True)
        self._log(ELLIPSE, rerun.Ellipsoids3D.from_fields(colors=COLORS[ELLIPSE]), static=True)
        if self._odometer.laser_pose:
            self._log(self._laser, self._transform(*self._odometer.laser_pose), static=True)

    def _log_pose(self, pose: Pose) -> None:
        """Logs a pose, the piece of the path to it, and its ellipse."""
        planar = (pose.x, pose.y, pose.heading)
        self._log(self._body, self._transform(*planar))
        before = planar if self._last is None else self._last
        # One piece for each pose, and the viewer shows all pieces so far: with the whole path in each
        # message, the file would grow with the square of the path's length.
        self._log(PATH, self._rerun.LineStrips3D([_add_height(np.array([before[:2], planar[:2]]))]))
        self._last = planar
        self._log_ellipse(pose)

    def _log_ellipse(self, pose: Pose) -> None:
        ellipse = covariance_ellipse(pose.covariance[:2, :2], DEVIATIONS)
        if ellipse is None:
            if self._has_ellipse:
                self._log(ELLIPSE, self._rerun.Clear(recursive=False))
            self._has_ellipse = False
            return
        self._has_ellipse = True
        (longer, shorter), direction = ellipse
        shape = self._rerun.Ellipsoids3D.from_fields(
            half_sizes=[longer, shorter, 0.0],
            centers=[pose.x, pose.y, 0.0],
            quaternions=_quaternion(self._rerun, direction),
        )
        self._log(ELLIPSE, shape)

    def _transform(self, x: float, y: float, heading: float) -> Any:
        return self._rerun.Transform3D(translation=[x, y, 0.0], quaternion=_quaternion(self._rerun, heading))

    def _blueprint(self) -> Any:
        """Initial layout of the viewer: it follows the laser, shows the path so far, and remarks below."""
        from rerun import blueprint

        so_far = blueprint.VisibleTimeRanges(
            [
                blueprint.VisibleTimeRange(
                    timeline,
                    start=blueprint.TimeRangeBoundary.infinite(),
                    end=blueprint.TimeRangeBoundary.cursor_relative(),
                )
                for timeline in (SCAN_TIMELINE, STAMP_TIMELINE)
            ]
        )
        follows = blueprint.EyeControls3D(tracking_entity=f"/{self._body}")
        view = blueprint.Spatial3DView(
            origin=ODOM, name="map", overrides={PATH: so_far}, eye_controls=follows
        )
        marks = blueprint.TextLogView(origin=MARKS, name="marks")
        return blueprint.Blueprint(blueprint.Vertical(view, marks, row_shares=[4, 1]), collapse_panels=True)


class RerunFile(RerunLog):
    """A file for rerun's viewer.

    Args:
        path: of the file, which must not exist.

    Raises:
        InputError: rerun is not installed, the file exists, has another ending, or its folder cannot be
            written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file = OutputFile(path, FILE_OPTION, ".rrd")

    def _start_recording(self) -> Any:
        self._file.make_folder()
        batches = self._rerun.ChunkBatcherConfig(BATCH_SECONDS, BATCH_BYTES, BATCH_ROWS)
        recording = self._new_recording(batcher_config=batches)
        try:
            recording.save(self._file.path, default_blueprint=self._blueprint())
        except Exception as error:  # rerun raises errors of several types
            self._file.remove()
            raise self._file.cannot_write(error) from error
        return recording

    def finish(self, keep: bool) -> None:
        """Completes the file, or removes it.

        Raises:
            OSError: the file can no longer be written.
        """
        super().finish(keep)
        if self._recording is not None and not keep:
            self._file.remove()

    def _flush(self) -> None:
        try:
            super()._flush()
        except RuntimeError as error:
            raise OSError(f"{self._file.path}: {error}") from error


class RerunViewer(RerunLog):
    """Shows the run in rerun's viewer, which is opened at the first scan and stays open after the run.

    Raises:
        InputError: rerun is not installed, or there is no display.
    """

    def __init__(self) -> None:
        super().__init__()
        if sys.platform.startswith("linux") and not (
            os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        ):
            raise InputError(
                f"{VIEW_OPTION}: no display (neither DISPLAY nor WAYLAND_DISPLAY is set); write a file "
                f"instead, {FILE_OPTION} out.rrd, and open it where there is one"
            )

    def _flush(self) -> None:
        with suppress(RuntimeError):  # the viewer was closed
            super()._flush()

    def _start_recording(self) -> Any:
        recording = self._new_recording()
        try:
            self._rerun.spawn(
                port=PORT,
                executable_path=_find_viewer(),
                default_blueprint=self._blueprint(),
                recording=recording,
            )
            recording.flush(timeout_sec=PATIENCE)
        except RuntimeError as error:
            raise InputError(
                f"{VIEW_OPTION}: rerun's viewer did not start ({str(error).splitlines()[0]}); write a file "
                f"instead, {FILE_OPTION} out.rrd"
            ) from error
        return recording


def _import_rerun() -> ModuleType:
    try:
        import rerun
    except ImportError as error:
        raise InputError(
            f"{FILE_OPTION} and {VIEW_OPTION} need rerun, which is not installed ({error}): pip install "
            f"'{_find_distribution()}[{EXTRA}]', or pip install '{REQUIREMENT}'"
        ) from error
    return rerun


def _find_distribution() -> str:
    """The name of the installed distribution; if none is installed, that of the whole project."""
    for name in DISTRIBUTIONS:
        with suppress(PackageNotFoundError):
            return distribution(name).metadata["Name"]
    return DISTRIBUTIONS[0]


def _find_viewer() -> str | None:
    """The viewer in rerun's package, which is not on PATH if the virtual environment is not active."""
    found = importlib.util.find_spec("rerun_cli")
    for folder in (found.submodule_search_locations or []) if found else []:
        for name in ("rerun", "rerun.exe"):
            if (path := Path(folder) / name).is_file():
                return str(path)
    return None


def _add_height(points: Any) -> Any:
    """Points (P, 3) from points (P, 2), with z = 0."""
    return np.column_stack([points, np.zeros(len(points))]).astype(np.float32)


def _quaternion(rerun: ModuleType, heading: float) -> Any:
    return rerun.Quaternion(xyzw=[0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)])
