"""Runs a model on a recording or a live laser: ``rcnn-odom run``."""

import json
import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from rcnn_odom import __version__
from rcnn_odom.deployment.laser_view import LaserViewCheck
from rcnn_odom.deployment.odometer import Odometer, Pose
from rcnn_odom.deployment.output import Output, thin_points
from rcnn_odom.deployment.report_page import write_page
from rcnn_odom.deployment.report_pictures import MapScan
from rcnn_odom.deployment.sampling import EvenSample
from rcnn_odom.deployment.three_lines import format_lines
from rcnn_odom.deployment.timeline import Timeline, causes_in
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray, change_frame
from rcnn_odom.models.tracking import PASSED_OVER
from rcnn_odom.recordings.beams import compare_beams, find_beams
from rcnn_odom.recordings.returns import AbsentReturns
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.trajectory import write_kitti, write_tum

log = logging.getLogger(__name__)

TRAJECTORY, TUM, STEPS = "trajectory.txt", "trajectory.tum", "steps.jsonl"
PAGE, SUMMARY = "report.html", "summary.json"
MAP_SCANS, MAP_POINTS = 2000, 2000
"""Maximum number of scans in the map, and of points of each: at most 32 MB."""
LATENCIES = 100_000
"""Maximum number of computing times that are kept for the percentiles."""
FEW_SCANS = 6
"""A run with at least this many scans must have two that can be compared."""
ANOTHER_MODEL = (
    "take --model matcher, which fits any laser, or train a model on recordings of such a laser (rcnn-odom "
    "train data=... {})"
)
GIVE_ANGLES = "give angle_min and angle_increment with its ranges, or points"

Summary = dict[str, Any]


def run(
    odometer: Odometer,
    stream: ScanStream,
    model: str,
    out: Path | None = None,
    on_pose: Callable[[Pose], object] | None = None,
    settings: Mapping[str, str] | None = None,
    outputs: Sequence[Output] = (),
) -> Summary:
    """Computes the poses of all scans of a stream and writes them.

    The files are valid at any time. If the stream or the run is interrupted, they are complete up to that
    scan, and after Ctrl-C the three lines of :func:`rcnn_odom.deployment.three_lines.format_lines` are
    logged. If no scan can be used, all files are removed.

    Args:
        odometer: at its start.
        stream: the scans.
        model: name of the model for report and summary.
        out: folder for trajectories, steps, report and summary; it must not hold a trajectory yet.
        on_pose: called with each pose as soon as it is computed.
        settings: options that the user chose, by name, for the report.
        outputs: other outputs for poses and scans, such as files for viewers.

    Returns:
        The content of ``summary.json``: counts, path, marked stretches, computing times.

    Raises:
        InputError: the folder holds a trajectory or cannot be written, the laser is not one for the network,
            or the stream has no scan, no usable scan, no two scans that can be compared, or breaks off.
    """
    statistics = Statistics(stream, model, odometer)
    try:
        _estimate_poses(statistics, out, on_pose, settings or {}, outputs)
    except KeyboardInterrupt:
        if statistics.can_use:
            log.info("%s", format_lines(statistics.summary(), out / PAGE if out else None))
        raise
    return statistics.summary()


def _estimate_poses(
    statistics: "Statistics",
    out: Path | None,
    on_pose: Callable[[Pose], object] | None,
    settings: Mapping[str, str],
    outputs: Sequence[Output],
) -> None:
    """Computes the poses of all scans and passes them to the folder and the outputs; see :func:`run`."""
    stream, odometer = statistics.stream, statistics.odometer
    # The pose of a camera on the robot is unknown; trajectory files assume one that looks ahead.
    camera = FORWARD_CAMERA if odometer.laser_pose else stream.camera_from_laser
    with ExitStack() as stack:
        folder = OutputFolder(out, stream, camera, stack) if out else None
        for output in outputs:
            output.open(stream, odometer)
            stack.callback(_finish, output, statistics)
        try:
            # There is no progress bar for a live laser, whose poses are printed.
            for scan in stack.enter_context(_show_progress(stream, bool(out or outputs) and not on_pose)):
                if statistics.lacks_bearings(scan):
                    continue
                pose = statistics.step(scan)
                if folder:
                    folder.add(pose)
                if on_pose:
                    on_pose(pose)
                for output in outputs:
                    output.add(pose, scan)
            statistics.require_usable_scans()
        except BaseException as error:
            by_hand = isinstance(error, KeyboardInterrupt)
            statistics.stopped = "by Ctrl-C" if by_hand else str(error) or type(error).__name__
            raise
        finally:
            if folder:
                folder.finish(statistics, settings)


def _finish(output: Output, statistics: "Statistics") -> None:
    output.finish(statistics.can_use)


@contextmanager
def _show_progress(stream: ScanStream, is_wanted: bool) -> Iterator["tqdm[Scan]"]:
    """Shows a progress bar if standard error is a terminal; log messages are printed above it."""
    bar = tqdm(stream.scans, stream.name, stream.total, unit="scan", disable=None if is_wanted else True)
    with closing(bar), ExitStack() as stack:
        if not bar.disable:
            stack.enter_context(logging_redirect_tqdm())
        yield bar


class Statistics:
    """Counts and samples what happens in a run, in constant memory.

    Args:
        stream: the scans.
        model: name of the model.
        odometer: at its start.

    Attributes:
        can_use: whether a scan so far fitted the model and had returns.
        timeline: values over time for the report.
        laser: description of the laser, from the scan with the most beams.
        notes: messages of the reader of the recording, and a warning about the laser.

    Raises:
        InputError: the laser of the stream is not one for the network.
    """

    def __init__(self, stream: ScanStream, model: str, odometer: Odometer) -> None:
        self.stream, self.model, self.odometer = stream, model, odometer
        self.scans, self.path, self.longest, self.stopped = 0, 0.0, 0.0, ""
        self.can_use, sensor = False, odometer.sensor
        self._absent = AbsentReturns(sensor.max_range if sensor else math.inf)
        partly = odometer.beam_check is not None and odometer.beam_check.partly
        if sensor and stream.beams and (reason := compare_beams(stream.beams, sensor, partly)):
            advice = ANOTHER_MODEL.format(stream.beams.sensor_options() or "data.sensor...")
            raise InputError(f"{stream.name}: {reason}; {advice}")
        self.degraded: Counter[str] = Counter()
        self.milliseconds = EvenSample[float](LATENCIES)
        self.sample = EvenSample[MapScan](MAP_SCANS)
        self.timeline, self.laser, self._beams = Timeline(), "", 0
        self.notes, self._view = list(stream.notes), LaserViewCheck(odometer, model, stream.beams)

    def lacks_bearings(self, scan: Scan) -> bool:
        """Whether the bearings of a scan are unknown, so that it must be skipped; counts such scans.

        Raises:
            InputError: those of the first scan are unknown.
        """
        if scan.bearings is not None or self.odometer.sensor:
            return False
        if not self.scans:
            raise InputError(f"{self.stream.name}: its first scan has no angles; {GIVE_ANGLES}")
        self.stream.skipped["scans without angles"] += 1
        return True

    def step(self, scan: Scan) -> Pose:
        """Computes the pose of one scan, and measures the time of that.

        Raises:
            InputError: several scans in a row show that the laser is not one for the network.
        """
        odometer, check = self.odometer, self.odometer.beam_check
        start = time.perf_counter()
        pose = odometer.step(scan if self.stream.has_clock else replace(scan, stamp=None))
        milliseconds = 1e3 * (time.perf_counter() - start)
        self.scans += 1
        if check and check.is_another_laser:
            raise check.refusal(f"{self.stream.name}: scan {self.scans}", ANOTHER_MODEL)
        if warning := self._view.add(scan):
            log.warning("%s: %s", self.stream.name, warning)
            self.notes.append(warning)
        self.can_use = self.can_use or odometer.has_seen
        if not self.can_use:
            self._absent.add(scan)
        self.path += math.hypot(pose.step.x, pose.step.y)
        self.longest = max(self.longest, milliseconds)
        self.milliseconds.add(lambda: milliseconds)
        self.degraded.update(causes_in(pose.degraded))
        if len(scan.ranges) > self._beams:
            self._beams, self.laser = len(scan.ranges), describe_laser(scan, self.stream)
        # With a clock, the pose has its stamp already; a scan that was passed over has that of the last pose.
        pose = pose if self.stream.has_clock else replace(pose, stamp=scan.stamp)
        self._sample_for_report(pose)
        return pose

    def _sample_for_report(self, pose: Pose) -> None:
        self.timeline.add(pose)
        scan, seconds = self.scans, self.timeline.seconds or 0.0
        planar, returns = (pose.x, pose.y, pose.heading), self.odometer.returns
        self.sample.add(lambda: MapScan(planar, thin_points(returns(), MAP_POINTS), scan, seconds))

    def require_usable_scans(self) -> None:
        """Checks at the end that scans could be used and compared.

        Raises:
            InputError: they could not; the message says why.
        """
        name, advice = self.stream.name, "give another recording, or correct what its laser writes"
        if self.can_use and (self.odometer.estimates or self.scans < FEW_SCANS):
            return
        if self.can_use:
            counts = ", ".join(f"{count} {kind}" for kind, count in self.degraded.most_common())
            raise InputError(f"{name}: no two of its {self.scans} scans can be compared ({counts}); {advice}")
        if (check := self.odometer.beam_check) and check.reason:
            raise check.refusal(name, ANOTHER_MODEL)
        if not self.scans:
            raise InputError(f"{name}: no scan in it; give another recording")
        raise InputError(f"{name}: {self._absent}; {advice}")

    def summary(self) -> Summary:
        """The content of ``summary.json``."""
        median, p99 = np.percentile(self.milliseconds.items, [50, 99]).tolist()
        end = self.timeline.end
        return {
            "input": self.stream.name,
            "model": self.model,
            "laser_pose": self.odometer.laser_pose,
            "scans": self.scans,
            "path_m": self.path,
            "notes": list(self.notes),
            "degraded": dict(self.degraded),
            "skipped": dict(self.stream.skipped),
            "latency": {"median_ms": median, "p99_ms": p99, "max_ms": self.longest},
            "end": {"x": end.x, "y": end.y, "heading": end.heading},
            "recording_s": self.timeline.seconds,
            "speed": self._speed(),
            "marked": self.timeline.marks.as_dict(),
            **({"stopped": self.stopped} if self.stopped else {}),
        }

    def _speed(self) -> dict[str, float] | None:
        """Mean and largest speed in metres per second; None if the time is unknown."""
        if not self.timeline.seconds:
            return None
        mean = self.path / self.timeline.seconds
        return {"mean_m_s": mean, "top_m_s": max(mean, self.timeline.top_speed)}

    def settings(self, given: Mapping[str, str]) -> dict[str, str]:
        """Properties of the run, by name, as text for the report.

        Args:
            given: options that the user chose, by name.
        """
        settings = {
            "recording": self.stream.name,
            "model": self.model,
            "laser": self.laser,
            "poses": "of the laser",
        }
        if self.odometer.laser_pose:
            x, y, heading = self.odometer.laser_pose
            settings["poses"] = (
                f"of the robot, with its laser {x:g} m ahead, {y:g} m to the left, turned by "
                f"{math.degrees(heading):.4g} degrees"
            )
        if self.timeline.seconds and self.scans > 1:
            settings["time between scans"] = (
                f"{1e3 * self.timeline.seconds / (self.scans - 1):.3g} ms on average"
            )
        if self.notes:
            settings["notes"] = "; ".join(self.notes)
        now = datetime.now().strftime("%Y-%m-%d %H:%M")
        return {**settings, **given, "rcnn-odom": __version__, "date of this run": now}


def describe_laser(scan: Scan, stream: ScanStream) -> str:
    """Describes the laser in words, from a scan and its recording.

    >>> scan = Scan(np.full(181, 5.0), np.deg2rad(np.arange(-90.0, 91.0)), frame_id="laser")
    >>> describe_laser(scan, ScanStream("room.bag", iter([scan])))
    '181 beams from -90 to 90 degrees, one every 1, frame laser'
    """
    frame = f", frame {scan.frame_id}" if scan.frame_id else ""
    if stream.beams:
        return f"beams {stream.beams}{frame}"
    if not scan.has_all_beams:
        return f"points, up to {len(scan.ranges)} in a scan{frame}"
    with suppress(ValueError):
        if scan.bearings is not None and len(scan.bearings) > 1:
            return f"{len(scan.ranges)} beams {find_beams(scan.bearings)}{frame}"
    return f"{len(scan.ranges)} beams{frame}"


class OutputFolder:
    """The files of a run. They are created at the first pose, and each line is written immediately.

    Args:
        folder: where the files are written; it is created if it does not exist.
        stream: the scans, for their name.
        camera: (4, 4) transform from the laser's, or the robot's, frame to that of the camera, in which
            trajectories are written.
        stack: closes the files that are written line by line.

    Raises:
        InputError: the folder holds such files already.
    """

    def __init__(self, folder: Path, stream: ScanStream, camera: FloatArray, stack: ExitStack) -> None:
        self.folder, self.stream, self.camera = folder, stream, camera
        self._stack, self._written = stack, 0
        self._new_folders = [each for each in (folder, *folder.parents) if not each.exists()]
        if found := [name for name in (TRAJECTORY, TUM, STEPS, PAGE, SUMMARY) if (folder / name).exists()]:
            what = "a trajectory" if found[0] == TRAJECTORY else found[0]
            raise InputError(f"{folder}: holds {what} already; choose another --out")

    def _open_files(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            # Buffered by line, so that a run that is killed leaves only complete lines.
            self._kitti, self._tum, self._steps = (
                self._stack.enter_context((self.folder / name).open("w", buffering=1, encoding="utf-8"))
                for name in (TRAJECTORY, TUM, STEPS)
            )
        except OSError as error:
            raise InputError(
                f"{self.folder}: cannot be written ({error.strerror}); choose another --out"
            ) from error

    def add(self, pose: Pose) -> None:
        """Writes one more pose.

        In the TUM file, a pose without a stamp has its number in place of one, and a pose that is repeated
        because its scan was passed over is left out.

        Raises:
            InputError: the folder cannot be written.
        """
        if not self._written:
            self._open_files()
        camera_pose = change_frame(pose.matrix()[None], self.camera)
        write_kitti(self._kitti, camera_pose)
        if not pose.degraded.startswith(PASSED_OVER):
            write_tum(self._tum, [self._written if pose.stamp is None else pose.stamp], camera_pose)
        self._steps.write(json.dumps(pose.as_dict()) + "\n")
        self._written += 1

    def finish(self, statistics: Statistics, settings: Mapping[str, str]) -> None:
        """Writes report and summary; if no scan could be used, removes all files."""
        if not self._written:
            return
        if not statistics.can_use:
            self._remove()
            return
        summary = statistics.summary()
        (self.folder / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        all_settings = statistics.settings(settings)
        write_page(self.folder / PAGE, summary, statistics.timeline, statistics.sample.items, all_settings)

    def _remove(self) -> None:
        for name in (TRAJECTORY, TUM, STEPS):
            (self.folder / name).unlink(missing_ok=True)
        for folder in self._new_folders:
            with suppress(OSError):  # the folder holds other files by now
                folder.rmdir()
