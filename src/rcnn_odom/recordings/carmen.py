"""Reads CARMEN logs of robots with a planar laser: FLASER or ROBOTLASER1 lines, plain or compressed."""

import hashlib
import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, planar_to_poses, poses_to_planar
from rcnn_odom.recordings.broken_lines import BrokenLines
from rcnn_odom.recordings.carmen_log.front_laser import FrontLaser
from rcnn_odom.recordings.carmen_log.lines import PARSERS, LaserLine
from rcnn_odom.recordings.carmen_log.params import check_field_of_view, find_front_laser
from rcnn_odom.recordings.carmen_log.truth import (
    describe_truth,
    find_reference,
    laser_on_robot,
    read_truth,
    wheel_odometry,
)
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.reference import MATCHER
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.text import lines_of, need_text

log = logging.getLogger(__name__)

READER_VERSION = 3
"""Increase it when the same file would give other scans."""

SUFFIXES = tuple(
    kind + packing for kind in ("", ".log", ".clf") for packing in ("", ".gz", ".bz2", ".xz", ".zst")
)


def load(
    name: str,
    *,
    root: str | Path,
    reference: str | Path | None = None,
    field_of_view_deg: float | None = None,
    max_range: float | None = None,
) -> Recording:
    """Load a CARMEN log, its scans in the order of the file.

    The truth is the laser pose of each line, or the pose of the reference. Wheel odometry is the odometry
    pose of each line. On ROBOTLASER1 lines it is the pose of the robot, which is transformed to the laser by
    the offset between robot and laser on the first line; the offset is constant.

    Args:
        name: the log's file name, with or without .log or .clf and .gz, .bz2, .xz or .zst.
        root: the folder of the log.
        reference: a table (.csv) with ``raw_scan_index, ref_x, ref_y, ref_theta`` for every scan, or a
            folder that holds ``NAME_dense_ref.csv``. A value of nan means that the truth is unknown.
            ``matcher``: the poses are nan, to be filled in by scan matching.
        field_of_view_deg: degrees that the beams of FLASER lines cover. None: as the log's PARAM lines say,
            or 180 if they do not say it.
        max_range: metres; the notes count readings at or beyond it as no returns. None: the notes count only
            readings that are not positive, not finite, or at the line's own maximum range.

    Raises:
        InputError: there is no such file, or several; a line is broken; the log contradicts itself; or the
            reference does not belong to these scans.
    """
    check_field_of_view(field_of_view_deg)
    path = _find_log(Path(root), name)
    _need_log(path)
    front = find_front_laser(path, field_of_view_deg)
    other_lasers: Counter[str] = Counter()
    lines = list(_laser_lines(path, front.laser, other_lasers, strict=True))
    wheels = wheel_odometry(lines, laser_on_robot(lines[0]))
    beams = LogReader.from_lines(lines, wheels)
    poses, truth_notes = _find_truth(lines, name, reference)
    notes = [*_count_scans(lines, other_lasers), _count_no_returns(beams, max_range)]
    notes += [*_count_doubted(lines), *front.notes, *front.warnings]
    notes += [*_check_stamps(beams.stamps), *truth_notes]
    status = path.stat()
    key = f"carmen {READER_VERSION} {path.name} {status.st_size} {status.st_mtime_ns} {front.laser!r}"
    return Recording(
        name=name,
        poses=poses,
        stamps=beams.stamps,
        read_scan=beams,
        fingerprint=hashlib.sha256(key.encode()).hexdigest(),
        wheel_odometry=wheels,
        notes=tuple(notes),
        has_clock=False,
    )


def _find_truth(
    lines: list[LaserLine], name: str, reference: str | Path | None
) -> tuple[FloatArray, list[str]]:
    """Poses (N, 4, 4) of the laser from the log itself or from its reference, and notes about them."""
    if str(reference) == MATCHER:
        return np.full((len(lines), 4, 4), np.nan), []
    if reference is None:
        return planar_to_poses([line.laser for line in lines]), describe_truth(lines)
    return read_truth(find_reference(Path(reference), name), len(lines))


def recognises(path: Path) -> bool:
    """Whether the path is a file: only the lines of a file show whether it is a CARMEN log."""
    return path.is_file()


def stream(path: Path, field_of_view_deg: float | None = None) -> ScanStream:
    """Stream the scans of a log in the order of the file; their stamps are not trusted.

    Broken lines, lines of other lasers, and lines of another kind than the first one are skipped and counted.
    The whole file is first searched for parameters of the laser, so the scans equal those of :func:`load`.

    Args:
        path: path of the log, plain or compressed.
        field_of_view_deg: as in :func:`load`.

    Raises:
        InputError: the file is empty, is not text or contradicts itself, or the field of view is out of
            bounds. While ``scans`` is read: no line can be used, or the file cannot be read to its end.
    """
    check_field_of_view(field_of_view_deg)
    _need_log(path)
    front = find_front_laser(path, field_of_view_deg)
    for warning in front.warnings:
        log.warning("%s: %s", path, warning)
    skipped: Counter[str] = Counter()
    lines = _laser_lines(path, front.laser, skipped, strict=False)
    return ScanStream(
        name=path.name, scans=_read_scans(lines), has_clock=False, skipped=skipped, notes=tuple(front.notes)
    )


def _read_scans(lines: Iterator[LaserLine]) -> Iterator[Scan]:
    mount = None
    for line in lines:
        mount = laser_on_robot(line) if mount is None else mount
        yield LogReader.from_lines([line], wheel_odometry([line], mount))(0)


def _need_log(path: Path) -> None:
    head = need_text(path)
    if b"\0" in head and b"LASER" not in head:
        raise InputError(
            f"{path}: holds binary data, not text, so it is not a CARMEN log; give a KITTI sequence, "
            "a CARMEN log, a ROS bag or a file of JSON lines"
        )


def _laser_lines(path: Path, front: FrontLaser, others: Counter[str], strict: bool) -> Iterator[LaserLine]:
    """Yield the laser lines of a log in order.

    Args:
        path: path of the log.
        front: the laser of FLASER lines.
        others: counts the lines that are skipped, by their kind.
        strict: True: a broken line and a second kind of laser lines are errors. False: they are skipped.
    """
    first_kind, kinds, broken = None, set(), BrokenLines(str(path), "broken lines", others)
    refusal: InputError | None = None
    for number, kind, text in _candidates(path, others):
        if not strict and first_kind not in (None, kind):
            others[f"{kind} lines"] += 1
            continue
        kinds.add(kind)
        try:
            line = PARSERS[kind](text.split(), front)
        except ValueError as error:
            if strict and not refusal:
                refusal = InputError(f"{path}:{number}: broken {kind} line ({error}); correct or remove it")
            if refusal and first_kind:
                raise refusal from error
            broken.add(number, f"broken {kind} line", error)
            continue
        if refusal:  # raised only now, because a log without any good line gets an error about the whole file
            raise refusal
        if first_kind not in (None, kind):
            raise InputError(
                f"{path}:{number}: {kind} after {first_kind} lines, perhaps the same scans twice; "
                "keep one kind of them"
            )
        first_kind = kind
        broken.log_warnings()
        yield line
    if refusal and broken.count == 1:
        raise refusal
    if first_kind is None:
        raise InputError(_why_no_scan(path, " or ".join(sorted(kinds)), broken, others))


def _candidates(path: Path, others: Counter[str]) -> Iterator[tuple[int, str, str]]:
    """Number, kind and text of the lines of the front laser; counts the lines of other lasers."""
    for number, text in lines_of(path):
        kind = text.split(None, 1)[0] if text.strip() else ""
        if kind in PARSERS:
            yield number, kind, text
        elif "LASER" in kind and not kind.startswith("#"):
            others[f"{kind} lines"] += 1


def _why_no_scan(path: Path, kinds: str, broken: BrokenLines, others: Counter[str]) -> str:
    if broken.count:
        return (
            f"{path}: none of its {broken.count} {kinds} lines can be used; the first, {broken.first}; "
            "correct what they say about the laser"
        )
    found = f", only {', '.join(sorted(others))}" if others else ""
    return f"{path}: no FLASER or ROBOTLASER1 line in it{found}; convert the log to one of them"


@dataclass(frozen=True, eq=False)
class LogReader:
    """Gives the scan of a frame, all beams included, from memory.

    Readings at or beyond the log's maximum range become infinite: no return.

    The number of beams may change within a log, so the readings of all scans are kept in one array.

    Attributes:
        readings: (sum of P,) metres, the readings of one scan after those of the scan before.
        offsets: (N+1,) index of the first reading of each scan, and the number of all readings.
        first_angle, spacing: (N,) radians, direction of the first beam and angle from beam to beam.
        maximum: (N,) metres, maximum range of the laser.
        stamps: (N,) seconds.
        wheels: (N, 3) pose of the laser from wheel odometry: x and y in metres, heading in radians.
    """

    readings: FloatArray
    offsets: npt.NDArray[np.int64]
    first_angle: FloatArray
    spacing: FloatArray
    maximum: FloatArray
    stamps: FloatArray
    wheels: FloatArray

    @classmethod
    def from_lines(cls, lines: list[LaserLine], wheels: FloatArray) -> "LogReader":
        """Collect the beams of all lines, and the laser's poses (N, 4, 4) from wheel odometry."""
        return cls(
            readings=np.concatenate([line.readings for line in lines]),
            offsets=np.cumsum([0, *(len(line.readings) for line in lines)]),
            first_angle=np.array([line.first_angle for line in lines]),
            spacing=np.array([line.spacing for line in lines]),
            maximum=np.array([line.maximum for line in lines]),
            stamps=np.array([line.stamp for line in lines]),
            wheels=poses_to_planar(wheels),
        )

    def __call__(self, frame: int) -> Scan:
        """The scan of a frame; an infinite range is a reading at or beyond the log's maximum range."""
        ranges = self.readings[self.offsets[frame] : self.offsets[frame + 1]]
        bearings = self.first_angle[frame] + self.spacing[frame] * np.arange(len(ranges))
        ranges = np.where(ranges >= self.maximum[frame], np.inf, ranges)
        x, y, heading = map(float, self.wheels[frame])
        return Scan(ranges, bearings, stamp=float(self.stamps[frame]), wheel_pose=(x, y, heading))


def _find_log(root: Path, name: str) -> Path:
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; set data.root to the folder of the log")
    if (root / name).is_file():
        return root / name
    found = [root / (name + suffix) for suffix in SUFFIXES if (root / (name + suffix)).is_file()]
    if not found:
        raise InputError(
            f"{root / name}: no such file, nor with .log or .clf and .gz, .bz2, .xz or .zst; correct the name"
        )
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"{root / name}: several files match ({names}); give the full name of one")
    return found[0]


def _count_scans(lines: list[LaserLine], other_lasers: Counter[str]) -> list[str]:
    beams = Counter(len(line.readings) for line in lines)
    usual, scans = beams.most_common(1)[0]
    notes = [f"{len(lines)} scans of {usual} beams ({lines[0].kind})"]
    if scans < len(lines):
        notes.append(f"{len(lines) - scans} scans have another number of beams than {usual}")
    if other_lasers:
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(other_lasers.items()))
        notes.append(f"skipped lines of other lasers: {counts}")
    return notes


def _count_doubted(lines: list[LaserLine]) -> list[str]:
    doubted = sum(line.is_maximum_doubted for line in lines)
    if not doubted:
        return []
    return [f"the maximum range of {doubted} lines is not used: most of their readings lie beyond it"]


def _count_no_returns(beams: LogReader, max_range: float | None) -> str:
    maximum = np.repeat(beams.maximum, np.diff(beams.offsets))
    if max_range is not None:
        maximum = np.minimum(maximum, max_range)
    returned = (beams.readings > 0) & (beams.readings < maximum)
    absent = int(len(returned) - returned.sum())
    limit = "" if max_range is None else f" (not positive, or {max_range:g} m and more)"
    return f"{absent} readings are no returns{limit}, {absent / len(returned):.1%} of all"


def _check_stamps(stamps: FloatArray) -> list[str]:
    steps = np.diff(stamps)
    if len(steps) and not steps.any():
        return ["all timestamps are equal; the order of the file is kept"]
    backwards = int((steps < 0).sum())
    return [f"{backwards} timestamps go backwards; the order of the file is kept"] if backwards else []
