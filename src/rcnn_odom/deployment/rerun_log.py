"""A run in the viewer of rerun, or as a file for it: ``rcnn-odom run --view`` and ``--rerun``."""

import importlib.util
import os
import sys
from abc import ABC, abstractmethod
from contextlib import suppress
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
    is_passed_over,
    with_bearings,
)
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import covariance_ellipse
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

FILE_OPTION, VIEW_OPTION = "--rerun", "--view"
REQUIREMENT = "rerun-sdk>=0.41,<0.42"
"""As in the extra ``view``."""
ODOM, LASER, ROBOT = "odom", "odom/laser", "odom/base_link"
PATH, MAP, ELLIPSE, MARKS = "odom/path", "odom/local_map", "odom/covariance", "marks"
"""Places in the recording."""
SCAN_TIMELINE, STAMP_TIMELINE = "scan", "stamp"
"""Timelines: the number of the scan, from 1, which is that of its line in steps.jsonl, and its seconds."""
EPOCH = 1e8
"""Seconds from which on stamps are dates; smaller ones count from some start."""
DEVIATIONS = 3.0
"""Standard deviations that the ellipse spans."""
PORT = 9876
"""Where the viewer listens: rerun's own."""
PATIENCE = 20.0
"""Seconds that a viewer may take to start, or to take in the rest at the end."""
BATCH_ROWS, BATCH_BYTES, BATCH_SECONDS = 1000, 1 << 20, 5.0
"""Of a file: it grows in steps of so much, as many small ones would be several times larger."""
COLORS = {"scan": (255, 140, 0), PATH: (80, 160, 255), MAP: (150, 150, 150), ELLIPSE: (230, 60, 120)}


class RerunLog(ABC):
    """Scans, path, local map, ellipses of three standard deviations and marks, as they come.

    Scans that are passed over, whose pose is the last one again, are told in the marks alone.

    Raises:
        InputError: rerun is not installed.
    """

    def __init__(self) -> None:
        self._rerun = _import_rerun()
        self._recording: Any = None

    def open(self, stream: ScanStream, odometer: Odometer) -> None:
        """Gets to know a run that begins."""
        self._name, self._odometer = stream.name, odometer
        self._stamps, self._remarks = Stamps(odometer.tracker.period), Remarks()
        self._maps, self._number, self._has_dates = LocalMaps(odometer), 0, False
        self._place: tuple[float, float, float] | None = None
        self._has_ellipse = False
        self._body = ROBOT if odometer.laser_pose else LASER
        self._laser = f"{ROBOT}/laser" if odometer.laser_pose else LASER

    def add(self, pose: Pose, scan: Scan) -> None:
        """One more pose, with its scan.

        Raises:
            InputError: the file cannot be written, or the viewer does not start.
        """
        scan, seconds = with_bearings(scan, self._odometer), self._stamps.next(pose.stamp)
        points = scan.points() if scan.bearings is not None else np.empty((0, 2))
        if self._recording is None:
            self._has_dates = seconds > EPOCH
            self._recording = self._begin()
            self._log_statics()
        self._number += 1
        self._set_time(seconds)
        for remark in self._remarks.add(pose.degraded):
            level = "WARN" if remark.is_warning else "INFO"
            self._log(MARKS, self._rerun.TextLog(remark.text, level=level))
        if is_passed_over(pose):
            return
        self._log_pose(pose)
        self._log(f"{self._laser}/scan", self._rerun.Points3D(_flat(points)))
        if (seen := self._maps.add()) is not None:
            self._log(MAP, self._rerun.Points3D(_flat(seen)))

    def finish(self, keep: bool) -> None:
        """Waits until all of it has arrived.

        Raises:
            OSError: a file can no longer be written.
        """
        if self._recording is not None:
            self._flush()
            self._recording.disconnect()

    def _flush(self) -> None:
        self._recording.flush(timeout_sec=PATIENCE)

    @abstractmethod
    def _begin(self) -> Any:
        """The recording, connected to where it goes to.

        Raises:
            InputError: there is no way to there.
        """

    def _new_recording(self, **options: Any) -> Any:
        recording = self._rerun.RecordingStream("rcnn-odom", **options)
        recording.set_log_time_enabled(False)
        return recording

    def _log(self, place: str, what: Any, static: bool = False) -> None:
        self._recording.log(place, what, static=static)

    def _set_time(self, seconds: float) -> None:
        self._recording.set_time(SCAN_TIMELINE, sequence=self._number)
        self._recording.set_time(
            STAMP_TIMELINE, **{"timestamp" if self._has_dates else "duration": float(seconds)}
        )

    def _log_statics(self) -> None:
        """What holds for the whole run: the axes, the colours, and where the laser sits on the robot."""
        rerun, thin, thick = self._rerun, -1.5, -2.5  # negative: of the screen
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
        """Where it is, how it came there from the place before, and how well that is known."""
        place = (pose.x, pose.y, pose.heading)
        self._log(self._body, self._transform(*place))
        before = place if self._place is None else self._place
        # A piece for every pose, of which the viewer shows all so far: the whole path each time would
        # make the file grow with the square of its length.
        self._log(PATH, self._rerun.LineStrips3D([_flat(np.array([before[:2], place[:2]]))]))
        self._place = place
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
        """How the viewer shows it at first: it follows the laser, with the whole path so far; marks below."""
        from rerun import blueprint as shown

        so_far = shown.VisibleTimeRanges(
            [
                shown.VisibleTimeRange(
                    timeline,
                    start=shown.TimeRangeBoundary.infinite(),
                    end=shown.TimeRangeBoundary.cursor_relative(),
                )
                for timeline in (SCAN_TIMELINE, STAMP_TIMELINE)
            ]
        )
        follows = shown.EyeControls3D(tracking_entity=f"/{self._body}")
        view = shown.Spatial3DView(origin=ODOM, name="map", overrides={PATH: so_far}, eye_controls=follows)
        marks = shown.TextLogView(origin=MARKS, name="marks")
        return shown.Blueprint(shown.Vertical(view, marks, row_shares=[4, 1]), collapse_panels=True)


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

    def _begin(self) -> Any:
        self._file.make_folder()
        batches = self._rerun.ChunkBatcherConfig(BATCH_SECONDS, BATCH_BYTES, BATCH_ROWS)
        recording = self._new_recording(batcher_config=batches)
        try:
            recording.save(self._file.path, default_blueprint=self._blueprint())
        except Exception as error:  # of its own kinds
            self._file.remove()
            raise self._file.cannot_write(error) from error
        return recording

    def finish(self, keep: bool) -> None:
        """Completes the file, or removes it.

        Raises:
            OSError: it can no longer be written.
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
    """Rerun's viewer, opened when the first scan has come; it stays open after the run.

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
        with suppress(RuntimeError):  # nobody looks any more
            super()._flush()

    def _begin(self) -> Any:
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
            f"'{REQUIREMENT}'"
        ) from error
    return rerun


def _find_viewer() -> str | None:
    """The viewer that comes with the package, which is not on PATH where its environment is not active."""
    found = importlib.util.find_spec("rerun_cli")
    for folder in (found.submodule_search_locations or []) if found else []:
        for name in ("rerun", "rerun.exe"):
            if (path := Path(folder) / name).is_file():
                return str(path)
    return None


def _flat(points: Any) -> Any:
    """Points (P, 2) at height 0, (P, 3)."""
    return np.column_stack([points, np.zeros(len(points))]).astype(np.float32)


def _quaternion(rerun: ModuleType, heading: float) -> Any:
    return rerun.Quaternion(xyzw=[0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)])
