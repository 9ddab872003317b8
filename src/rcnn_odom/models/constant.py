"""Constant motion: what a drift is worth that no laser has contributed to."""

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.cache import EncodedSequence
from rcnn_odom.recordings.recording import Sequence
from rcnn_odom.training.datamodule import cut, parse_part

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ConstantMotion:
    """The same motion for every pair of scans: the training set's mean, for instance.

    Attributes:
        motion: (2,) metres and radians.
    """

    motion: FloatArray

    def estimate(self, scans: npt.ArrayLike) -> FloatArray:
        """Motions (N-1, 2) for scans (N, bins)."""
        return np.tile(self.motion, (len(np.asarray(scans)) - 1, 1))


def held_motion() -> ConstantMotion:
    """Repeats its own last estimate, and begins at rest: the odometry that never moves.

    It is what a matcher that holds its last motion on failure amounts to when it fails from the start.
    """
    return ConstantMotion(np.zeros(2))


def mean_motion(read: Callable[[str], Sequence], names: list[str]) -> ConstantMotion | None:
    """Repeats the mean motion of training drives; None, and a line in the log, where one cannot be read.

    Args:
        read: name -> ``Sequence``, of which the truth is needed and no scan.
        names: of the drives or of parts of them, as in ``data.train``.
    """
    try:
        motions = [_without_scans(read, name).motions for name in names]
    except InputError as error:
        log.info("mean_motion is left out, since not all of data.train can be read: %s", error)
        return None
    return ConstantMotion(np.concatenate(motions).mean(0))


def _without_scans(read: Callable[[str], Sequence], name: str) -> EncodedSequence:
    drive = read(parse_part(name)[0])
    scans = np.empty((len(drive), 0), dtype=np.float32)
    whole = EncodedSequence(drive.name, "", scans, drive.poses, drive.stamps, drive.camera_from_laser)
    return cut({drive.name: whole}, name)
