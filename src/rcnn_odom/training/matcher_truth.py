"""``data.reference=matcher``: scan matching gives the ground truth, which is cached beside encoded scans."""

import hashlib
import json
import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from rcnn_odom.errors import InputError
from rcnn_odom.files import one_at_a_time, write_atomically
from rcnn_odom.geometry import FloatArray, compose
from rcnn_odom.models.matcher import MatcherTracker
from rcnn_odom.models.tracking import Kind, Tracking
from rcnn_odom.recordings.recording import Drive, OpenRecording, Recording, wants_deskew
from rcnn_odom.recordings.trajectory import file_name
from rcnn_odom.training.run_state import PACKAGE, hash_statements

log = logging.getLogger(__name__)

SOURCES = (
    *("geometry.py", "matching/*.py", "models/matcher.py", "models/prior.py", "models/tracking.py"),
    "recordings/clock.py",
)
"""Sources that determine the result of scan matching; a change invalidates cached paths."""


class MatchedPath(NamedTuple):
    """The path of a recording by scan matching.

    Attributes:
        steps: (N-1, 3) steps between consecutive scans, metres and radians.
        marks: (N,) kinds of problems of the step to each scan, such as ``held``; empty if there is none.
    """

    steps: FloatArray
    marks: npt.NDArray[np.str_]


class MatcherTruth:
    """Opens recordings; those without poses get the poses of scan matching.

    Steps that the matcher marks (held, no match, poor match, ...) and the step after each are not used for
    training: they are False in ``trusted`` of the recording. The step after a marked one takes the error of
    the pose between them back, since the matcher compares scans with its map.

    Args:
        open_recording: function from a name to the recording; poses that scan matching should find are nan.
        folder: folder of the cached paths.
        deskew: the option ``data.deskew``.
    """

    def __init__(self, open_recording: OpenRecording, folder: Path, deskew: str) -> None:
        self.open_recording, self.folder, self.deskew = open_recording, folder, deskew

    def __call__(self, name: str) -> Recording:
        """Opens a recording. One that has poses is returned unchanged.

        Raises:
            InputError: the recording cannot be opened, or the folder cannot be written.
        """
        recording = self.open_recording(name)
        if not np.isnan(recording.poses).all():
            return recording
        found = self._find(recording)
        is_marked = found.marks != ""
        trusted = ~is_marked
        trusted[1:] &= ~is_marked[:-1]
        marked, left_out = (int(which[1:].sum()) for which in (is_marked, ~trusted))
        kinds = Counter(kind for mark in found.marks[1:] for kind in str(mark).split(", ") if kind)
        counts = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        note = (
            f"truth: scan matching; {marked} of {len(found.steps)} steps are marked; these and the steps "
            f"after them, {left_out} in all, are not trained on"
        )
        return replace(
            recording,
            poses=compose(found.steps),
            trusted=trusted,
            notes=(*recording.notes, f"{note} ({counts})" if marked else note),
        )

    def _find(self, recording: Recording) -> MatchedPath:
        """Reads the path from the cache, or computes and caches it."""
        deskew = wants_deskew(self.deskew, recording.is_compensated)
        path = self.folder / f"{file_name(recording.name)}-{_key(recording, deskew)}.npz"
        found = _read(path, len(recording))
        if found is None:
            try:
                # Another process may compute the same path meanwhile.
                with one_at_a_time(self.folder, "matching", "matching scans"):
                    found = _read(path, len(recording)) or match(recording, deskew)
                    if not path.exists():
                        write_atomically(path, partial(np.savez_compressed, **found._asdict()))
            except OSError as error:
                raise InputError(f"{path}: cannot be written ({error.strerror}); set outputs=") from error
        return found


def match(recording: Recording, deskew: bool) -> MatchedPath:
    """Matches the scans of a recording, as ``rcnn-odom run`` does.

    Args:
        recording: a recording of N scans.
        deskew: whether scans whose beams have times are undistorted.
    """
    tracking = Tracking(MatcherTracker(deskew=deskew))
    steps, marks = [], []
    scans: Iterator = Drive.unencoded(recording).raw_scans()
    for scan in tqdm(scans, total=len(recording), desc="matching scans", unit="scan", disable=None):
        tracked = tracking.step(scan)
        steps.append(tracked.step.array())
        kinds = list(dict.fromkeys(note.partition(":")[0] for note in tracked.notes))
        if not kinds and tracked.kind not in (Kind.ESTIMATED, Kind.FIRST):
            kinds = [tracked.kind.value]
        marks.append(", ".join(kinds))
    return MatchedPath(np.array(steps[1:]).reshape(-1, 3), np.array(marks, dtype=np.str_))


def _key(recording: Recording, deskew: bool) -> str:
    """Hash of everything that determines a recording's path."""
    sources = sorted(path for pattern in SOURCES for path in PACKAGE.glob(pattern))
    parts = [recording.fingerprint, len(recording), recording.has_clock, deskew, hash_statements(sources)]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def _is_valid(found: MatchedPath, scans: int) -> bool:
    """Whether a cached path has the right shapes and types, and finite steps."""
    fits = found.steps.shape == (scans - 1, 3) and found.marks.shape == (scans,)
    return fits and found.marks.dtype.kind == "U" and bool(np.isfinite(found.steps).all())


def _read(path: Path, scans: int) -> MatchedPath | None:
    """Reads a cached path; None if there is none or it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as cached:
            found = MatchedPath(cached["steps"], cached["marks"])
    except FileNotFoundError:
        return None
    except Exception:  # A damaged file can raise any error.
        found = None
    if found and _is_valid(found, scans):
        return found
    log.warning("%s: the file is damaged, matching the scans again", path)
    path.unlink(missing_ok=True)
    return None
