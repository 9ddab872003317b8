"""An opened recording, and a drive: the recording with its encoded scans, as estimators get it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray, change_frame, motions_of, relative_steps
from rcnn_odom.recordings.scan import Scan

ReadScan = Callable[[int], Scan]
"""Reads the scan of a frame number."""
OpenRecording = Callable[[str], "Recording"]
"""Opens a recording by its name; picklable, because other processes encode the scans."""


def wants_deskew(choice: str, is_compensated: bool) -> bool:
    """Whether scans must be undistorted.

    Args:
        choice: ``on``, ``off``, or ``auto``, which means on unless the recording is compensated already.
        is_compensated: as in :class:`Recording`.

    >>> wants_deskew("auto", is_compensated=False)
    True
    """
    return choice == "on" or (choice == "auto" and not is_compensated)


@dataclass(frozen=True)
class Recording:
    """One drive: its scans in the order of the file, with the true pose of each.

    Attributes:
        name: the user's name of the recording, for instance ``05`` or ``mit-killian``.
        poses: (N, 4, 4) laser to world; nan if the true pose is unknown.
        stamps: (N,) seconds.
        read_scan: reads the scan of a frame; picklable, because other processes encode the scans.
        fingerprint: changes whenever ``read_scan`` would return other scans; part of the cache's key.
        camera_from_laser: (4, 4), KITTI's ``Tr``, to the frame in which trajectories are written.
        wheel_odometry: (N, 4, 4) laser poses from the robot's own odometry; None if there is none.
        notes: messages of the reader for the user.
        has_clock: whether the stamps show order and gaps of the scans; otherwise only the order of the file
            is used.
        is_compensated: whether the motion of the laser during a revolution is already removed from the scans.
        keeps_world: whether a training on new worlds keeps this drive, because its format makes no new ones.
        has_partial_laser: whether the laser may cover only a part of the sensor's field of view, with beams
            farther apart than the sensor's bins; the user sets it.
        trusted: (N,) whether the true step to a scan is good enough to learn from; None: all are.
    """

    name: str
    poses: FloatArray
    stamps: FloatArray
    read_scan: ReadScan
    fingerprint: str
    camera_from_laser: FloatArray = field(default_factory=FORWARD_CAMERA.copy)
    wheel_odometry: FloatArray | None = None
    notes: tuple[str, ...] = ()
    has_clock: bool = True
    is_compensated: bool = False
    keeps_world: bool = False
    has_partial_laser: bool = False
    trusted: npt.NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def __post_init__(self) -> None:
        assert self.poses.shape == (len(self.stamps), 4, 4), (self.name, self.poses.shape)
        assert self.poses.dtype == self.stamps.dtype == np.float64


@dataclass(frozen=True)
class Drive:
    """A recording, or a part of one, as estimators and metrics get it.

    Attributes:
        name: name of the recording; ``NAME[a:b]`` or ``NAME[a:b:n]`` for a part.
        key: changes whenever ``scans`` changes.
        scans: (N, bins) float32, the encoded scans: depth vectors in metres; (N, 0) for models that do not
            use them.
        poses: (N, 4, 4) true laser poses.
        stamps: (N,) seconds.
        camera_from_laser, wheel_odometry, has_clock, is_compensated, trusted, keeps_world: as in
            :class:`Recording`.
        read_scan: reads a scan of the recording by its frame number.
        frames: frame number of each scan in the recording; None: the drive is the whole recording.
    """

    name: str
    key: str
    scans: npt.NDArray[np.float32]
    poses: FloatArray
    stamps: FloatArray
    camera_from_laser: FloatArray
    wheel_odometry: FloatArray | None = None
    has_clock: bool = True
    is_compensated: bool = False
    trusted: npt.NDArray[np.bool_] | None = None
    read_scan: ReadScan | None = None
    frames: range | None = None
    keeps_world: bool = False

    @classmethod
    def from_recording(cls, recording: Recording, scans: npt.NDArray[np.float32], key: str) -> "Drive":
        """Make a drive of a whole recording with its encoded scans (N, bins) and their key."""
        return cls(
            name=recording.name,
            key=key,
            scans=scans,
            poses=recording.poses,
            stamps=recording.stamps,
            camera_from_laser=recording.camera_from_laser,
            wheel_odometry=recording.wheel_odometry,
            has_clock=recording.has_clock,
            is_compensated=recording.is_compensated,
            trusted=recording.trusted,
            read_scan=recording.read_scan,
            keeps_world=recording.keeps_world,
        )

    @classmethod
    def unencoded(cls, recording: Recording) -> "Drive":
        """Make a drive of a whole recording without encoded scans, for models that read the raw scans."""
        return cls.from_recording(recording, np.empty((len(recording), 0), np.float32), recording.fingerprint)

    def __len__(self) -> int:
        return len(self.scans)

    def raw_scans(self) -> Iterator[Scan]:
        """Yield the scans as the laser measured them; without stamps if ``has_clock`` is false."""
        assert self.read_scan is not None, f"{self.name} was made of encoded scans alone"
        for frame in self.frames or range(len(self)):
            scan = self.read_scan(frame)
            yield scan if self.has_clock else replace(scan, stamp=None)

    @cached_property
    def steps(self) -> FloatArray:
        """True steps (N-1, 3): x and y in metres, heading in radians."""
        return relative_steps(self.poses)

    @property
    def motions(self) -> FloatArray:
        """The paper's motions of the true steps, (N-1, 2): distance (metres) and heading change (radians)."""
        return motions_of(self.steps)

    @property
    def camera_poses(self) -> FloatArray:
        """True poses (N, 4, 4) of the camera, the frame of trajectory files."""
        return change_frame(self.poses, self.camera_from_laser)

    def part(self, start: int, stop: int, name: str | None = None) -> "Drive":
        """Frames start..stop-1 of the drive, without copying; ``name`` None: keep the drive's name."""
        wheel = self.wheel_odometry
        return replace(
            self,
            name=name or self.name,
            scans=self.scans[start:stop],
            poses=self.poses[start:stop],
            stamps=self.stamps[start:stop],
            wheel_odometry=None if wheel is None else wheel[start:stop],
            trusted=None if self.trusted is None else self.trusted[start:stop],
            frames=(self.frames or range(len(self)))[start:stop],
        )

    def thin(self, every: int) -> "Drive":
        """The first frame and every ``every``-th frame after it, without copying; 1: all frames."""
        wheel = self.wheel_odometry
        return replace(
            self,
            scans=self.scans[::every],
            poses=self.poses[::every],
            stamps=self.stamps[::every],
            wheel_odometry=None if wheel is None else wheel[::every],
            trusted=None if self.trusted is None else _trust_merged_steps(self.trusted, every),
            frames=(self.frames or range(len(self)))[::every],
        )


def _trust_merged_steps(trusted: npt.NDArray[np.bool_], every: int) -> npt.NDArray[np.bool_]:
    """Which steps between the remaining scans are trusted: those of which all original steps (N,) are.

    Args:
        trusted: (N,) whether the step to each scan is trusted.
        every: the first scan and every ``every``-th scan after it remain.

    Returns:
        (M,) one value for each remaining scan.
    """
    steps = np.concatenate([np.ones(every - 1, dtype=np.bool_), trusted])
    steps = steps[: (len(steps) // every) * every].reshape(-1, every)
    return np.logical_and.reduce(steps, axis=1)  # type: ignore[no-any-return]
