"""A model over a recording or a live laser: ``rcnn-odom run``."""

import json
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
from rcnn_odom.deployment.odometer import Odometer, Pose
from rcnn_odom.deployment.output import Output, thinned
from rcnn_odom.deployment.report_page import write_page
from rcnn_odom.deployment.report_pictures import Seen
from rcnn_odom.deployment.sampling import EvenSample
from rcnn_odom.deployment.timeline import Timeline, causes_in
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray, change_frame
from rcnn_odom.models.tracking import PASSED_OVER
from rcnn_odom.recordings.beams import compare_beams, find_beams
from rcnn_odom.recordings.returns import AbsentReturns
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.trajectory import write_kitti, write_tum

TRAJECTORY, TUM, STEPS = "trajectory.txt", "trajectory.tum", "steps.jsonl"
PAGE, SUMMARY = "report.html", "summary.json"
MAP_SCANS, MAP_POINTS = 2000, 2000
"""Scans that a map is drawn of, and points of each: 32 MB at most."""
LATENCIES = 100_000
FEW_SCANS = 6
"""Fewer than so many need not have two that can be compared."""
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
    """Poses for all scans of a stream.

    What is written is valid at every moment, and complete up to the scan where a stream breaks off or
    the run is stopped. Where no scan can be used nothing is left behind.

    Args:
        odometer: at its start.
        stream: the scans.
        model: what to call it.
        out: folder for trajectories, steps, report and summary; it must not hold a trajectory yet.
        on_pose: gets every pose as soon as it is known.
        settings: what else the user set, by name, in words for the report.
        outputs: what else takes the poses and their scans, such as files for viewers.

    Returns:
        What ``summary.json`` holds: counts, path, marked stretches, and the time of a scan.

    Raises:
        InputError: the folder holds a trajectory or cannot be written, the laser is another than the
            model's, the stream has no scan, none that can be used, no two that can be compared, or
            breaks off.
    """
    statistics = Statistics(stream, model, odometer)
    # Of a robot no camera is known; its trajectory is told as of one that looks ahead.
    camera = FORWARD_CAMERA if odometer.laser_pose else stream.camera_from_laser
    with ExitStack() as stack:
        folder = OutputFolder(out, stream, camera, stack) if out else None
        for output in outputs:
            output.open(stream, odometer)
            stack.callback(_finish, output, statistics)
        try:
            # Of a live laser the poses are what is printed.
            for scan in stack.enter_context(_show_progress(stream, bool(out or outputs) and not on_pose)):
                if statistics.passes_over(scan):
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
                folder.finish(statistics, settings or {})
    return statistics.summary()


def _finish(output: Output, statistics: "Statistics") -> None:
    output.finish(statistics.can_use)


@contextmanager
def _show_progress(stream: ScanStream, is_wanted: bool) -> Iterator["tqdm[Scan]"]:
    """The scans, with a bar if standard error is a terminal; what is logged meanwhile stands above it."""
    bar = tqdm(stream.scans, stream.name, stream.total, unit="scan", disable=None if is_wanted else True)
    with closing(bar), ExitStack() as stack:
        if not bar.disable:
            stack.enter_context(logging_redirect_tqdm())
        yield bar


class Statistics:
    """What is counted and sampled along a run, in constant memory.

    Args:
        stream: the scans.
        model: what to call it.
        odometer: at its start.

    Attributes:
        can_use: there was a scan that fits the model and has returns.
        timeline: what the report shows over time.
        laser: what the scan with the most beams tells of it, in words.

    Raises:
        InputError: the stream's laser is another than a network's.
    """

    def __init__(self, stream: ScanStream, model: str, odometer: Odometer) -> None:
        self.stream, self.model, self.odometer = stream, model, odometer
        self.scans, self.path, self.longest, self.stopped = 0, 0.0, 0.0, ""
        self.can_use, sensor = False, odometer.sensor
        self._absent = AbsentReturns(sensor.max_range if sensor else math.inf)
        if sensor and stream.beams and (reason := compare_beams(stream.beams, sensor)):
            advice = ANOTHER_MODEL.format(stream.beams.sensor_options() or "data.sensor...")
            raise InputError(f"{stream.name}: {reason}; {advice}")
        self.degraded: Counter[str] = Counter()
        self.milliseconds = EvenSample[float](LATENCIES)
        self.sample = EvenSample[Seen](MAP_SCANS)
        self.timeline, self.laser, self._beams = Timeline(), "", 0

    def passes_over(self, scan: Scan) -> bool:
        """Whether nothing says where the beams of a scan lie, among others where something does; counts it.

        Raises:
            InputError: nothing says it of the first one.
        """
        if scan.bearings is not None or self.odometer.sensor:
            return False
        if not self.scans:
            raise InputError(f"{self.stream.name}: its first scan has no angles; {GIVE_ANGLES}")
        self.stream.skipped["scans without angles"] += 1
        return True

    def step(self, scan: Scan) -> Pose:
        """One scan through the odometer, timed and counted.

        Raises:
            InputError: the laser is another than a network's, for good.
        """
        odometer, check = self.odometer, self.odometer.beam_check
        start = time.perf_counter()
        pose = odometer.step(scan if self.stream.has_clock else replace(scan, stamp=None))
        milliseconds = 1e3 * (time.perf_counter() - start)
        self.scans += 1
        if check and check.is_for_good:
            raise check.refusal(f"{self.stream.name}: scan {self.scans}", ANOTHER_MODEL)
        self.can_use = self.can_use or odometer.has_seen
        if not self.can_use:
            self._absent.add(scan)
        self.path += math.hypot(pose.step.x, pose.step.y)
        self.longest = max(self.longest, milliseconds)
        self.milliseconds.add(lambda: milliseconds)
        self.degraded.update(causes_in(pose.degraded))
        if len(scan.ranges) > self._beams:
            self._beams, self.laser = len(scan.ranges), describe_laser(scan, self.stream)
        # A scan that was passed over keeps the stamp of the pose that it repeats.
        pose = pose if self.stream.has_clock else replace(pose, stamp=scan.stamp)
        self._look(pose)
        return pose

    def _look(self, pose: Pose) -> None:
        """Keeps what the report shows of a pose."""
        self.timeline.add(pose)
        scan, seconds = self.scans, self.timeline.seconds or 0.0
        place, returns = (pose.x, pose.y, pose.heading), self.odometer.returns
        self.sample.add(lambda: Seen(place, thinned(returns(), MAP_POINTS), scan, seconds))

    def require_usable_scans(self) -> None:
        """Looks at the end whether anything could be used.

        Raises:
            InputError: nothing could; the message says why.
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
        """Plain values."""
        median, p99 = np.percentile(self.milliseconds.items, [50, 99]).tolist()
        end = self.timeline.end
        return {
            "input": self.stream.name,
            "model": self.model,
            "laser_pose": self.odometer.laser_pose,
            "scans": self.scans,
            "path_m": self.path,
            "notes": list(self.stream.notes),
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
        """Metres per second of the way, if the recording tells the time."""
        if not self.timeline.seconds:
            return None
        mean = self.path / self.timeline.seconds
        return {"mean_m_s": mean, "top_m_s": max(mean, self.timeline.top_speed)}

    def settings(self, given: Mapping[str, str]) -> dict[str, str]:
        """What is known of the run, by name, in words, and what the user set."""
        told = {
            "recording": self.stream.name,
            "model": self.model,
            "laser": self.laser,
            "poses": "of the laser",
        }
        if self.odometer.laser_pose:
            x, y, heading = self.odometer.laser_pose
            told["poses"] = (
                f"of the robot, with its laser {x:g} m ahead, {y:g} m to the left, turned by "
                f"{math.degrees(heading):.4g} degrees"
            )
        if self.timeline.seconds and self.scans > 1:
            told["time between scans"] = f"{1e3 * self.timeline.seconds / (self.scans - 1):.3g} ms on average"
        if self.stream.notes:
            told["noticed"] = "; ".join(self.stream.notes)
        now = datetime.now().strftime("%Y-%m-%d %H:%M")
        return {**told, **given, "rcnn-odom": __version__, "date of this run": now}


def describe_laser(scan: Scan, stream: ScanStream) -> str:
    """What a scan and its recording tell of the laser, in words."""
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
    """The files of a run, begun with the first pose, each line written as soon as it is known.

    Args:
        folder: to write to, made where missing.
        stream: the scans, for their name.
        camera: (4, 4) from the body whose poses are given, the frame in which trajectories are written.
        stack: closes the files of lines.

    Raises:
        InputError: the folder holds such files already.
    """

    def __init__(self, folder: Path, stream: ScanStream, camera: FloatArray, stack: ExitStack) -> None:
        self.folder, self.stream, self.camera = folder, stream, camera
        self._stack, self._written = stack, 0
        self._made = [each for each in (folder, *folder.parents) if not each.exists()]
        if found := [name for name in (TRAJECTORY, TUM, STEPS, PAGE, SUMMARY) if (folder / name).exists()]:
            what = "a trajectory" if found[0] == TRAJECTORY else found[0]
            raise InputError(f"{folder}: holds {what} already; choose another --out")

    def _begin(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            # Line by line, so that a run that is killed leaves no half of one.
            self._kitti, self._tum, self._steps = (
                self._stack.enter_context((self.folder / name).open("w", buffering=1, encoding="utf-8"))
                for name in (TRAJECTORY, TUM, STEPS)
            )
        except OSError as error:
            raise InputError(
                f"{self.folder}: cannot be written ({error.strerror}); choose another --out"
            ) from error

    def add(self, pose: Pose) -> None:
        """One more pose; without a stamp it stands under its number, one that is told again under no time.

        Raises:
            InputError: the folder cannot be written.
        """
        if not self._written:
            self._begin()
        camera_pose = change_frame(pose.matrix()[None], self.camera)
        write_kitti(self._kitti, camera_pose)
        if not pose.degraded.startswith(PASSED_OVER):
            write_tum(self._tum, [self._written if pose.stamp is None else pose.stamp], camera_pose)
        self._steps.write(json.dumps(pose.as_dict()) + "\n")
        self._written += 1

    def finish(self, statistics: Statistics, settings: Mapping[str, str]) -> None:
        """The report and the summary, where there is a pose; nothing at all where no scan could be used."""
        if not self._written:
            return
        if not statistics.can_use:
            self._remove()
            return
        summary = statistics.summary()
        (self.folder / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        told = statistics.settings(settings)
        write_page(self.folder / PAGE, summary, statistics.timeline, statistics.sample.items, told)

    def _remove(self) -> None:
        for name in (TRAJECTORY, TUM, STEPS):
            (self.folder / name).unlink(missing_ok=True)
        for folder in self._made:
            with suppress(OSError):  # somebody else has put something there
                folder.rmdir()
