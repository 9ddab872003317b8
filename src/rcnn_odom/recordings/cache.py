"""Encoded scans: computed once in parallel, kept in one file a sequence, memory-mapped when read."""

import hashlib
import json
import logging
import os
import re
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from rcnn_odom.errors import InputError
from rcnn_odom.files import one_at_a_time
from rcnn_odom.geometry import FloatArray, change_frame, relative_motions
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.recordings.recording import Sequence
from rcnn_odom.recordings.workers import Workers, useful_workers

log = logging.getLogger(__name__)

ENCODING_VERSION = 1
"""Raised whenever ``rcnn_odom.models.encoding.encode`` gives other numbers for the same input."""
CHECKSUM = hashlib.sha256
"""Of all that goes before it in a file of the cache, which it ends."""
DAY = 86400.0

OpenDrive = Callable[[str], Sequence]
Encoded = tuple[npt.NDArray[np.float32], FloatArray]
"""Depth vectors (n, bins) and poses (n, 4, 4) of some frames of a drive."""


class Encoding:
    """A task for workers: reads frames of a drive and encodes them.

    Args:
        open_drive: name -> ``Sequence``, picklable.
        sensor: what the depth vectors are like.
    """

    def __init__(self, open_drive: OpenDrive, sensor: Sensor) -> None:
        self.open_drive, self.sensor = open_drive, sensor
        self._opened: dict[str, Sequence] = {}

    def __call__(self, name: str, start: int, stop: int) -> Encoded:
        """Frames start..stop-1 of one drive."""
        if name not in self._opened:
            # One is enough: a worker's pieces of a drive follow each other.
            self._opened = {name: self.open_drive(name)}
        sequence = self._opened[name]
        scans = np.stack([encode(*sequence.read_scan(frame), self.sensor) for frame in range(start, stop)])
        return scans, sequence.poses[start:stop]


@dataclass(frozen=True)
class EncodedSequence:
    """A drive as the networks see it: ``Sequence`` with depth vectors (N, bins) in place of points.

    ``key`` changes whenever the depth vectors do.
    """

    name: str
    key: str
    scans: npt.NDArray[np.float32]
    poses: FloatArray
    stamps: FloatArray
    camera_from_laser: FloatArray
    wheel_odometry: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.scans)

    @cached_property
    def motions(self) -> FloatArray:
        """True motions (N-1, 2) in metres and radians."""
        return relative_motions(self.poses)

    @property
    def camera_poses(self) -> FloatArray:
        """True poses (N, 4, 4) in the frame of the trajectory files."""
        return change_frame(self.poses, self.camera_from_laser)

    def part(self, start: int, stop: int, name: str | None = None) -> "EncodedSequence":
        """Frames start..stop-1, without a copy."""
        wheel = self.wheel_odometry
        return replace(
            self,
            name=name or self.name,
            scans=self.scans[start:stop],
            poses=self.poses[start:stop],
            stamps=self.stamps[start:stop],
            wheel_odometry=None if wheel is None else wheel[start:stop],
        )


def cache_path(sequence: Sequence, sensor: Sensor, folder: Path) -> Path:
    """Where the encoded scans belong: the name holds a hash of everything that changes them."""
    parts = [ENCODING_VERSION, sensor.as_dict(), sequence.fingerprint, len(sequence)]
    key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
    plain_name = re.sub(r"[^\w.~-]+", "_", sequence.name)
    return folder / f"{plain_name}-{key}.npy"


def encode_sequences(
    sequences: list[Sequence],
    sensor: Sensor,
    folder: Path,
    workers: int,
    pool: Workers[Encoded] | None = None,
) -> list[EncodedSequence]:
    """The sequences with their depth vectors, from the cache or computed into it in parallel.

    Args:
        sequences: of names that differ.
        sensor: what the depth vectors are like.
        folder: of the cache.
        workers: processes to start where something is missing.
        pool: processes that run already, whose :class:`Encoding` opens drives by these names; it is used
            without a progress bar in their place.

    Raises:
        InputError: a frame cannot be read, or the folder cannot be made or is full.
    """
    scans = [open_cached(sequence, sensor, folder) for sequence in sequences]
    if any(found is None for found in scans):
        _make_folder(folder)
        with one_at_a_time(folder, "encoding", "encoding scans"):
            # Another process may have been faster.
            missing = [s for s, found in zip(sequences, scans, strict=True) if found is None]
            missing = [sequence for sequence in missing if open_cached(sequence, sensor, folder) is None]
            _encode(missing, sensor, folder, workers, pool)
        scans = [open_cached(sequence, sensor, folder) for sequence in sequences]
    encoded = []
    for sequence, found in zip(sequences, scans, strict=True):
        assert found is not None, sequence.name
        encoded.append(
            EncodedSequence(
                name=sequence.name,
                key=cache_path(sequence, sensor, folder).stem,
                scans=found,
                poses=sequence.poses,
                stamps=sequence.stamps,
                camera_from_laser=sequence.camera_from_laser,
                wheel_odometry=sequence.wheel_odometry,
            )
        )
    return encoded


def open_cached(sequence: Sequence, sensor: Sensor, folder: Path) -> npt.NDArray[np.float32] | None:
    """A map of a sequence's depth vectors (N, bins) in the cache; None where they are not there.

    The file is read once to compare its checksum: what a failing disk or a stranger has changed is told and
    not used. Nothing in it is ever run.
    """
    path = cache_path(sequence, sensor, folder)
    try:
        with path.open("rb") as file:
            body = path.stat().st_size - CHECKSUM().digest_size
            checksum = _checksum(file, body)
            whole = file.read() == checksum.digest()
        scans = np.load(path, mmap_mode="r", allow_pickle=False) if whole else None
    except FileNotFoundError:
        return None
    except (ValueError, EOFError, OSError):
        scans = None
    if scans is not None and (scans.shape, scans.dtype) == ((len(sequence), sensor.bins), np.float32):
        return scans
    log.warning("%s: damaged or of an older version, encoding it again", path)
    return None


def _checksum(file: IO[bytes], size: int) -> "hashlib._Hash":
    """Of as many bytes from the start of a file."""
    file.seek(0)
    checksum = CHECKSUM()
    while size > 0 and (block := file.read(min(size, 1 << 20))):
        checksum.update(block)
        size -= len(block)
    return checksum


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot hold encoded scans ({error.strerror}); set outputs=") from error
    for left_over in folder.glob(".*.partial"):
        if time.time() - left_over.stat().st_mtime > DAY:
            left_over.unlink(missing_ok=True)


def _encode(
    missing: list[Sequence], sensor: Sensor, folder: Path, workers: int, pool: Workers[Encoded] | None
) -> None:
    if not missing:
        return
    lengths, total = [len(sequence) for sequence in missing], sum(map(len, missing))
    with ExitStack() as stack:
        quiet = pool is not None
        if pool is None:
            log.info("encoding %d scans of %d sequences into %s", total, len(missing), folder)
            drives = {sequence.name: sequence for sequence in missing}
            encoding = Encoding(drives.__getitem__, sensor)
            pool = stack.enter_context(Workers(useful_workers(workers, total), encoding))
        bar = tqdm(total=total, desc="encoding scans", unit="scan", disable=quiet or None)
        stack.enter_context(bar)
        files = [
            stack.enter_context(_PartialFile(cache_path(sequence, sensor, folder), (length, sensor.bins)))
            for sequence, length in zip(missing, lengths, strict=True)
        ]
        for (number, start, _), (scans, _) in pool.run([sequence.name for sequence in missing], lengths):
            files[number].write(start, scans)
            bar.update(len(scans))


class _PartialFile:
    """An array (N, bins) and its checksum on their way to disk, under the final name only when all is there.

    A killed run therefore leaves nothing that a later one would believe. It is not a memory map,
    because on a full disk that kills the process.
    """

    def __init__(self, path: Path, shape: tuple[int, int]) -> None:
        self.path, self.shape = path, shape
        self.missing = shape[0]
        self.partial = path.with_name(f".{path.stem}.{os.getpid()}.partial")

    def __enter__(self) -> "_PartialFile":
        description = {"descr": "<f4", "fortran_order": False, "shape": self.shape}
        try:
            with self.partial.open("wb") as file:
                np.lib.format.write_array_header_1_0(file, description)
                self.header = file.tell()
        except OSError as error:
            raise self._refusal(error) from error
        return self

    def write(self, start: int, scans: npt.NDArray[np.float32]) -> None:
        """Rows from ``start`` on.

        Raises:
            InputError: the disk is full.
        """
        self.missing -= len(scans)
        try:
            with self.partial.open("r+b") as file:
                file.seek(self.header + start * scans[0].nbytes)
                file.write(scans.astype("<f4", copy=False).data)
                if not self.missing:
                    file.write(_checksum(file, file.seek(0, os.SEEK_END)).digest())
                    file.flush()
                    os.fsync(file.fileno())
            if not self.missing:
                self.partial.replace(self.path)
        except OSError as error:
            raise self._refusal(error) from error

    def _refusal(self, error: OSError) -> InputError:
        megabytes = 4e-6 * self.shape[0] * self.shape[1]
        return InputError(
            f"{self.path}: {megabytes:.0f} MB of encoded scans cannot be written ({error.strerror}); "
            "make room there, or set outputs= to another place"
        )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.partial.unlink(missing_ok=True)
