"""Cache of encoded scans: computed once in parallel, one file for each recording, memory-mapped when read."""

import hashlib
import json
import logging
import os
import re
import time
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from rcnn_odom.errors import InputError
from rcnn_odom.files import one_at_a_time
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings import beams
from rcnn_odom.recordings.recording import Drive, OpenRecording, Recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.workers import Workers, useful_workers

log = logging.getLogger(__name__)

ENCODING_VERSION = 2
"""Increase it when the same scans would be encoded to other numbers, or refused."""
CHECKSUM = hashlib.sha256
"""The last bytes of a cache file are this checksum of all bytes before it."""
DAY = 86400.0
FITTING_SENSOR = "set {}"
"""Advice if beams do not fit the sensor; ``{}`` is replaced by the options of a sensor that fits them."""

Encoded = tuple[npt.NDArray[np.float32], FloatArray]
"""Depth vectors (n, bins) and poses (n, 4, 4) of n frames of a drive."""


class Encoder(beams.Sensor, Protocol):
    """Turns scans into depth vectors, as :class:`rcnn_odom.models.encoding.Sensor` does."""

    @property
    def bins(self) -> int:
        """Length of a depth vector."""

    def as_dict(self) -> dict[str, Any]:
        """All options that the depth vectors depend on; they are part of the cache's key."""

    def encode(self, scan: Scan) -> npt.NDArray[np.float32]:
        """The depth vector of a scan, (bins,) metres."""


class Encoding:
    """A task for workers: reads frames of a drive and encodes them.

    Args:
        open_recording: opens a recording by its name; must be picklable.
        encoder: makes the depth vectors.
    """

    def __init__(self, open_recording: OpenRecording, encoder: Encoder) -> None:
        self.open_recording, self.encoder = open_recording, encoder
        self._opened: dict[str, Recording] = {}

    def __call__(self, name: str, start: int, stop: int) -> Encoded:
        """Encode frames start..stop-1 of a drive; a scan whose beams do not fit the sensor gets no returns.

        Raises:
            InputError: a frame cannot be read; or the beams of several frames in a row, or of most frames, do
                not fit the sensor.
        """
        if name not in self._opened:
            # Keeping one recording is enough: a worker gets all its pieces of a drive one after another.
            self._opened = {name: self.open_recording(name)}
        recording = self._opened[name]
        check = beams.BeamCheck(self.encoder, recording.has_partial_laser)
        depths = np.zeros((stop - start, self.encoder.bins), np.float32)
        for depth, frame in zip(depths, range(start, stop), strict=True):
            scan = recording.read_scan(frame)
            if not check(scan):
                depth[:] = self.encoder.encode(scan)
            elif check.is_another_laser:
                raise check.refusal(f"{name}: frame {frame}", FITTING_SENSOR)
        # The last piece of a long recording may have too few frames for a verdict.
        if check.misfitting > check.fitting and (start == 0 or stop - start > beams.PATIENCE):
            raise check.refusal(f"{name}: {check.misfitting} of frames {start} to {stop - 1}", FITTING_SENSOR)
        return depths, recording.poses[start:stop]


def cache_path(recording: Recording, encoder: Encoder, folder: Path) -> Path:
    """Path of a recording's encoded scans; its name holds a hash of everything that they depend on."""
    parts = [ENCODING_VERSION, encoder.as_dict(), recording.fingerprint, len(recording)]
    key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
    safe_name = re.sub(r"[^\w.~-]+", "_", recording.name)
    return folder / f"{safe_name}-{key}.npy"


def encode_recordings(
    recordings: list[Recording],
    encoder: Encoder,
    folder: Path,
    workers: int,
    pool: Workers[Encoded] | None = None,
) -> list[Drive]:
    """Get the depth vectors of recordings from the cache; compute those that are missing, in parallel.

    Args:
        recordings: recordings with different names.
        encoder: makes the depth vectors.
        folder: folder of the cache.
        workers: number of processes to start if scans must be encoded.
        pool: running processes to use instead, without a progress bar; their :class:`Encoding` must open
            drives by the names of the recordings.

    Returns:
        One drive for each recording, in the same order.

    Raises:
        InputError: a frame cannot be read, the folder cannot be made, or the disk is full.
    """
    scans = [open_cached(recording, encoder, folder) for recording in recordings]
    if any(found is None for found in scans):
        _make_folder(folder)
        with one_at_a_time(folder, "encoding", "encoding scans"):
            # Another process may have encoded them while this one waited for the lock.
            missing = [one for one, found in zip(recordings, scans, strict=True) if found is None]
            missing = [recording for recording in missing if open_cached(recording, encoder, folder) is None]
            _encode(missing, encoder, folder, workers, pool)
        scans = [open_cached(recording, encoder, folder) for recording in recordings]
    drives = [
        Drive.from_recording(recording, found, cache_path(recording, encoder, folder).stem)
        for recording, found in zip(recordings, scans, strict=True)
        if found is not None
    ]
    assert len(drives) == len(recordings)
    return drives


def open_cached(recording: Recording, encoder: Encoder, folder: Path) -> npt.NDArray[np.float32] | None:
    """Memory-map a recording's depth vectors (N, bins) from the cache; None if the cache does not have them.

    The file is read once to verify its checksum. A damaged or altered file causes a warning and is not used.
    No code from the file is ever executed (``allow_pickle=False``).
    """
    path = cache_path(recording, encoder, folder)
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
    if scans is not None and (scans.shape, scans.dtype) == ((len(recording), encoder.bins), np.float32):
        return scans
    log.warning("%s: damaged or of an older version, encoding it again", path)
    return None


def _checksum(file: IO[bytes], size: int) -> "hashlib._Hash":
    """Checksum of the first ``size`` bytes of a file."""
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
    missing: list[Recording], encoder: Encoder, folder: Path, workers: int, pool: Workers[Encoded] | None
) -> None:
    if not missing:
        return
    lengths, total = [len(recording) for recording in missing], sum(map(len, missing))
    with ExitStack() as stack:
        quiet = pool is not None
        if pool is None:
            log.info("encoding %d scans of %d recordings into %s", total, len(missing), folder)
            by_name = {recording.name: recording for recording in missing}
            encoding = Encoding(by_name.__getitem__, encoder)
            pool = stack.enter_context(Workers(useful_workers(workers, total), encoding))
        bar = tqdm(total=total, desc="encoding scans", unit="scan", disable=quiet or None)
        stack.enter_context(bar)
        files = [
            stack.enter_context(_PartialFile(cache_path(recording, encoder, folder), (length, encoder.bins)))
            for recording, length in zip(missing, lengths, strict=True)
        ]
        for (number, start, _), (scans, _) in pool.run([recording.name for recording in missing], lengths):
            files[number].write(start, scans)
            bar.update(len(scans))


class _PartialFile:
    """Writes an array (N, bins) and its checksum to a temporary file, which is renamed once it is complete.

    So a killed run leaves no incomplete file that a later run would use. The file is not memory-mapped,
    because writing to a memory map on a full disk kills the process.
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
        """Write rows from ``start`` on.

        Args:
            start: index of the first row.
            scans: (n, bins) rows.

        Raises:
            InputError: the rows cannot be written, for instance because the disk is full.
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
                    self.partial.replace(self.path)
        except OSError as error:
            raise self._refusal(error) from error

    def _refusal(self, error: OSError) -> InputError:
        megabytes = 4e-6 * self.shape[0] * self.shape[1]
        return InputError(
            f"{self.path}: {megabytes:.0f} MB of encoded scans cannot be written ({error.strerror}); "
            "make room there, or set outputs= to another place"
        )

    def __exit__(self, *_: object) -> None:
        self.partial.unlink(missing_ok=True)
