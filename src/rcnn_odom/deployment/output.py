"""Outputs of a run beside its folder: their interface, and what all of them have in common.

Another output is one more file with a class like :class:`rcnn_odom.deployment.mcap_log.McapLog`.
"""

import math
import os
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from rcnn_odom.deployment.odometer import Odometer, Pose
from rcnn_odom.deployment.timeline import STRETCH_GAP, Stretch, causes_in
from rcnn_odom.errors import InputError
from rcnn_odom.models.tracking import PASSED_OVER
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

LATEST_STAMP = 2.0**31
"""Seconds; a larger stamp is ignored, because ROS messages cannot hold it and no clock gives it."""
USUAL_PERIOD = 0.1
"""Seconds between scans without stamps if the model has no period of its own."""
MAP_EVERY = 50
"""Scans between two local maps that are written."""
RECENT_SCANS, RECENT_EVERY, RECENT_POINTS = 20, 5, 500
"""For a model without a map: number of recent scans that make up the local map, scans from one of them to the
next, and maximum number of points of each."""


class Output(Protocol):
    """Receives the poses of a run one by one, in constant memory.

    Its constructor checks that it can be written, before anything is read.
    """

    def open(self, stream: ScanStream, odometer: Odometer) -> None:
        """Prepares for a run that begins; nothing is written yet.

        Args:
            stream: the scans.
            odometer: at its start. After each scan it holds the returns and the local map of that scan.
        """

    def add(self, pose: Pose, scan: Scan) -> None:
        """Writes one more pose, with the scan that was taken there.

        Raises:
            InputError: the output cannot be created.
            OSError: the output can no longer be written.
        """

    def finish(self, keep: bool) -> None:
        """Completes what was written, also if the run was interrupted.

        Args:
            keep: False if no scan could be used: what was written is then removed.

        Raises:
            OSError: the output can no longer be written.
        """


class OutputFile:
    """A file that a run writes: it must not exist yet, and is removed if no scan can be used.

    Args:
        path: of the file; its folder is created if it does not exist.
        option: of the command line that names the file, for messages.
        ending: that the path must have.

    Attributes:
        path: as given.

    Raises:
        InputError: the path has another ending, exists already, or its folder cannot be written.
    """

    def __init__(self, path: Path, option: str, ending: str) -> None:
        self.path, self._option = path, option
        if path.suffix.lower() != ending:
            raise InputError(f"{path}: does not end in {ending}; choose another {option}")
        self._refuse_existing()
        self._new_folders = [each for each in path.parents if not os.path.lexists(each)]
        parent = path.parents[len(self._new_folders)]
        if not parent.is_dir():
            raise self._refusal("Not a directory")
        if not os.access(parent, os.W_OK | os.X_OK):
            raise self._refusal("Permission denied")

    def _refuse_existing(self) -> None:
        if os.path.lexists(self.path):
            raise InputError(f"{self.path}: exists already; choose another {self._option}")

    def _refusal(self, reason: str | None) -> InputError:
        return InputError(f"{self.path}: cannot be written ({reason}); choose another {self._option}")

    def make_folder(self) -> None:
        """Creates the folder, just before the file is written.

        Raises:
            InputError: the folder cannot be created, or the file exists by now.
        """
        self._refuse_existing()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self.cannot_write(error) from error

    def cannot_write(self, error: Exception) -> InputError:
        """Turns an error of the system or of a library into a message for the user."""
        return self._refusal(getattr(error, "strerror", None) or str(error).splitlines()[0])

    def remove(self) -> None:
        """Removes the file, and the folders that were created for it."""
        with suppress(OSError):  # the file was never created
            self.path.unlink(missing_ok=True)
        for folder in self._new_folders:
            with suppress(OSError):  # the folder holds other files by now
                folder.rmdir()


class Stamps:
    """Times of a run's scans in seconds: their stamps, or one period after the last time without a stamp.

    A stamp that is negative, after the year 2038, or 0 after the first scan counts as none.

    Args:
        period: usual seconds between scans; nan: unknown.

    Attributes:
        is_recorded: whether the last time is a stamp of the recording.

    Example:
        >>> stamps = Stamps(0.5)
        >>> [stamps.next(stamp) for stamp in (None, 7.0, None)]
        [0.5, 7.0, 7.5]
    """

    def __init__(self, period: float) -> None:
        self.period = period if 0 < period < math.inf else USUAL_PERIOD
        self.is_recorded = False
        self._last: float | None = None

    def next(self, stamp: float | None) -> float:
        """Returns the time of the next scan in seconds."""
        if stamp is not None and 0 <= stamp < LATEST_STAMP and (stamp > 0 or self._last is None):
            self.is_recorded, self._last = True, float(stamp)
        else:
            self.is_recorded, self._last = False, (self._last or 0.0) + self.period
        return self._last


@dataclass(frozen=True)
class Remark:
    """A message about the quality of the poses.

    Attributes:
        text: for people.
        is_warning: True if the estimate is worse than usual from here on, False if that is over.
    """

    text: str
    is_warning: bool


class Remarks:
    """Reports the beginning and the end of each stretch of poses that are worse than usual.

    A stretch ends after some scans without its cause; stretches that are closer together count as one, as in
    the report.
    """

    def __init__(self) -> None:
        self._scans = 0
        self._open: dict[str, Stretch] = {}

    def add(self, degraded: str) -> list[Remark]:
        """Returns the remarks on one more pose, from the notes in its ``degraded``.

        Example:
            >>> remarks = Remarks()
            >>> [len(remarks.add(degraded)) for degraded in ("", "gap: 3 periods", "gap: 2 periods", "")]
            [0, 1, 0, 0]
        """
        self._scans += 1
        number, remarks = self._scans, list[Remark]()
        for note in degraded.split("; "):
            for cause in causes_in(note):
                here = Stretch(number, number, None, None)
                if cause in self._open:
                    self._open[cause].absorb(here)
                else:
                    self._open[cause] = here
                    remarks.append(Remark(note, is_warning=True))
        ended = [cause for cause, one in self._open.items() if number - one.last > STRETCH_GAP]
        for cause in ended:
            one = self._open.pop(cause)
            scans = f"{one.scans} scan{'s' if one.scans != 1 else ''}"
            text = f"{cause}: over, {scans} marked from scan {one.first} to scan {one.last}"
            remarks.append(Remark(text, is_warning=False))
        return remarks


def thin_points(points: npt.NDArray[np.float32], most: int) -> npt.NDArray[np.float32]:
    """Keeps every n-th of points (P, 2), with the smallest n that leaves at most ``most`` points.

    >>> thin_points(np.zeros((10, 2), np.float32), 4).shape
    (4, 2)
    """
    return points[:: max(1, -(-len(points) // most))]


class LocalMaps:
    """The local map that outputs show: that of the matcher, or the returns of recent scans.

    Args:
        odometer: at its start.
    """

    def __init__(self, odometer: Odometer) -> None:
        self._odometer, self._count = odometer, 0
        self._has_own = odometer.local_map() is not None
        self._recent: deque[npt.NDArray[np.float32]] = deque(maxlen=RECENT_SCANS)

    def add(self) -> npt.NDArray[np.float32] | None:
        """Counts one more scan.

        Returns:
            Points (C, 2) in metres in the frame of the first pose; None if no map is due at this scan.
        """
        number, self._count = self._count, self._count + 1
        if not self._has_own and number % RECENT_EVERY == 0:
            self._recent.append(thin_points(self._odometer.returns(), RECENT_POINTS))
        if number % MAP_EVERY:
            return None
        return self._odometer.local_map() if self._has_own else np.concatenate(list(self._recent))


def is_passed_over(pose: Pose) -> bool:
    """Whether a scan was not used, so that its pose is the last one again."""
    return pose.degraded.startswith(PASSED_OVER)


def add_bearings(scan: Scan, odometer: Odometer) -> Scan:
    """A scan with bearings: its own, or those that the sensor of a network defines."""
    if scan.bearings is not None or odometer.sensor is None:
        return scan
    return replace(scan, bearings=odometer.sensor.bearings_of(scan))
