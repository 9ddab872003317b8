"""Encoded scans: computed once in parallel, kept in one file a sequence, memory-mapped when read."""

import hashlib
import json
import logging
import os
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from multiprocessing import get_context, parent_process
from pathlib import Path

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from rcnn_odom.datasets.sequence import Sequence
from rcnn_odom.errors import InputError
from rcnn_odom.motion import FloatArray, change_frame, relative_motions
from rcnn_odom.scan import Sensor, encode

log = logging.getLogger(__name__)

ENCODING_VERSION = 1
"""Raised whenever ``rcnn_odom.scan.encode`` gives other numbers for the same input."""
CHUNK = 64
DAY = 86400.0


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
    return folder / f"{sequence.name}-{key}.npy"


def encode_sequences(
    sequences: list[Sequence], sensor: Sensor, folder: Path, workers: int
) -> list[EncodedSequence]:
    """The sequences with their depth vectors, from the cache or computed into it in parallel.

    Raises:
        InputError: a frame cannot be read, or the folder cannot be made.
    """
    paths = [cache_path(sequence, sensor, folder) for sequence in sequences]
    missing = {
        path: sequence
        for path, sequence in zip(paths, sequences, strict=True)
        if not _is_whole(path, (len(sequence), sensor.bins))
    }
    if missing:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{folder}: cannot hold encoded scans ({error.strerror}); set outputs="
            ) from error
        for left_over in folder.glob(".*.partial"):
            if time.time() - left_over.stat().st_mtime > DAY:
                left_over.unlink(missing_ok=True)
        total = sum(len(sequence) for sequence in missing.values())
        log.info("encoding %d scans of %d sequences into %s", total, len(missing), folder)
        # Fresh processes: a fork of one that has started torch's threads can hang.
        pool = ProcessPoolExecutor(
            workers,
            get_context("spawn"),
            initializer=_start_worker,
            initargs=(list(missing.values()), sensor),
        )
        with pool, tqdm(total=total, desc="encoding scans", unit="scan", disable=None) as bar:
            for number, (path, sequence) in enumerate(missing.items()):
                _write_cache(path, number, (len(sequence), sensor.bins), pool, bar)
    return [
        EncodedSequence(
            name=sequence.name,
            key=path.stem,
            scans=np.load(path, mmap_mode="r"),
            poses=sequence.poses,
            stamps=sequence.stamps,
            camera_from_laser=sequence.camera_from_laser,
            wheel_odometry=sequence.wheel_odometry,
        )
        for path, sequence in zip(paths, sequences, strict=True)
    ]


def _is_whole(path: Path, shape: tuple[int, int]) -> bool:
    try:
        return np.load(path, mmap_mode="r").shape == shape
    except FileNotFoundError:
        return False
    except (ValueError, EOFError):
        log.warning("%s: damaged, encoding it again", path)
        return False


_work: tuple[list[Sequence], Sensor]
"""In a worker process: what there is to encode. Sent once, since a log can be large."""


def _start_worker(sequences: list[Sequence], sensor: Sensor) -> None:
    global _work
    _work = sequences, sensor
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A killed parent cannot tell its workers to end, and they would wait for it forever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _encode_frames(number: int, start: int, stop: int) -> npt.NDArray[np.float32]:
    sequences, sensor = _work
    read_scan = sequences[number].read_scan
    return np.stack([encode(*read_scan(frame), sensor) for frame in range(start, stop)])


def _write_cache(
    path: Path, number: int, shape: tuple[int, int], pool: ProcessPoolExecutor, bar: tqdm
) -> None:
    """The file gets its final name only when it is complete and on disk.

    A killed run therefore leaves nothing that a later one would believe.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial")
    starts = range(0, shape[0], CHUNK)
    stops = [min(start + CHUNK, shape[0]) for start in starts]
    try:
        scans = np.lib.format.open_memmap(partial, mode="w+", dtype=np.float32, shape=shape)
        blocks = pool.map(_encode_frames, [number] * len(starts), starts, stops)
        for start, stop, block in zip(starts, stops, blocks, strict=True):
            scans[start:stop] = block
            bar.update(stop - start)
        scans.flush()
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
