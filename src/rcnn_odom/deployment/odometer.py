"""Streaming odometry: one scan in, one pose out, in constant memory."""

import math
import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.deployment.clock import LATE, Clock
from rcnn_odom.deployment.onnx_model import OnnxStepper
from rcnn_odom.deployment.shipped import find_file
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, Step, advance, planar_to_poses
from rcnn_odom.models.contract import Stepper
from rcnn_odom.models.encoding import Sensor, decode
from rcnn_odom.recordings.beams import PATIENCE, BeamCheck
from rcnn_odom.recordings.scan import Scan

LONGEST_HOLD = 10
"""Periods over which the last motion goes on; for longer it is not known to."""
SAME_SPACING = 0.2
"""Part by which the spacing of a laser's returns may differ between scans."""
OTHER_FRAME, OTHER_LASER = "other frame", "other laser"
PASSED_OVER = (LATE, OTHER_FRAME)
"""Kinds of trouble whose scans leave the pose as it was."""


def _no_step() -> Step:
    """A zero step with zero covariance, for the first pose and for repeated poses."""
    return Step(0.0, 0.0, 0.0, np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the laser is, seen from where its first scan was taken, and the step since the last pose.

    Attributes:
        stamp: seconds, of the scan; None where it has none.
        x, y: metres, x ahead and y to the left of the first scan.
        heading: radians, counter-clockwise, not wrapped.
        step: from the pose before. Its covariance is fitted so that 68 % of the errors on validation drives
            lie within one standard deviation; nan where the network does not know it. Where the last motion
            only went on, the deviations are as large as typical motions.
        degraded: empty, or in words why the estimate is worse than its network's usual.
    """

    stamp: float | None = None
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    step: Step = field(default_factory=_no_step)
    degraded: str = ""

    def matrix(self) -> FloatArray:
        """Laser to the frame of the first scan, (4, 4)."""
        return planar_to_poses([[self.x, self.y, self.heading]])[0]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, None in place of nan."""
        return {
            "stamp": self.stamp,
            "x": self.x,
            "y": self.y,
            "heading": self.heading,
            "step": self.step.array().tolist(),
            "covariance": [
                [None if math.isnan(value) else value for value in row]
                for row in self.step.covariance.tolist()
            ],
            "degraded": self.degraded,
        }


class Odometer:
    """Poses from the scans of one laser, in their order.

    What may go wrong in a stream never raises and leaves the LSTM's state as it was. The pose's
    ``degraded`` then says what happened, the kind of it before a colon:

    - *no returns*: the last motion goes on, as over a gap.
    - *gap*, where scans were dropped or had no returns, so that more than one usual period has passed
      (of recent scans, but at least that of training): the last motion goes on over it, for
      ``LONGEST_HOLD`` periods at most. Networks do not know such long steps; comparing the scans at both
      ends all the same is several times worse (docs/deployment.md).
    - *late scan*, a stamp not after the one before: passed over, and the pose is the last one again.
      After five of them in a row the clock is taken as set, and it goes on as after a gap. After five scans
      with the very stamp of the scan before the clock is coarse: such scans then count as the next ones.
    - *clock set*, a stamp more than ten seconds before or after the last one: nobody knows how much time has
      passed, so no motion is added, the step's covariance is unknown, and the new stamps are the clock from
      there on; after five jumps in a row stamps no longer count. A stamp of 0, always, at first or among
      others, is none.
    - *other frame*, a scan of another ``frame_id`` than the scans before: passed over as of another laser.
      After five of them in a row it is the laser's (*new frame*), and no motion is added to there.
    - *other laser*, beams that do not lie where the sensor has them, or readings that cannot be metres (see
      :mod:`rcnn_odom.recordings.beams`): not used, the last motion goes on.
    - *slow scans*: more than 1.5 times the period of training between them; the estimate stands.
    - *fast scans*: less than the period of training over 1.5; the estimate stands, but gaps are counted in
      periods of training, so that short ones are not noticed and over long ones too little is held.
    - *beam count*, other than before: the scan is encoded into the same bins as any other.
    - *few returns*: less than half as many bins have one as in nearly all (95 %) of the validation scans; the
      estimate stands.
    - *no estimate*: the network gave nan or inf; the last motion goes on, and the LSTM starts anew.

    Args:
        stepper: the network.

    Attributes:
        description: of the network.
        beam_check: compares the scans' beams with those that it knows.
        estimates: steps that it has given.
    """

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper
        self.description = stepper.description
        self.reset()

    @classmethod
    def from_onnx(cls, path: str | Path, sensor: Sensor | None = None, threads: int = 1) -> "Odometer":
        """The network of a file written by ``rcnn-odom export``, computed by ONNX Runtime.

        Args:
            path: the file, or the name of a model that ships with the project, ``rcnn_small``.
            sensor: which it must have been trained for; None for any.
            threads: of the computation.

        Raises:
            InputError: no such file, not one of ``rcnn-odom export``, or of another sensor.
        """
        odometer = cls(OnnxStepper(find_file(path), threads))
        if sensor is not None and odometer.description.sensor != sensor:
            raise InputError(
                f"{path}: made for {odometer.description.sensor}, not {sensor}; take a fitting one"
            )
        return odometer

    @classmethod
    def from_checkpoint(cls, path: str | Path) -> "Odometer":
        """Tells where to go with a checkpoint, which is exported before it runs.

        Raises:
            InputError: always.
        """
        raise InputError(
            f"{path}: a checkpoint is exported before it runs: rcnn-odom export {shlex.quote(str(path))}, "
            f"then Odometer.from_onnx; at once: rcnn_odom.training.export.load_odometer({str(path)!r})"
        )

    def reset(self) -> None:
        """Begins anew: the next scan is the origin."""
        self._stepper.reset()
        self._earlier: npt.NDArray[np.float32] | None = None  # the last scan with returns
        self._present: npt.NDArray[np.float32] | None = None  # the scan that was taken at the last pose
        self._position, self._motion, self._last_pose = np.zeros(3), np.zeros(3), Pose()
        self._missed, self._held, self._beams, self._spacing = 0, 0, 0, 0.0
        self._frame, self._of_other_frame, self._begun = "", 0, False
        self._ranges, self.estimates = np.empty(0), 0
        self.beam_check = BeamCheck(self.description.sensor)
        self._clock = Clock(self.description.period)

    @property
    def has_seen(self) -> bool:
        """Whether there is a scan with returns that the next one can be compared with."""
        return self._earlier is not None

    def step(
        self, scan: Scan | npt.ArrayLike, stamp: float | None = None, angles: npt.ArrayLike | None = None
    ) -> Pose:
        """The pose at one more scan.

        Args:
            scan: a :class:`Scan`, which has its own stamp and bearings; or ranges (P,) in metres,
                counter-clockwise; or points (P, 2 or more), x ahead and y to the left in metres. What is not
                positive, not finite, or at the sensor's maximum range or beyond it is no return.
            stamp: seconds, of ranges or points. Without one (None, nan) the scan counts as the next after
                the last one.
            angles: of the ranges, (P,) radians, 0 ahead, counter-clockwise. None: evenly over the
                sensor's field of view, from its right end or from behind on.

        Raises:
            ValueError: the arrays' shapes do not fit.

        >>> pose = Odometer.from_onnx("rcnn_small").step(np.full(3601, 8.0))
        >>> pose.x, pose.y, pose.heading, pose.degraded
        (0.0, 0.0, 0.0, '')
        """
        if not isinstance(scan, Scan):
            scan = _as_scan(scan, stamp, angles)
        stamp = None if scan.stamp is None or not math.isfinite(scan.stamp) else float(scan.stamp)
        self._present = None
        frame = scan.frame_id.lstrip("/")
        if frame and self._frame and frame != self._frame and self.beam_check.fitting:
            self._of_other_frame += 1
            if self._of_other_frame < PATIENCE:
                return self._pass_over(f"{OTHER_FRAME}: {frame} after {self._frame}, passed over")
        tick = self._clock.read(stamp, repeats=np.array_equal(scan.ranges, self._ranges))
        self._ranges = scan.ranges
        if tick.late:
            return self._pass_over(tick.late)
        notes = self._follow_frame(frame)
        depth = self._encode(scan, notes)
        notes += tick.notes
        if self._earlier is None or tick.clock_set:
            return self._begin(depth, stamp, [*([tick.clock_set] if tick.clock_set else []), *notes])
        if not depth.any():
            self._missed += tick.periods
            return self._hold(stamp, tick.periods, notes)
        return self._compare(self._earlier, depth, stamp, tick.periods, notes)

    def returns(self) -> npt.NDArray[np.float32]:
        """Points (P, 2) of the last scan in the frame of the first one: its bins with a return.

        Empty if the last scan had no return or was not used.
        """
        if self._present is None:
            return np.empty((0, 2), np.float32)
        pose = planar_to_poses(self._position[None])[0]
        points = decode(self._present, self.description.sensor)
        return (points @ pose[:2, :2].T + pose[:2, 3]).astype(np.float32)

    def _pass_over(self, why: str) -> Pose:
        """The last pose again, for a scan that is not used."""
        return replace(self._last_pose, step=_no_step(), degraded=why)

    def _follow_frame(self, frame: str) -> list[str]:
        """Takes a scan's frame for the laser's; words about it where the laser had another one."""
        before, self._frame, self._of_other_frame = self._frame, frame or self._frame, 0
        if before == self._frame or not before:
            return []
        # Another laser, or another place of it: nothing of before can be compared with its scans.
        self._stepper.reset()
        self._earlier, self._missed, self._motion = None, 0, np.zeros(3)
        self.beam_check = BeamCheck(self.description.sensor)
        return [f"new frame: {frame} after {before}, no motion is added"]

    def _encode(self, scan: Scan, notes: list[str]) -> npt.NDArray[np.float32]:
        """A depth vector (bins,), empty where the scan does not fit; adds what is unusual to ``notes``."""
        sensor = self.description.sensor
        if misfit := self.beam_check(scan):
            notes.append(f"{OTHER_LASER}: {misfit}")
            self._present = np.zeros(sensor.bins, np.float32)
            return self._present
        depth = self._present = sensor.encode(scan)
        if not depth.any():
            notes.append("no returns: the last motion goes on" if self.has_seen else "no returns: none yet")
            return depth
        notes += self._compare_beams(scan)
        filled = np.count_nonzero(depth) / len(depth)
        if filled < self.description.least_filled:
            notes.append(f"few returns: {filled:.1%} of the bins have one")
        return depth

    def _compare_beams(self, scan: Scan) -> list[str]:
        """Words about another number of beams than before, if there is one.

        Where bearings are given, only another spacing counts, that of most neighbours: they may be those of
        the returns alone, whose number changes.
        """
        before, last, count = self._beams, self._spacing, len(scan.ranges)
        if not scan.has_all_beams or count == before or count < 2:
            return []
        spacing = math.nan if scan.bearings is None else float(np.median(np.diff(np.sort(scan.bearings))))
        self._beams, self._spacing = count, spacing
        same = not before or abs(spacing - last) < SAME_SPACING * last
        return [] if same else [f"beam count: {count} after {before}"]

    def _compare(
        self,
        earlier: npt.NDArray[np.float32],
        depth: npt.NDArray[np.float32],
        stamp: float | None,
        periods: int,
        notes: list[str],
    ) -> Pose:
        """The pose at a scan that is compared with the last one with returns, if that is a period ago."""
        gap = periods + self._missed
        self._earlier, self._missed = depth, 0
        if gap > 1:
            notes.append(f"gap: {gap} periods after the last scan, the last motion goes on")
            return self._hold(stamp, periods, notes)
        step = self._stepper(np.stack([earlier, depth]))
        if not np.isfinite(step.array()).all():
            self._stepper.reset()  # its state is nan as well
            return self._hold(stamp, periods, [*notes, "no estimate: the last motion goes on"])
        self._motion, self._held = step.array(), 0
        self.estimates += 1
        return self._move(stamp, step, notes)

    def _begin(self, depth: npt.NDArray[np.float32], stamp: float | None, notes: list[str]) -> Pose:
        """A pose without motion: at the start, which is certain, or where nobody knows how far it went."""
        step = Step(0.0, 0.0, 0.0) if self._begun else _no_step()
        self._earlier, self._missed = (depth if depth.any() else None), 0
        self._begun = self._begun or self.has_seen
        return self._move(stamp, step, notes)

    def _hold(self, stamp: float | None, periods: int, notes: list[str]) -> Pose:
        """A pose where the last motion goes on, over ``LONGEST_HOLD`` periods in all at most."""
        moving = min(periods, LONGEST_HOLD - self._held)
        self._held += moving
        held = np.zeros(3)
        for _ in range(moving):
            held = advance(held, self._motion)
        typical = periods * np.array(self.description.typical_step)
        # What is unknown of one is unknown of its covariances with the others.
        covariance = np.diag(np.square(typical)) + 0 * np.outer(typical, typical)
        x, y, heading = held.tolist()
        return self._move(stamp, Step(x, y, heading, covariance), notes)

    def _move(self, stamp: float | None, step: Step, notes: list[str]) -> Pose:
        """The pose after a step."""
        self._position = advance(self._position, step.array())
        x, y, heading = self._position.tolist()
        self._last_pose = Pose(stamp, x, y, heading, step, "; ".join(notes))
        return self._last_pose


def _as_scan(values: npt.ArrayLike, stamp: float | None, angles: npt.ArrayLike | None) -> Scan:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim == 2:
        return Scan.from_points(values, stamp)
    bearings = None if angles is None else np.asarray(angles, dtype=np.float64)
    return Scan(values, bearings, stamp=stamp)
