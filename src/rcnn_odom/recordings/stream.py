"""Scans one after the other, for an odometer: one interface for all streaming formats."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray
from rcnn_odom.recordings.beams import Beams
from rcnn_odom.recordings.scan import Scan


@dataclass
class ScanStream:
    """A recording or a live source, none of it held in memory.

    Attributes:
        name: as a user would name it.
        scans: in their order. Raises InputError where it breaks off.
        total: how many scans there are, if that is known.
        has_clock: the stamps tell of order and gaps; otherwise the order alone counts.
        beams: of the laser, where its scans are returns alone; None: as the bearings of a scan say.
        camera_from_laser: (4, 4), the frame in which trajectories are written.
        notes: what the reader noticed, in words for the user.
        skipped: what could not be read and was passed over, counted while ``scans`` is read.
        is_compensated: the motion of the laser during a revolution has been taken out of its points already.
        laser_pose: x and y in metres and heading in radians of the laser on the robot; None: unknown.
    """

    name: str
    scans: Iterator[Scan]
    total: int | None = None
    has_clock: bool = True
    beams: Beams | None = None
    camera_from_laser: FloatArray = field(default_factory=FORWARD_CAMERA.copy)
    notes: tuple[str, ...] = ()
    skipped: Counter[str] = field(default_factory=Counter)
    is_compensated: bool = False
    laser_pose: tuple[float, float, float] | None = None


def thin(stream: ScanStream, every: int) -> ScanStream:
    """The first scan of a stream and every ``every``-th after it.

    Args:
        stream: read through the one that is returned from now on.
        every: 1 or more; 1: all scans.
    """
    assert every > 0, every
    total = None if stream.total is None else -(-stream.total // every)
    return replace(stream, scans=islice(stream.scans, 0, None, every), total=total)
