"""Loads recordings without poses for training: any format that can be streamed, with truth from elsewhere."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, planar_to_poses
from rcnn_odom.options import option
from rcnn_odom.recordings.formats import open_stream
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.reference import MATCHER, find_trajectory, read_reference, strip_endings
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream


def _is_slice(height: list[float]) -> bool:
    return len(height) == 2 and all(type(each) in (int, float) for each in height) and height[0] < height[1]


@dataclass(kw_only=True)
class Options:
    """Options of ``conf/data/logs.yaml`` that are not common to all recordings."""

    reference: str | None = None
    topic: str | None = None
    ring: int | None = option(default=None, least=0, wanted="null or a whole number, not negative")
    height: list[float] | None = option(  # noqa: RUF009
        default=None, fits=_is_slice, wanted="null or two heights in metres, for instance [-0.1,0.1]"
    )
    field_of_view_deg: float | None = option(default=None, above=0)


def load(
    name: str,
    *,
    root: str | Path,
    reference: str | Path | None = None,
    topic: str | None = None,
    ring: int | None = None,
    height: list[float] | None = None,
    field_of_view_deg: float | None = None,
) -> Recording:
    """Load a recording of any format that can be streamed; its scans are kept in memory.

    Args:
        name: file or folder of the recording, relative to ``root`` or absolute.
        root: folder of the recordings.
        reference: ``matcher``: the poses are nan, to be filled in by scan matching. Otherwise a trajectory
            file, or its folder: see :func:`rcnn_odom.recordings.reference.find_trajectory`.
        topic, ring, height, field_of_view_deg: as for :func:`rcnn_odom.recordings.formats.open_stream`;
            ``height`` is (2,) metres.

    Raises:
        InputError: there is no such recording, it cannot be read to its end, or it has no reference.
    """
    path = Path(root).expanduser() / Path(name).expanduser()
    options = {"topic": topic, "ring": ring, "height": height and tuple(height)}
    stream = open_stream(path, options | {"field_of_view_deg": field_of_view_deg})
    if reference is None:
        raise InputError(
            f"{path}: has no poses to learn from; set data.reference=matcher for poses from scan matching, "
            f"or data.reference=FOLDER with a trajectory {strip_endings(name)}.tum in it"
        )
    scans = _share_arrays(stream.scans)
    if len(scans) < 2:
        raise InputError(f"{path}: has {len(scans)} scans, but a step needs two; leave it out")
    stamps, has_clock = _collect_stamps(scans, stream)
    notes = [*stream.notes, *_make_notes(scans, stream)]
    if str(reference) == MATCHER:
        poses = np.full((len(scans), 4, 4), np.nan)
    else:
        trajectory = find_trajectory(Path(reference), name, has_clock)
        poses, reference_notes = read_reference(trajectory, stamps, has_clock, stream.camera_from_laser)
        notes += reference_notes
    return Recording(
        name=name,
        poses=poses,
        stamps=stamps,
        read_scan=scans.__getitem__,
        fingerprint=_fingerprint(scans, has_clock),
        camera_from_laser=stream.camera_from_laser,
        wheel_odometry=_collect_wheel_poses(scans),
        notes=tuple(notes),
        has_clock=has_clock,
        is_compensated=stream.is_compensated,
    )


def _share_arrays(scans: Iterable[Scan]) -> list[Scan]:
    """Collect scans; equal bearings and times of scans in a row share one array, to save memory."""
    kept: list[Scan] = []
    for scan in scans:
        same = {
            name: getattr(kept[-1], name)
            for name in ("bearings", "times")
            if kept and _are_equal(getattr(kept[-1], name), getattr(scan, name))
        }
        kept.append(replace(scan, **same))
    return kept


def _are_equal(before: FloatArray | None, now: FloatArray | None) -> bool:
    return before is not None and now is not None and np.array_equal(before, now)


def _collect_stamps(scans: list[Scan], stream: ScanStream) -> tuple[FloatArray, bool]:
    """Stamps (N,) in seconds, all zeros if one is missing, and whether they show order and gaps of scans."""
    stamps = [scan.stamp for scan in scans if scan.stamp is not None and np.isfinite(scan.stamp)]
    if len(stamps) < len(scans):
        return np.zeros(len(scans)), False
    return np.array(stamps, dtype=np.float64), stream.has_clock


def _make_notes(scans: list[Scan], stream: ScanStream) -> list[str]:
    notes = [] if stream.total == len(scans) else [f"{len(scans)} scans"]
    if stream.beams:
        notes.append(f"its beams lie {stream.beams}")
    skipped = ", ".join(f"{count} {kind}" for kind, count in sorted(stream.skipped.items()))
    return [*notes, f"skipped: {skipped}"] if skipped else notes


def _collect_wheel_poses(scans: list[Scan]) -> FloatArray | None:
    """Poses (N, 4, 4) of the laser from the robot's odometry; None if one is missing."""
    wheels = [scan.wheel_pose for scan in scans if scan.wheel_pose is not None]
    return planar_to_poses(wheels) if len(wheels) == len(scans) else None


def _fingerprint(scans: list[Scan], has_clock: bool) -> str:
    """Hash of the content of all scans."""
    digest = hashlib.sha256(f"logs {len(scans)} {has_clock}".encode())
    for scan in scans:
        digest.update(f"{scan.stamp} {scan.frame_id} {scan.has_all_beams} {len(scan.ranges)}".encode())
        for values in (scan.ranges, scan.bearings, scan.times):
            digest.update(b"-" if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
