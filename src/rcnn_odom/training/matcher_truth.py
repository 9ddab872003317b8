"""``data.reference=matcher``: the path of scan matching as the truth, kept beside encoded scans."""

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
"""That decide what scan matching gives."""


class MatchedPath(NamedTuple):
    """What scan matching says of a recording.

    Attributes:
        steps: (N-1, 3) metres and radians.
        marks: (N,) kinds of what the step to a scan suffers from; empty where nothing.
    """

    steps: FloatArray
    marks: npt.NDArray[np.str_]


class MatcherTruth:
    """Opens recordings, those without poses with the path of scan matching as theirs.

    A step that the matcher marks (held, no match, poor match, ...) is not to be learned from: the recording's
    ``trusted`` says so.

    Args:
        open_recording: name -> recording, whose poses are nan where they are to be found.
        folder: where paths are kept.
        deskew: ``data.deskew``.
    """

    def __init__(self, open_recording: OpenRecording, folder: Path, deskew: str) -> None:
        self.open_recording, self.folder, self.deskew = open_recording, folder, deskew

    def __call__(self, name: str) -> Recording:
        """The recording of this name; of another source, which has poses, as it is.

        Raises:
            InputError: it cannot be opened, or the folder cannot be written.
        """
        recording = self.open_recording(name)
        if not np.isnan(recording.poses).all():
            return recording
        found = self._find(recording)
        trusted = found.marks == ""
        marked = int((~trusted[1:]).sum())
        kinds = Counter(kind for mark in found.marks[1:] for kind in str(mark).split(", ") if kind)
        counts = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        note = f"truth: scan matching; {marked} of {len(found.steps)} steps are marked and not trained on"
        return replace(
            recording,
            poses=compose(found.steps),
            trusted=trusted,
            notes=(*recording.notes, f"{note} ({counts})" if marked else note),
        )

    def _find(self, recording: Recording) -> MatchedPath:
        """The path from the folder, or computed into it."""
        deskew = wants_deskew(self.deskew, recording.is_compensated)
        path = self.folder / f"{file_name(recording.name)}-{_key(recording, deskew)}.npz"
        found = _read(path, len(recording))
        if found is None:
            try:
                # Another process may be faster.
                with one_at_a_time(self.folder, "matching", "matching scans"):
                    found = _read(path, len(recording)) or match(recording, deskew)
                    if not path.exists():
                        write_atomically(path, partial(np.savez_compressed, **found._asdict()))
            except OSError as error:
                raise InputError(f"{path}: cannot be written ({error.strerror}); set outputs=") from error
        return found


def match(recording: Recording, deskew: bool) -> MatchedPath:
    """The path of a recording, as ``rcnn-odom run`` finds it.

    Args:
        recording: N scans.
        deskew: scans whose beams have times are undistorted.
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
    """Hash of all that changes a recording's path."""
    sources = sorted(path for pattern in SOURCES for path in PACKAGE.glob(pattern))
    parts = [recording.fingerprint, len(recording), recording.has_clock, deskew, hash_statements(sources)]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def _is_whole(found: MatchedPath, scans: int) -> bool:
    fits = found.steps.shape == (scans - 1, 3) and found.marks.shape == (scans,)
    return fits and found.marks.dtype.kind == "U" and bool(np.isfinite(found.steps).all())


def _read(path: Path, scans: int) -> MatchedPath | None:
    """A path that is kept; None where it is not there, or damaged."""
    try:
        with np.load(path, allow_pickle=False) as kept:
            found = MatchedPath(kept["steps"], kept["marks"])
    except FileNotFoundError:
        return None
    except Exception:  # whatever a damaged file leads to
        found = None
    if found and _is_whole(found, scans):
        return found
    log.warning("%s: damaged, matching its scans again", path)
    path.unlink(missing_ok=True)
    return None
