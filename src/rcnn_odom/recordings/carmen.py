"""CARMEN logs of robots with a planar laser: FLASER or ROBOTLASER1 lines, plain, .gz or .bz2.

The lines, one blank between fields::

    FLASER n [n ranges] x y theta odom_x odom_y odom_theta ipc_timestamp host logger_timestamp
    ROBOTLASER1 laser_type start_angle field_of_view resolution maximum_range accuracy remission_mode
        n [n ranges] m [m remissions] laser_x y theta robot_x y theta tv rv forward_safety side_safety
        turn_axis ipc_timestamp host logger_timestamp
"""

import bz2
import gzip
import hashlib
import logging
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, planar_to_poses, wrap_angle
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

log = logging.getLogger(__name__)

READER_VERSION = 1
"""Raised whenever the same file would give other scans."""

SUFFIXES = tuple(kind + packing for kind in ("", ".log", ".clf") for packing in ("", ".gz", ".bz2"))
OPENERS = {".gz": gzip.open, ".bz2": bz2.open}
REFERENCE_COLUMNS = ("raw_scan_index", "ref_x", "ref_y", "ref_theta")


def load(
    name: str,
    *,
    root: str | Path,
    reference: str | Path | None = None,
    field_of_view_deg: float = 180.0,
    max_range: float | None = None,
) -> Recording:
    """One CARMEN log, its scans in the order of the file.

    The truth is the laser pose on the line, or that of the reference. Wheel odometry is the line's odom
    pose; on ROBOTLASER1 lines, whose odometry is the robot's, it is moved to the laser by the offset
    between robot and laser on the first line, since they are bolted together.

    Args:
        name: the log's file name, with or without .log or .clf and .gz or .bz2.
        root: the folder of the log.
        reference: a table (.csv) with ``raw_scan_index, ref_x, ref_y, ref_theta`` for every scan, or a
            folder that holds ``NAME_dense_ref.csv``. nan there is an unknown truth.
        field_of_view_deg: degrees that the beams of FLASER lines cover.
        max_range: metres; readings at or beyond it are counted in the notes as no returns. None: only
            what is so by itself (not positive, not finite, at the line's own maximum) is counted.

    Raises:
        InputError: no file or several, a broken line, or a reference that is not about these scans.
    """
    if not 0 < field_of_view_deg <= 360:
        raise InputError(f"data.field_of_view_deg must be above 0 and at most 360, not {field_of_view_deg}")
    path = _find_log(Path(root), name)
    other_lasers: Counter[str] = Counter()
    lines = list(_laser_lines(path, field_of_view_deg, other_lasers, strict=True))
    beams = Beams.of(lines)
    if reference is None:
        poses, about_truth = planar_to_poses([line.laser for line in lines]), _name_truth(lines)
    else:
        poses, about_truth = _read_truth(_find_reference(Path(reference), name), len(lines))
    notes = [*_count_scans(lines, other_lasers), _count_no_returns(beams, max_range)]
    notes += [*_check_stamps(beams.stamps), *about_truth]
    status = path.stat()
    key = f"carmen {READER_VERSION} {path.name} {status.st_size} {status.st_mtime_ns} {field_of_view_deg!r}"
    return Recording(
        name=name,
        poses=poses,
        stamps=beams.stamps,
        read_scan=beams,
        fingerprint=hashlib.sha256(key.encode()).hexdigest(),
        wheel_odometry=_wheel_odometry(lines),
        notes=tuple(notes),
    )


def recognises(path: Path) -> bool:
    """Any file may be a log: nothing but its lines tells."""
    return path.is_file()


def stream(path: Path, field_of_view_deg: float = 180.0) -> ScanStream:
    """The scans of a log, one after the other in the order of the file, whose stamps are not trusted.

    A broken line is told, skipped and counted; so are lines of other lasers and of another kind than the
    first.

    Args:
        path: of the log, plain, .gz or .bz2.
        field_of_view_deg: degrees that the beams of FLASER lines cover.

    Raises:
        InputError: the file cannot be read to its end, or has no scan; raised where ``scans`` is read.
    """
    skipped: Counter[str] = Counter()
    lines = _laser_lines(path, field_of_view_deg, skipped, strict=False)
    scans = (Beams.of([line])(0) for line in lines)
    return ScanStream(name=path.name, scans=scans, has_clock=False, skipped=skipped)


def _laser_lines(
    path: Path, field_of_view_deg: float, others: Counter[str], strict: bool
) -> Iterator["LaserLine"]:
    """The laser lines in order; counts those of other lasers that are passed over.

    Args:
        path: of the log.
        field_of_view_deg: degrees that the beams of FLASER lines cover.
        others: what was passed over.
        strict: broken lines and a second kind of lines are refused, not passed over.
    """
    first_kind = None
    for number, text in _lines_of(path):
        kind = text.split(None, 1)[0] if text.strip() else ""
        if kind not in PARSERS or (not strict and first_kind not in (None, kind)):
            if "LASER" in kind and not kind.startswith("#"):
                others[f"{kind} lines"] += 1
            continue
        broken = f"{path}:{number}: broken {kind} line"
        try:
            line = PARSERS[kind](text.split(), np.deg2rad(field_of_view_deg))
        except ValueError as error:
            if strict:
                raise InputError(f"{broken} ({error}); correct or remove it") from error
            others["broken lines"] += 1
            log.warning("%s (%s), skipped", broken, error)
            continue
        if first_kind not in (None, kind):
            raise InputError(
                f"{path}:{number}: {kind} after {first_kind} lines, perhaps the same scans twice; "
                "keep one kind of them"
            )
        first_kind = kind
        yield line
    if first_kind is None:
        found = f", only {', '.join(sorted(others))}" if others else ""
        raise InputError(
            f"{path}: no FLASER or ROBOTLASER1 line in it{found}; convert the log to one of them"
        )


class LaserLine(NamedTuple):
    """What one laser line says; angles in radians, lengths in metres."""

    kind: str
    readings: FloatArray
    first_angle: float
    spacing: float
    maximum: float
    stamp: float
    laser: list[float]
    robot: list[float]


@dataclass(frozen=True, eq=False)
class Beams:
    """Frame index -> all beams of its scan, from memory.

    Beams run counter-clockwise from the right. FLASER lines do not say at which angles, so an even
    number n leaves the field of view open at its left end (SICK's 180 of 181 beams, spacing
    field of view / n) and an odd one closes it (field of view / (n - 1)). ROBOTLASER1 lines say it, and
    their readings at or beyond the line's own maximum range come as infinite: no return.

    All readings lie in one array, (sum of P,), because the number of beams may change within a log;
    those of a frame begin at its offset (N+1,).
    """

    readings: FloatArray
    offsets: npt.NDArray[np.int64]
    first_angle: FloatArray
    spacing: FloatArray
    maximum: FloatArray
    stamps: FloatArray

    @classmethod
    def of(cls, lines: list[LaserLine]) -> "Beams":
        """The beams of all lines."""
        return cls(
            np.concatenate([line.readings for line in lines]),
            np.cumsum([0, *(len(line.readings) for line in lines)]),
            *(np.array(column) for column in zip(*(line[2:6] for line in lines), strict=True)),
        )

    def __call__(self, frame: int) -> Scan:
        """One frame; infinite range: the line itself calls it no return."""
        ranges = self.readings[self.offsets[frame] : self.offsets[frame + 1]]
        bearings = self.first_angle[frame] + self.spacing[frame] * np.arange(len(ranges))
        ranges = np.where(ranges >= self.maximum[frame], np.inf, ranges)
        return Scan(ranges, bearings, stamp=float(self.stamps[frame]))


def _find_log(root: Path, name: str) -> Path:
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; set data.root to the folder of the log")
    if (root / name).is_file():
        return root / name
    found = [root / (name + suffix) for suffix in SUFFIXES if (root / (name + suffix)).is_file()]
    if not found:
        raise InputError(
            f"{root / name}: no such file, nor with .log or .clf and .gz or .bz2; correct the name"
        )
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"{root / name}: several files match ({names}); give the full name of one")
    return found[0]


def _lines_of(path: Path) -> Iterator[tuple[int, str]]:
    unpack: Any = OPENERS.get(path.suffix, open)
    try:
        # A byte that is no text becomes a character that is no number, and then an error with its line.
        with unpack(path, "rt", encoding="utf-8", errors="replace") as stream:
            yield from enumerate(stream, start=1)
    except (EOFError, OSError, zlib.error) as error:
        raise InputError(f"{path}: cannot be read to its end ({error}); download it again") from error


def _parse_flaser(fields: list[str], field_of_view: float) -> LaserLine:
    count = _count(fields, 1)
    _need_fields(fields, 2 + count + 9, count)
    pose = _finite(fields[2 + count : 9 + count])
    return LaserLine(
        kind=fields[0],
        readings=np.array([float(word) for word in fields[2 : 2 + count]]),
        first_angle=-field_of_view / 2,
        spacing=_spacing(field_of_view, count),
        maximum=np.inf,
        laser=pose[:3],
        robot=pose[3:6],
        stamp=pose[6],
    )


def _parse_robotlaser(fields: list[str], _: float) -> LaserLine:
    count = _count(fields, 8)
    _need_fields(fields, 10 + count, count, exact=False)
    remissions = int(fields[9 + count])
    _need_fields(fields, 24 + count + remissions, count)
    first_angle, field_of_view, spacing, maximum = _finite(fields[2:6])
    poses = _finite(fields[10 + count + remissions : 16 + count + remissions])
    return LaserLine(
        kind=fields[0],
        readings=np.array([float(word) for word in fields[9 : 9 + count]]),
        first_angle=first_angle,
        spacing=spacing if spacing > 0 else _spacing(field_of_view, count),
        maximum=maximum if maximum > 0 else np.inf,
        laser=poses[:3],
        robot=poses[3:],
        stamp=_finite(fields[-3:-2])[0],
    )


PARSERS = {"FLASER": _parse_flaser, "ROBOTLASER1": _parse_robotlaser}


def _spacing(field_of_view: float, count: int) -> float:
    return field_of_view / (count if count % 2 == 0 or count == 1 else count - 1)


def _count(fields: list[str], at: int) -> int:
    if len(fields) <= at:
        raise ValueError("it ends before the number of readings")
    count = int(fields[at])
    if count < 1:
        raise ValueError(f"it announces {count} readings")
    return count


def _need_fields(fields: list[str], expected: int, count: int, exact: bool = True) -> None:
    if len(fields) < expected or (exact and len(fields) != expected):
        raise ValueError(f"it announces {count} readings, so {expected} fields, but has {len(fields)}")


def _finite(words: list[str]) -> list[float]:
    values = [float(word) for word in words]
    if not np.isfinite(values).all():
        raise ValueError(f"not a finite number among {' '.join(words)}")
    return values


def _wheel_odometry(lines: list[LaserLine]) -> FloatArray:
    wheels = planar_to_poses([line.robot for line in lines])
    if lines[0].kind == "ROBOTLASER1":
        wheels = wheels @ (np.linalg.inv(wheels[0]) @ planar_to_poses([lines[0].laser])[0])
    return wheels


def _count_scans(lines: list[LaserLine], other_lasers: Counter[str]) -> list[str]:
    beams = Counter(len(line.readings) for line in lines)
    usual, scans = beams.most_common(1)[0]
    notes = [f"{len(lines)} scans of {usual} beams ({lines[0].kind})"]
    if scans < len(lines):
        notes.append(f"{len(lines) - scans} scans have another number of beams than {usual}")
    if other_lasers:
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(other_lasers.items()))
        notes.append(f"lines of other lasers passed over: {counts}")
    return notes


def _count_no_returns(beams: Beams, max_range: float | None) -> str:
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


def _name_truth(lines: list[LaserLine]) -> list[str]:
    difference = np.array([line.laser for line in lines]) - np.array([line.robot for line in lines])
    difference[:, 2] = wrap_angle(difference[:, 2])
    truth = "truth: the log's laser pose"
    if np.abs(difference).max() >= 1e-6:
        return [truth]
    warning = (
        "the log's laser pose equals its odometry everywhere: unless the log was corrected, the truth is "
        "just the wheel odometry"
    )
    return [truth, warning]


def _find_reference(reference: Path, name: str) -> Path:
    if reference.is_dir():
        stem = name
        for suffix in (".gz", ".bz2", ".log", ".clf"):
            stem = stem.removesuffix(suffix)
        reference = reference / f"{stem}_dense_ref.csv"
    if not reference.is_file():
        raise InputError(
            f"{reference}: no such file; set data.reference to a table or its folder, or leave it out"
        )
    return reference


def _read_truth(path: Path, scans: int) -> tuple[FloatArray, list[str]]:
    """Poses (scans, 4, 4) of a reference, nan where it has none, and notes on them."""
    planar = _read_reference(path, scans)
    poses, unknown = planar_to_poses(planar), np.isnan(planar[:, 0])
    poses[unknown] = np.nan
    return poses, [f"truth: {path.name}", f"{int(unknown.sum())} scans without truth"]


def _read_reference(path: Path, scans: int) -> FloatArray:
    """x, y and heading of every scan, (scans, 3); a row with any nan is nan as a whole."""
    lines = path.read_text(encoding="utf-8", errors="replace").rstrip().splitlines()
    # Remarks follow some names in parentheses: "raw_scan_index(in ...)".
    header = [word.split("(")[0].strip() for word in lines[0].lstrip("# ").split(",")] if lines else []
    missing = [column for column in REFERENCE_COLUMNS if column not in header]
    if missing:
        raise InputError(f"{path}:1: the header has no column {', '.join(missing)}; name the columns there")
    columns = [header.index(column) for column in REFERENCE_COLUMNS]
    truth = np.full((len(lines) - 1, 3), np.nan)
    for row, text in enumerate(lines[1:]):
        words = text.split(",")
        try:
            index, *pose = (float(words[column]) for column in columns)
        except (IndexError, ValueError) as error:
            raise InputError(f"{path}:{row + 2}: not a row of numbers ({error}); correct it") from error
        if index != row or np.isinf(pose).any():
            raise InputError(
                f"{path}:{row + 2}: expected raw_scan_index {row} and a pose that is finite or nan, got "
                f"'{text.strip()[:60]}'; correct it"
            )
        truth[row] = np.nan if np.isnan(pose).any() else pose
    if len(truth) != scans:
        raise InputError(
            f"{path}: {len(truth)} rows, but the log has {scans} scans; use the log's own reference"
        )
    return truth
