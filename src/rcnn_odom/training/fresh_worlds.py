"""Every epoch after the first trains on new simulated drives, made beside training."""

import logging
import shutil
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Event

from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.cache import Encoded, Encoding, cache_path, encode_recordings
from rcnn_odom.recordings.recording import Drive, OpenRecording, Recording
from rcnn_odom.recordings.workers import Workers, useful_workers

log = logging.getLogger(__name__)

NICENESS = 10
"""Of the processes that make worlds, so that training comes first."""
POLLING = 0.2
"""Seconds between looks for the worlds that another process makes."""


class FreshWorlds:
    """The training drives of every epoch of one stage, made beside the epoch before.

    Epoch 0 of a stage's training has the training set itself, epoch e a drive ``NAME~(first + e)`` in
    place of each NAME, as long as it and whatever the number of workers or the epoch at which a stopped
    run goes on. They are maps of files, so memory does not grow with them. Drives that keep their world,
    such as logs of a robot, are the same in every epoch.

    Args:
        open_recording: picklable; a generator that takes any name but those of drives that keep their world.
        drives: the training set.
        epochs: of this stage's training.
        sensor: theirs.
        workers: processes; 0: another process with the same folder makes the worlds.
        folder: where the worlds' files go.
        keep: leave them there for other trainings, instead of those of two epochs at most.
        first: epochs of the stage before, so that a second stage has other worlds than the first one.
    """

    def __init__(
        self,
        open_recording: OpenRecording,
        drives: list[Drive],
        epochs: int,
        sensor: Sensor,
        workers: int,
        folder: Path,
        keep: bool = False,
        first: int = 0,
    ) -> None:
        self.open_recording, self.drives, self.epochs = open_recording, drives, epochs
        self.sensor, self.first = sensor, first
        self.folder, self.keep = folder, keep
        self.renewed = [drive for drive in drives if not drive.keeps_world]
        self.worker_count = useful_workers(workers, sum(map(len, self.renewed)))
        self.waited = 0.0
        """Seconds for which training stood still for the worlds of the present epoch."""
        self._workers: Workers[Encoded] | None = None
        # One thread: the workers make one epoch after the other.
        self._maker = ThreadPoolExecutor(1)
        self._made: dict[int, Future[list[Drive]]] = {}
        self._closed = Event()

    def drives_of(self, epoch: int) -> list[Drive]:
        """The drives of an epoch, waiting for them if need be; those of the next are begun.

        Raises:
            InputError: a drive cannot be made.
        """
        wanted = [e for e in (epoch, epoch + 1) if 0 < e < self.epochs]
        if self.worker_count and not (self._workers or all(self._are_made(self._worlds(e)) for e in wanted)):
            log.info("new worlds for every epoch, made by %d processes beside training", self.worker_count)
            self._workers = Workers(self.worker_count, Encoding(self.open_recording, self.sensor), NICENESS)
        for gone in set(self._made) - set(wanted):
            self._forget(self._made.pop(gone))
        for e in wanted:
            if e not in self._made:
                self._made[e] = self._maker.submit(self._make, e)
        start = time.monotonic()
        made = iter(self._made[epoch].result() if epoch in self._made else self.renewed)
        self.waited = time.monotonic() - start
        return [drive if drive.keeps_world else next(made) for drive in self.drives]

    def _worlds(self, epoch: int) -> list[Recording]:
        return [self.open_recording(f"{drive.name}~{self.first + epoch}") for drive in self.renewed]

    def _are_made(self, worlds: list[Recording]) -> bool:
        return all(cache_path(world, self.sensor, self.folder).exists() for world in worlds)

    def _make(self, epoch: int) -> list[Drive]:
        worlds = self._worlds(epoch)
        while not (self.worker_count or self._are_made(worlds)):
            if self._closed.wait(POLLING):
                return []
        return encode_recordings(worlds, self.sensor, self.folder, max(1, self.worker_count), self._workers)

    def _forget(self, made: "Future[list[Drive]]") -> None:
        """Lets go of the worlds of an epoch. What still maps their files can go on reading."""
        if not self.keep and self.worker_count and made.done() and not made.exception():
            for drive in made.result():
                (self.folder / f"{drive.key}.npy").unlink(missing_ok=True)

    def close(self) -> None:
        """Ends the workers at once and forgets their worlds."""
        self._closed.set()
        if self._workers is not None:
            self._workers.close()
        self._maker.shutdown(cancel_futures=True)
        self._made.clear()
        if not self.keep and self.worker_count:
            shutil.rmtree(self.folder, ignore_errors=True)
