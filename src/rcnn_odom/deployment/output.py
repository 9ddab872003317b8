"""What a run writes beside its folder: one interface, and what all such outputs have in common.

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
from rcnn_odom.deployment.timeline import LEAST_APART, Stretch, causes_in
from rcnn_odom.errors import InputError
from rcnn_odom.models.tracking import PASSED_OVER
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

LATEST_STAMP = 2.0**31
"""Seconds from which on a stamp counts as none: messages of ROS cannot hold it, and no clock says it."""
USUAL_PERIOD = 0.1
"""Seconds between scans without stamps, where the model knows no period."""
MAP_EVERY = 50
"""Scans between two local maps that are written."""
RECENT_SCANS, RECENT_EVERY, RECENT_POINTS = 20, 5, 500
"""Scans that the local map of a model without one is made of, every so many scans one, and points of each."""


class Output(Protocol):
    """Takes the poses of a run as they come, in constant memory.

    Where it writes to is checked when it is made, before anything is read.
    """

    def open(self, stream: ScanStream, odometer: Odometer) -> None:
        """Gets to know a run that begins; nothing is written yet.

        Args:
            stream: the scans.
            odometer: at its start; after each scan it tells of the local map.
        """

    def add(self, pose: Pose, scan: Scan) -> None:
        """One more pose, with the scan that was taken there.

        Raises:
            InputError: it cannot be written.
            OSError: it can no longer be written.
        """

    def finish(self, keep: bool) -> None:
        """Completes what was written, also where the run breaks off; or removes it, where no scan was usable.

        Raises:
            OSError: it can no longer be written.
        """


class OutputFile:
    """A file that a run writes: it must not exist yet, and is removed where no scan can be used.

    Args:
        path: of the file; its folder is made where missing.
        option: of the command line, by which it was chosen, for messages.
        ending: that it must have.

    Attributes:
        path: as given.

    Raises:
        InputError: it has another ending, exists already, or its folder cannot be written.
    """

    def __init__(self, path: Path, option: str, ending: str) -> None:
        self.path, self._option = path, option
        if path.suffix.lower() != ending:
            raise InputError(f"{path}: does not end in {ending}; choose another {option}")
        self._refuse_existing()
        self._made = [each for each in path.parents if not os.path.lexists(each)]
        there = path.parents[len(self._made)]
        if not there.is_dir():
            raise self._refusal("Not a directory")
        if not os.access(there, os.W_OK | os.X_OK):
            raise self._refusal("Permission denied")

    def _refuse_existing(self) -> None:
        if os.path.lexists(self.path):
            raise InputError(f"{self.path}: exists already; choose another {self._option}")

    def _refusal(self, reason: str | None) -> InputError:
        return InputError(f"{self.path}: cannot be written ({reason}); choose another {self._option}")

    def make_folder(self) -> None:
        """Makes the folder, at the last moment.

        Raises:
            InputError: that fails, or the file exists by now.
        """
        self._refuse_existing()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self.cannot_write(error) from error

    def cannot_write(self, error: Exception) -> InputError:
        """The refusal for a user of what the system said."""
        return self._refusal(getattr(error, "strerror", None) or str(error).splitlines()[0])

    def remove(self) -> None:
        """Leaves nothing behind of it and of folders that were made for it."""
        with suppress(OSError):  # it was never made
            self.path.unlink(missing_ok=True)
        for folder in self._made:
            with suppress(OSError):  # somebody else has put something there
                folder.rmdir()


class Stamps:
    """Seconds of a run's scans: those of the recording, or where it has none a period after the last one.

    What is negative, after 2038, or 0 after the first scan, is none.

    Args:
        period: usual seconds between scans; nan: unknown.

    Example:
        >>> stamps = Stamps(0.5)
        >>> [stamps.next(stamp) for stamp in (None, 7.0, None)]
        [0.5, 7.0, 7.5]
    """

    def __init__(self, period: float) -> None:
        self.period = period if 0 < period < math.inf else USUAL_PERIOD
        self._last: float | None = None

    def next(self, stamp: float | None) -> float:
        """The seconds of one more scan."""
        if stamp is not None and 0 <= stamp < LATEST_STAMP and (stamp > 0 or self._last is None):
            self._last = float(stamp)
        else:
            self._last = (self._last or 0.0) + self.period
        return self._last


@dataclass(frozen=True)
class Remark:
    """Words about a stretch of poses.

    Attributes:
        text: for people.
        is_warning: the estimate is worse than usual from here on; otherwise that is over.
    """

    text: str
    is_warning: bool


class Remarks:
    """Tells once where poses begin to suffer from something, and once where that is over.

    It is over after some scans without it: closer stretches are one, as in the report.
    """

    def __init__(self) -> None:
        self._scans = 0
        self._open: dict[str, Stretch] = {}

    def add(self, degraded: str) -> list[Remark]:
        """What there is to tell of one more pose, in whose words stands what it suffers from."""
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
        over = [cause for cause, one in self._open.items() if number - one.last > LEAST_APART]
        for cause in over:
            one = self._open.pop(cause)
            text = f"{cause}: over, {one.scans} scans from the {one.first}. to the {one.last}."
            remarks.append(Remark(text, is_warning=False))
        return remarks


def thinned(points: npt.NDArray[np.float32], most: int) -> npt.NDArray[np.float32]:
    """Every so many of points (P, 2), that at most ``most`` are left.

    >>> thinned(np.zeros((10, 2), np.float32), 4).shape
    (4, 2)
    """
    return points[:: max(1, -(-len(points) // most))]


class LocalMaps:
    """The local map that outputs draw: the matcher's own, or else the returns of recent scans.

    Args:
        odometer: at its start.
    """

    def __init__(self, odometer: Odometer) -> None:
        self._odometer, self._count = odometer, 0
        self._has_own = odometer.local_map() is not None
        self._recent: deque[npt.NDArray[np.float32]] = deque(maxlen=RECENT_SCANS)

    def add(self) -> npt.NDArray[np.float32] | None:
        """Points (C, 2) in metres in the frame of the first pose, after one more scan; None: not yet due."""
        number, self._count = self._count, self._count + 1
        if not self._has_own and number % RECENT_EVERY == 0:
            self._recent.append(thinned(self._odometer.returns(), RECENT_POINTS))
        if number % MAP_EVERY:
            return None
        return self._odometer.local_map() if self._has_own else np.concatenate(list(self._recent))


def is_passed_over(pose: Pose) -> bool:
    """Whether a scan was not used, so that its pose is the last one again."""
    return pose.degraded.startswith(PASSED_OVER)


def with_bearings(scan: Scan, odometer: Odometer) -> Scan:
    """A scan with the bearings of its beams, where only a network's sensor says them."""
    if scan.bearings is not None or odometer.sensor is None:
        return scan
    return replace(scan, bearings=odometer.sensor.bearings_of(scan))
