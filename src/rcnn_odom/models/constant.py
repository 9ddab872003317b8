"""Baselines that repeat one step and use no scans; estimates have to be better than these."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, Steps
from rcnn_odom.recordings.parts import cut, parse_part
from rcnn_odom.recordings.recording import Drive, OpenRecording

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ConstantStep:
    """Gives the same step for every pair of scans, for instance the mean of the training drives.

    Attributes:
        step: (3,) x and y in metres, heading in radians.
    """

    step: FloatArray

    def estimate(self, drive: Drive) -> Steps:
        """The steps of a whole drive, with unknown covariances."""
        return Steps.with_unknown_covariance(np.tile(self.step, (len(drive) - 1, 1)))


def held_motion() -> ConstantStep:
    """The baseline that begins at rest and repeats its last estimate, so that it never moves.

    A matcher that repeats its last motion after a failure does the same if it fails from the start.

    Example:
        >>> held_motion().step.tolist()
        [0.0, 0.0, 0.0]
    """
    return ConstantStep(np.zeros(3))


def mean_step(open_recording: OpenRecording, names: Sequence[str]) -> FloatArray | None:
    """The mean step (3,) of training drives; None, with a log message, if one of them cannot be read.

    Args:
        open_recording: opens a recording by its name; only the true poses are used, not the scans.
        names: names of drives or of parts of them, as in ``data.train``.
    """
    try:
        steps = [_open_without_scans(open_recording, name).steps for name in names]
    except InputError as error:
        log.info("mean_motion is left out, because not all of data.train can be read: %s", error)
        return None
    return np.concatenate(steps).mean(0)  # type: ignore[no-any-return]


def _open_without_scans(open_recording: OpenRecording, name: str) -> Drive:
    """The drive, or part of a drive, with this name, without encoding its scans."""
    recording = open_recording(parse_part(name).file)
    return cut({recording.name: Drive.unencoded(recording)}, name)
