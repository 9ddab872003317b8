"""Worlds without end: every epoch after the first trains on drives that nobody has seen before."""

import logging
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from rcnn_odom.cache import Encoded, EncodedSequence, Encoding, OpenDrive, cache_path, encode_sequences
from rcnn_odom.scan import Sensor
from rcnn_odom.workers import Workers, useful_workers

log = logging.getLogger(__name__)

NICENESS = 10
"""Training comes first: what it leaves of the processor makes worlds."""
POLLING = 0.2
"""Seconds between looks for the worlds that another process makes."""


class FreshWorlds:
    """The training drives of every epoch of one stage, made beside the epoch before.

    Epoch 0 of a stage's training has the training set itself, epoch e a drive ``NAME~(first + e)`` in
    place of each NAME, as long as it and whatever the number of workers or the epoch at which a stopped
    run goes on. There are never more than two epochs of them in memory.

    Args:
        read: name -> ``Sequence``, picklable; a generator that takes any name.
        drives: the training set.
        epochs: of this stage's training.
        sensor: theirs.
        workers: processes; 0: another process with the same cache makes the worlds.
        first: epochs of the stage before, so that a second stage has other worlds than the first one.
        cache: folder where the worlds are kept for other trainings; None: in memory alone.
    """

    def __init__(
        self,
        read: OpenDrive,
        drives: list[EncodedSequence],
        epochs: int,
        sensor: Sensor,
        workers: int,
        first: int = 0,
        cache: Path | None = None,
    ) -> None:
        self.read, self.drives, self.epochs, self.sensor, self.first = read, drives, epochs, sensor, first
        self.cache = cache
        self.worker_count = useful_workers(workers, sum(map(len, drives))) if workers else 0
        self.waited = 0.0
        """Seconds for which training stood still for the worlds of the present epoch."""
        self._workers: Workers[Encoded] | None = None
        # One thread: the workers make one epoch after the other.
        self._maker = ThreadPoolExecutor(1)
        self._made: dict[int, Future[list[EncodedSequence]]] = {}

    def of(self, epoch: int) -> list[EncodedSequence]:
        """The drives of an epoch, waiting for them if need be; those of the next are begun.

        Raises:
            InputError: a drive cannot be made.
        """
        wanted = [e for e in (epoch, epoch + 1) if 0 < e < self.epochs]
        if self.worker_count and self._workers is None and not all(map(self._is_kept, wanted)):
            log.info("new worlds for every epoch, made by %d processes beside training", self.worker_count)
            self._workers = Workers(self.worker_count, Encoding(self.read, self.sensor), NICENESS)
        self._made = {e: self._made.get(e) or self._maker.submit(self._make, e) for e in wanted}
        start = time.monotonic()
        drives = self._made[epoch].result() if epoch in self._made else self.drives
        self.waited = time.monotonic() - start
        return drives

    def _names(self, epoch: int) -> list[str]:
        return [f"{drive.name}~{self.first + epoch}" for drive in self.drives]

    def _is_kept(self, epoch: int) -> bool:
        return self.cache is not None and all(
            cache_path(self.read(name), self.sensor, self.cache).exists() for name in self._names(epoch)
        )

    def _make(self, epoch: int) -> list[EncodedSequence]:
        names = self._names(epoch)
        if self.cache is not None:
            while not (self.worker_count or self._is_kept(epoch)):
                time.sleep(POLLING)
            worlds = [self.read(name) for name in names]
            return encode_sequences(worlds, self.sensor, self.cache, max(1, self.worker_count), self._workers)
        assert self._workers is not None
        scans = [np.empty(drive.scans.shape, np.float32) for drive in self.drives]
        poses = [np.empty_like(drive.poses) for drive in self.drives]
        lengths = [len(drive) for drive in self.drives]
        for (number, start, stop), (new_scans, new_poses) in self._workers.run(names, lengths):
            scans[number][start:stop], poses[number][start:stop] = new_scans, new_poses
        return [
            replace(drive, name=name, key=name, scans=its_scans, poses=its_poses)
            for drive, name, its_scans, its_poses in zip(self.drives, names, scans, poses, strict=True)
        ]

    def close(self) -> None:
        """Ends the workers at once and forgets their worlds."""
        if self._workers is not None:
            self._workers.close()
        self._maker.shutdown(cancel_futures=True)
        self._made.clear()
