"""Baselines that repeat one step: an estimate has to be better than these, which use no scan."""

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
    """The same step for every pair of scans: the training drives' mean, for instance.

    Attributes:
        step: (3,) x and y in metres, heading in radians.
    """

    step: FloatArray

    def estimate(self, drive: Drive) -> Steps:
        """The steps of one whole drive."""
        return Steps.with_unknown_covariance(np.tile(self.step, (len(drive) - 1, 1)))


def held_motion() -> ConstantStep:
    """Repeats its own last estimate, and begins at rest: the odometry that never moves.

    It is what a matcher that holds its last motion on failure amounts to when it fails from the start.
    """
    return ConstantStep(np.zeros(3))


def mean_step(open_recording: OpenRecording, names: Sequence[str]) -> FloatArray | None:
    """The mean step (3,) of training drives; None, and a line in the log, where one cannot be read.

    Args:
        open_recording: name -> recording, of which the truth is needed and no scan.
        names: of the drives or of parts of them, as in ``data.train``.
    """
    try:
        steps = [_without_scans(open_recording, name).steps for name in names]
    except InputError as error:
        log.info("mean_motion is left out, since not all of data.train can be read: %s", error)
        return None
    return np.concatenate(steps).mean(0)  # type: ignore[no-any-return]


def _without_scans(open_recording: OpenRecording, name: str) -> Drive:
    recording = open_recording(parse_part(name).file)
    return cut({recording.name: Drive.unencoded(recording)}, name)
