"""The sets of recordings that methods are measured on: what ``conf/benchmark`` says of each."""

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
        place: the kind of place, by which ``benchmark.voxels`` gives each peer its voxel.
        recording: its name, or a part of it, as in ``data.test``.
        reader: its format and the options of that, as in ``data.reader``.
        sensor: the laser, as in ``data.sensor``.
        lengths: of the drift's segments in metres.
        frames: first and last frame, both included, of a stretch that is also scored by itself.
        relations: file of relations between scans that people have verified.
        deskew: as ``data.deskew``, for models that undistort scans.
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
    """A set with its scans in memory, so that reading and simulating them is not measured.

    Attributes:
        options: what ``conf/benchmark`` says of it, checked.
        recording: all of it.
        drive: the part of it whose truth is known.
        scans: of the drive.
    """

    options: Settings
    recording: Recording
    drive: Drive
    scans: list[Scan]

    @property
    def deskew(self) -> str:
        """Whether scans are undistorted, ``on`` or ``off``."""
        return "on" if wants_deskew(self.options["deskew"], self.drive.is_compensated) else "off"

    @property
    def sensor(self) -> Sensor:
        """The laser."""
        return Sensor(**self.options["sensor"])


def load_sets(sets: dict[str, Settings]) -> dict[str, LoadedSet]:
    """The sets that are there by their names; of the others it is told why they are left out.

    Raises:
        InputError: an option of a set is missing, unknown or has no meaning; none of the sets is there.
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
        raise InputError("benchmark.root: none of the sets is there; give the folder of the recordings")
    return loaded


@cache
def _load(options_in_json: str) -> LoadedSet:
    """A set; kept, since the jobs of a sweep follow each other in one process."""
    options = json.loads(options_in_json)
    recording = open_recording(options["reader"])(parse_part(options["recording"])[0])
    log.info("reading %s %s", options["reader"]["format"], options["recording"])
    drive = cut({recording.name: Drive.unencoded(recording)}, options["recording"])
    return LoadedSet(options, recording, drive, list(drive.raw_scans()))
