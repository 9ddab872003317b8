"""Loads the sets of recordings of the benchmark, which ``conf/benchmark`` defines."""

import json
import logging
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import Settings
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.options import check_options, option
from rcnn_odom.recordings.formats import open_recording
from rcnn_odom.recordings.parts import cut, parse_part
from rcnn_odom.recordings.recording import Drive, Recording, wants_deskew
from rcnn_odom.recordings.scan import Scan

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class SetOptions:
    """One of ``benchmark.sets``.

    Attributes:
        place: kind of place, for the voxel sizes in ``benchmark.voxels``.
        recording: name of a recording or of a part of it, as in ``data.test``.
        reader: format of the recording and its options, as in ``data.reader``.
        sensor: the laser, as in ``data.sensor``.
        lengths: lengths in metres of the segments of the drift.
        frames: first and last frame (inclusive) of a stretch that is also scored separately; None: no
            stretch.
        relations: file with relations between scans that people have verified; None: no relations.
        deskew: whether scans are undistorted, as ``data.deskew``.
    """

    place: str
    recording: str
    reader: dict[str, Any]
    sensor: Sensor
    lengths: list[Any] = option(  # noqa: RUF009
        fits=lambda lengths: bool(lengths), wanted="a list of lengths in metres"
    )
    frames: list[Any] | None = None
    relations: str | None = None
    deskew: str = option(default="auto", choices=("auto", "on", "off"))


@dataclass(frozen=True, eq=False)
class LoadedSet:
    """A set with its scans in memory, so that the time for reading or simulating them is not measured.

    Attributes:
        options: checked options of the set, from ``conf/benchmark``.
        recording: the whole recording.
        drive: the measured part of the recording, with ground truth.
        scans: the scans of the drive.
    """

    options: Settings
    recording: Recording
    drive: Drive
    scans: list[Scan]

    @property
    def deskew(self) -> str:
        """Whether scans are undistorted: ``on`` or ``off``."""
        return "on" if wants_deskew(self.options["deskew"], self.drive.is_compensated) else "off"

    @property
    def sensor(self) -> Sensor:
        """The laser of the set."""
        return Sensor(**self.options["sensor"])


def load_sets(sets: dict[str, Settings]) -> dict[str, LoadedSet]:
    """Loads the sets whose recordings exist, by name; logs which ones are left out.

    Raises:
        InputError: an option of a set is missing, unknown or invalid; or no set has its recordings.
    """
    loaded = {}
    for name, options in sets.items():
        check_options(SetOptions, options, f"benchmark.sets.{name}.")
        root = options["reader"].get("root")
        if root and not Path(root).is_dir():
            log.warning("%s is left out: %s: no such folder", name, root)
            continue
        loaded[name] = _load(json.dumps(options))
    if not loaded:
        raise InputError("benchmark.root: no set has its recordings; give the folder of the recordings")
    return loaded


@cache
def _load(options_in_json: str) -> LoadedSet:
    """Loads a set; cached, since the jobs of a sweep run one after the other in one process."""
    options = json.loads(options_in_json)
    recording = open_recording(options["reader"])(parse_part(options["recording"])[0])
    log.info("reading %s %s", options["reader"]["format"], options["recording"])
    drive = cut({recording.name: Drive.unencoded(recording)}, options["recording"])
    return LoadedSet(options, recording, drive, list(drive.raw_scans()))
