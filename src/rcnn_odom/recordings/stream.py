"""A stream of scans: one interface for all streaming formats."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray
from rcnn_odom.recordings.beams import Beams
from rcnn_odom.recordings.scan import Scan


@dataclass
class ScanStream:
    """A recording or a live source, read scan by scan.

    Attributes:
        name: the user's name of the recording.
        scans: the scans in order; raises InputError if the source is cut off or damaged.
        total: number of scans; None: unknown.
        has_clock: whether the stamps show order and gaps of the scans; otherwise only their order is used.
        beams: beams of the laser if its scans are returns alone; None: the bearings of the scans show them.
        camera_from_laser: (4, 4), to the frame in which trajectories are written.
        notes: messages of the reader for the user.
        skipped: number of items that could not be read, by kind; counted while ``scans`` is read.
        is_compensated: whether the motion of the laser during a revolution is already removed from the scans.
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
    """Keep the first scan of a stream and every ``every``-th scan after it.

    Args:
        stream: the stream; do not read it yourself afterwards.
        every: 1 or more; 1: all scans.
    """
    assert every > 0, every
    total = None if stream.total is None else -(-stream.total // every)
    return replace(stream, scans=islice(stream.scans, 0, None, every), total=total)
