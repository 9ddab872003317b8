"""A stand-in for a model and drives through a room, for the tests of what a run writes beside its folder."""

import numpy as np

from matching.rooms import cast, circle
from rcnn_odom.geometry import Step, unknown_covariance
from rcnn_odom.models.contract import Registered
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

START = 1_700_000_000.0
STEP = Step(0.5, 0.1, 0.2, np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0.0], [0.0, 0.0, 0.03]]) ** 2)


class Ahead:
    """Half a metre ahead and a small turn, whatever it sees; of one scan the covariance may be unknown."""

    period = float("nan")

    def __init__(self, unknown_at=None, notes=None):
        self.unknown_at, self.notes = unknown_at, notes or {}
        self.reset()

    def reset(self):
        self.has_seen, self._points, self._count = False, np.empty((0, 2)), 0

    def begin(self, scan):
        self.has_seen = bool((scan.ranges > 0).any())
        self._points = scan.points()
        return ()

    def register(self, scan, periods=1, seconds=None):
        self._count, self._points = self._count + 1, scan.points()
        covariance = unknown_covariance() if self._count == self.unknown_at else STEP.covariance
        step = Step(STEP.x, STEP.y, STEP.heading, covariance)
        return Registered(step, self.notes.get(self._count, ()))

    def returns(self):
        return self._points


def room_scans(count, spacing_deg=2.0, **changes):
    """Scans at 10 Hz from the middle of a room."""
    bearings = circle(spacing_deg)
    ranges = cast((0.0, 0.0, 0.0), bearings)
    options = {"frame_id": "laser"} | changes
    return [Scan(ranges, bearings, stamp=START + 0.1 * n, **options) for n in range(count)]


def stream_of(scans, **options):
    return ScanStream("room.bag", iter(scans), **options)


def breaks_off(scans, error):
    yield from scans
    raise error
