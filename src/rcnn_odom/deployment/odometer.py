"""Streaming odometry: one scan in, one pose out, in constant memory."""

import math
from collections import deque
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import ApplyStep, FloatArray, advance, planar_to_poses
from rcnn_odom.models.encoding import Sensor, decode, encode

LONGEST_HOLD = 10
"""Periods over which the last motion goes on; for longer it is not known to."""
REMEMBERED = 15
"""Intervals that tell the usual period."""
FOLLOWING = 0.2
"""Part of a stamp's jitter that the expected time of the next scan follows."""
FOREVER = 1e9
"""Periods that no longer differ; a wild stamp is farther away than an integer can tell."""
SLOW = 1.5
"""Times the period of training from which on steps are longer than a network knows."""
SAME_SPACING = 0.2
"""Part by which the spacing of a laser's returns may differ between scans."""
LATE = "late scan"
LATE_IN_A_ROW = 5
"""After so many late scans it is the clock that has been set."""


@dataclass(frozen=True)
class Description:
    """What an odometer has to know of its network.

    Attributes:
        sensor: that the network was trained for.
        apply: where along its turn a step is taken.
        typical_motion: root mean square of the training motions, metres and radians.
        least_filled: share of bins with a return below which a scan counts as sparse; nan if unknown.
        period: usual seconds between scans in training; nan if unknown.
    """

    sensor: Sensor
    apply: ApplyStep
    typical_motion: tuple[float, float]
    least_filled: float
    period: float


class Stepper(Protocol):
    """A network that estimates one motion after the other and carries its own state."""

    description: Description

    def __call__(self, pair: npt.NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        """Motion (2,) and its standard deviations (2,) from scans (2, bins) in metres, the earlier first."""

    def reset(self) -> None:
        """Forgets all earlier pairs."""


@dataclass(frozen=True)
class Pose:
    """Where the laser is, seen from where its first scan was taken, and the step since the last pose.

    Attributes:
        stamp: seconds, of the scan; None where it has none.
        x, y: metres, x ahead and y to the left of the first scan.
        heading: radians, counter-clockwise, not wrapped.
        distance, turn: the step, metres and radians.
        distance_deviation, turn_deviation: its standard deviations, which hold 68 % of the errors on
            validation drives; nan where the network's uncertainty has not been fitted. Where the last
            motion only went on, as large as typical motions.
        degraded: empty, or in words why the estimate is worse than its network's usual.
    """

    stamp: float | None = None
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    distance: float = 0.0
    turn: float = 0.0
    distance_deviation: float = 0.0
    turn_deviation: float = 0.0
    degraded: str = ""

    def matrix(self) -> FloatArray:
        """Laser to the frame of the first scan, (4, 4)."""
        return planar_to_poses([[self.x, self.y, self.heading]])[0]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, None in place of nan."""
        return {key: None if value != value else value for key, value in asdict(self).items()}


NO_STEP = dict.fromkeys(("distance", "turn", "distance_deviation", "turn_deviation"), 0.0)


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
      After ``LATE_IN_A_ROW`` of them the clock is taken as set, and it goes on as after a gap.
    - *slow scans*: more than 1.5 times the period of training between them; the estimate stands.
    - *fast scans*: less than the period of training over 1.5; the estimate stands, but gaps are counted in
      periods of training, so that short ones are not noticed and over long ones too little is held.
    - *beam count*, other than before: the scan is encoded into the same bins as any other.
    - *few returns*: less than half as many bins have one as in any validation scan; the estimate stands.
    - *no estimate*: the network gave nan or inf; the last motion goes on, and the LSTM starts anew.

    Args:
        stepper: the network.
    """

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper
        self.description = stepper.description
        self._spaced: tuple[int, FloatArray] = (0, np.empty(0))
        self.reset()

    @classmethod
    def from_checkpoint(cls, path: str | Path) -> "Odometer":
        """The network of a run's checkpoint, computed by PyTorch, on as many threads as it is set to.

        Raises:
            InputError: not a checkpoint of this project.
        """
        from rcnn_odom.training.checkpoint import load_module
        from rcnn_odom.training.checkpoint_stepper import CheckpointStepper

        return cls(CheckpointStepper(load_module(path)))

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
        from rcnn_odom.deployment.onnx_model import OnnxStepper
        from rcnn_odom.deployment.shipped import find_model

        odometer = cls(OnnxStepper(find_model(path), threads))
        if sensor is not None and odometer.description.sensor != sensor:
            raise InputError(
                f"{path}: made for {odometer.description.sensor}, not {sensor}; take a fitting one"
            )
        return odometer

    def reset(self) -> None:
        """Begins anew: the next scan is the origin."""
        self._stepper.reset()
        self._scan: npt.NDArray[np.float32] | None = None
        self._pose, self._motion, self._told = np.zeros(3), np.zeros(2), Pose()
        self._missed, self._held, self._beams, self._spacing = 0, 0, 0, 0.0
        self._forget_clock()

    def _forget_clock(self) -> None:
        self._stamp: float | None = None
        self._expected, self._late, self._unstamped = 0.0, 0, 0
        self._intervals: deque[float] = deque(maxlen=REMEMBERED)

    def step(
        self, scan: npt.ArrayLike, stamp: float | None = None, angles: npt.ArrayLike | None = None
    ) -> Pose:
        """The pose at one more scan.

        Args:
            scan: ranges (P,) in metres, counter-clockwise, or points (P, 2 or more), x ahead and y to
                the left in metres. What is not positive, not finite, or at the sensor's maximum range or
                beyond it is no return.
            stamp: seconds. Without one (None, nan) the scan counts as the next after the last one.
            angles: of the ranges, (P,) radians, 0 ahead, counter-clockwise. None: evenly over the
                sensor's field of view, from its right end or from behind on.

        Raises:
            ValueError: the arrays' shapes do not fit.
        """
        stamp = None if stamp is None or not math.isfinite(stamp) else float(stamp)
        lost = 0
        if stamp is not None and self._stamp is not None and stamp <= self._stamp:
            self._late += 1
            if self._late < LATE_IN_A_ROW:
                late = f"{LATE}: stamp {stamp:.6f} is not after {self._stamp:.6f}, passed over"
                return replace(self._told, **NO_STEP, degraded=late)
            lost = self._late - 1
            self._forget_clock()
        depth, notes = self._encode(scan, angles)
        periods = lost + self._count_periods(stamp, notes)
        if self._scan is None:
            return self._begin(depth, stamp, notes)
        if not depth.any():
            self._missed += periods
            return self._hold(stamp, periods, ["no returns: the last motion goes on"])
        earlier, gap = self._scan, periods + self._missed
        self._scan, self._missed = depth, 0
        if gap > 1:
            notes.append(f"gap: {gap} periods after the last scan, the last motion goes on")
            return self._hold(stamp, periods, notes)
        motion, deviation = self._stepper(np.stack([earlier, depth]))
        if not np.isfinite(motion).all():
            self._stepper.reset()  # its state is nan as well
            return self._hold(stamp, periods, [*notes, "no estimate: the last motion goes on"])
        self._motion, self._held = motion, 0
        self._pose = advance(self._pose, motion, self.description.apply)
        return self._tell(stamp, motion, deviation, notes)

    def returns(self) -> npt.NDArray[np.float32]:
        """The last scan with returns as points (P, 2) in the frame of the first one: bins with a return."""
        if self._scan is None:
            return np.empty((0, 2), np.float32)
        pose = planar_to_poses(self._pose[None])[0]
        points = decode(self._scan, self.description.sensor)
        return (points @ pose[:2, :2].T + pose[:2, 3]).astype(np.float32)

    def _encode(
        self, scan: npt.ArrayLike, angles: npt.ArrayLike | None
    ) -> tuple[npt.NDArray[np.float32], list[str]]:
        """A depth vector (bins,), and what is unusual about it."""
        sensor, notes = self.description.sensor, []
        values = np.asarray(scan, dtype=np.float64)
        if values.ndim == 2 and values.shape[1] >= 2:
            x, y = values[:, 0], values[:, 1]
            depth = encode(np.arctan2(y, x), np.hypot(x, y), sensor)
        elif values.ndim == 1 and (angles is None or np.shape(angles) == values.shape):
            given = self._spread(len(values)) if angles is None else np.asarray(angles, dtype=np.float64)
            depth = encode(given, values, sensor)
            notes += self._compare_beams(given, exactly=angles is None)
        else:
            shapes = f"{values.shape} with angles of {None if angles is None else np.shape(angles)}"
            raise ValueError(f"a scan is ranges (P,) with as many angles, or points (P, 2), not {shapes}")
        filled = np.count_nonzero(depth) / len(depth)
        if filled < self.description.least_filled:
            notes.append(f"few returns: {filled:.1%} of the bins have one")
        return depth, notes

    def _compare_beams(self, angles: FloatArray, exactly: bool) -> list[str]:
        """Words about another number of beams than before, if there is one.

        Given angles may be those of the returns alone, whose number changes: then only another spacing
        counts, that of most neighbours.
        """
        before, count = self._beams, len(angles)
        if count == before or count < 2:
            return []
        spacing, self._beams = float(np.median(np.abs(np.diff(angles)))), count
        last, self._spacing = self._spacing, spacing
        same = not before or (not exactly and abs(spacing - last) < SAME_SPACING * last)
        return [] if same else [f"beam count: {count} after {before}"]

    def _spread(self, beams: int) -> FloatArray:
        """Angles (beams,) in radians over the sensor's field of view."""
        if self._spaced[0] != beams:
            half = math.radians(self.description.sensor.field_of_view_deg) / 2
            closes_circle = self.description.sensor.field_of_view_deg == 360
            self._spaced = beams, np.linspace(-half, half, beams, endpoint=not closes_circle)
        return self._spaced[1]

    def _count_periods(self, stamp: float | None, notes: list[str]) -> int:
        """How many usual periods after the last stamp this one comes, 1 or more; without stamps 1.

        Measured from where the last scan was expected, which follows a jittering or bursty clock slowly.
        """
        if stamp is None:
            self._unstamped += 1
            return 1
        before, self._stamp, self._late = self._stamp, stamp, 0
        scans, self._unstamped = 1 + self._unstamped, 0
        if before is None:
            self._expected = stamp
            return 1
        trained = self.description.period
        # The median does without single gaps, the mean without bursts.
        middles = [np.median(self._intervals), np.mean(self._intervals)] if len(self._intervals) >= 3 else []
        recent = float(min(middles, default=math.nan))
        usual = float(np.fmax(recent, trained))
        self._intervals.append((stamp - before) / scans)
        if math.isnan(usual):
            self._expected = stamp
            return 1
        if recent > SLOW * trained:
            notes.append(f"slow scans: one every {recent:.3g} s, in training every {trained:.3g} s")
        elif max(middles, default=math.inf) * SLOW < trained:
            notes.append(f"fast scans: one every {recent:.3g} s, in training every {trained:.3g} s")
        late = stamp - self._expected - scans * usual
        lost = max(0, round(min(late / usual, FOREVER)))
        self._expected = stamp - (1 - FOLLOWING) * (late - lost * usual)
        return 1 + lost

    def _begin(self, depth: npt.NDArray[np.float32], stamp: float | None, notes: list[str]) -> Pose:
        """The pose of the first scan that has returns, and of those before it: the origin."""
        if depth.any():
            self._scan = depth
        else:
            notes = ["no returns: none since the start"]
        return self._tell(stamp, np.zeros(2), np.zeros(2), notes)

    def _hold(self, stamp: float | None, periods: int, notes: list[str]) -> Pose:
        """A pose where the last motion goes on, over ``LONGEST_HOLD`` periods in all at most."""
        moving = min(periods, LONGEST_HOLD - self._held)
        self._held += moving
        for _ in range(moving):
            self._pose = advance(self._pose, self._motion, self.description.apply)
        typical = periods * np.array(self.description.typical_motion)
        return self._tell(stamp, moving * self._motion, typical, notes)

    def _tell(self, stamp: float | None, motion: FloatArray, deviation: FloatArray, notes: list[str]) -> Pose:
        (x, y, heading), (distance, turn) = self._pose.tolist(), motion.tolist()
        deviations = [float(value) for value in deviation]
        self._told = Pose(
            stamp, x, y, heading, distance, turn, deviations[0], deviations[1], degraded="; ".join(notes)
        )
        return self._told
