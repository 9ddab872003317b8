"""What every recording looks like once it has been opened, and a drive as estimators are given it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray, change_frame, motions_of, relative_steps
from rcnn_odom.recordings.scan import Scan

ReadScan = Callable[[int], Scan]
"""Frame number -> its scan."""
OpenRecording = Callable[[str], "Recording"]
"""Name -> the recording; picklable, since encoding runs in processes."""


def wants_deskew(choice: str, is_compensated: bool) -> bool:
    """Whether scans are to be undistorted.

    Args:
        choice: ``on``, ``off``, or ``auto``: unless the recording is compensated already.
        is_compensated: as of :class:`Recording`.
    """
    return choice == "on" or (choice == "auto" and not is_compensated)


@dataclass(frozen=True)
class Recording:
    """One drive: scans in file order with the truth about where each was taken.

    Attributes:
        name: as a user names it, for instance ``05`` or ``mit-killian``.
        poses: (N, 4, 4) laser to world. nan where the truth is unknown.
        stamps: (N,) seconds.
        read_scan: one frame's scan; a picklable callable, since encoding runs in processes.
        fingerprint: changes whenever ``read_scan`` would return something else: the cache's key.
        camera_from_laser: (4, 4), KITTI's ``Tr``: the frame in which trajectories are written.
        wheel_odometry: (N, 4, 4) laser poses by the robot's own odometry, where the log has them.
        notes: what the reader noticed, counted or flagged, in words for the user.
        has_clock: the stamps tell of order and gaps; otherwise the order alone counts.
        is_compensated: the motion of the laser during a revolution has been taken out of its points already.
        keeps_world: there is no other drive of its kind, so that a training on new worlds keeps it.
        has_partial_laser: as the user says, the laser may see a part of what the sensor covers, with beams
            farther apart than the sensor's bins.
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
    """A recording, or a part of one, as estimators and scores are given it.

    Attributes:
        name: of the recording; of a part ``NAME[a:b]`` or ``NAME[a:b:n]``.
        key: changes whenever ``scans`` does.
        scans: (N, bins) float32, the encoded scans: depth vectors in metres; no bins for models that do not
            look at them.
        poses: (N, 4, 4) true laser poses.
        stamps: (N,) seconds.
        camera_from_laser, wheel_odometry, has_clock, is_compensated, trusted, keeps_world: as in
            :class:`Recording`.
        read_scan: of the recording.
        frames: the recording's frame of each scan; None: all of them.
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
    def of(cls, recording: Recording, scans: npt.NDArray[np.float32], key: str) -> "Drive":
        """A whole recording with its encoded scans (N, bins) and their key."""
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
        """A whole recording for models that look at whole scans."""
        return cls.of(recording, np.empty((len(recording), 0), np.float32), recording.fingerprint)

    def __len__(self) -> int:
        return len(self.scans)

    def raw_scans(self) -> Iterator[Scan]:
        """The scans as the laser gave them, one after the other; without stamps where there is no clock."""
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
        """The paper's two numbers of the true steps, (N-1, 2): metres and radians."""
        return motions_of(self.steps)

    @property
    def camera_poses(self) -> FloatArray:
        """True poses (N, 4, 4) in the frame of the trajectory files."""
        return change_frame(self.poses, self.camera_from_laser)

    def part(self, start: int, stop: int, name: str | None = None) -> "Drive":
        """Frames start..stop-1, without a copy."""
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
        """The first frame and every ``every``-th after it, without a copy; 1: all."""
        wheel = self.wheel_odometry
        return replace(
            self,
            scans=self.scans[::every],
            poses=self.poses[::every],
            stamps=self.stamps[::every],
            wheel_odometry=None if wheel is None else wheel[::every],
            trusted=None if self.trusted is None else _trust_all(self.trusted, every),
            frames=(self.frames or range(len(self)))[::every],
        )


def _trust_all(trusted: npt.NDArray[np.bool_], every: int) -> npt.NDArray[np.bool_]:
    """Whether all steps (N,) to a scan since the last one that stays are trusted, of the scans that stay."""
    steps = np.concatenate([np.ones(every - 1, dtype=np.bool_), trusted])
    steps = steps[: (len(steps) // every) * every].reshape(-1, every)
    return np.logical_and.reduce(steps, axis=1)  # type: ignore[no-any-return]
