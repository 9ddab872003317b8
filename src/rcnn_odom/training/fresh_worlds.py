"""New simulated drives for every epoch after the first; processes make them during training."""

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
"""Niceness of the processes that make worlds, so that they do not slow down training."""
POLLING = 0.2
"""Seconds between checks for worlds that another process makes."""


class FreshWorlds:
    """The training drives of every epoch of one stage. Those of an epoch are made during the epoch before.

    Epoch 0 has the training set itself. In epoch e a drive ``NAME~(first + e)`` of the same length replaces
    each NAME. The drives do not depend on the number of workers or on the epoch at which a training is
    resumed. They are memory-mapped files, so memory does not grow with their number. Drives that cannot be
    simulated anew, such as logs of a robot, are the same in every epoch.

    Args:
        open_recording: function from a name to the recording; picklable. It accepts any name ``NAME~NUMBER``
            of a simulated drive.
        drives: the training set.
        epochs: number of epochs of this stage.
        sensor: the sensor of the drives.
        workers: number of processes; 0: another process with the same folder makes the worlds.
        folder: folder of the worlds' files.
        keep: whether the files stay there for other trainings. Otherwise at most two epochs of them exist at
            a time.
        first: number of epochs of the stage before, so that the second stage gets other worlds.

    Attributes:
        waited: seconds for which training waited for the worlds of the present epoch.
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
        self._workers: Workers[Encoded] | None = None
        # One thread, so that the workers make one epoch after the other.
        self._maker = ThreadPoolExecutor(1)
        self._made: dict[int, Future[list[Drive]]] = {}
        self._closed = Event()

    def drives_of(self, epoch: int) -> list[Drive]:
        """The drives of an epoch. Waits until they are made, and starts to make those of the next epoch.

        Raises:
            InputError: a drive cannot be made.
        """
        wanted = [e for e in (epoch, epoch + 1) if 0 < e < self.epochs]
        if self.worker_count and not (
            self._workers or all(self._are_made(self._open_worlds(e)) for e in wanted)
        ):
            log.info("new worlds for every epoch, made by %d processes during training", self.worker_count)
            self._workers = Workers(self.worker_count, Encoding(self.open_recording, self.sensor), NICENESS)
        for old in set(self._made) - set(wanted):
            self._remove(self._made.pop(old))
        for e in wanted:
            if e not in self._made:
                self._made[e] = self._maker.submit(self._make, e)
        start = time.monotonic()
        made = iter(self._made[epoch].result() if epoch in self._made else self.renewed)
        self.waited = time.monotonic() - start
        return [drive if drive.keeps_world else next(made) for drive in self.drives]

    def _open_worlds(self, epoch: int) -> list[Recording]:
        """The recordings of an epoch, which are not simulated yet."""
        return [self.open_recording(f"{drive.name}~{self.first + epoch}") for drive in self.renewed]

    def _are_made(self, worlds: list[Recording]) -> bool:
        """Whether all of these recordings are encoded."""
        return all(cache_path(world, self.sensor, self.folder).exists() for world in worlds)

    def _make(self, epoch: int) -> list[Drive]:
        """Makes the drives of an epoch, or waits until another process has made them."""
        worlds = self._open_worlds(epoch)
        while not (self.worker_count or self._are_made(worlds)):
            if self._closed.wait(POLLING):
                return []
        return encode_recordings(worlds, self.sensor, self.folder, max(1, self.worker_count), self._workers)

    def _remove(self, made: "Future[list[Drive]]") -> None:
        """Deletes the files of an epoch's worlds. Memory maps of them that are still open stay readable."""
        if not self.keep and self.worker_count and made.done() and not made.exception():
            for drive in made.result():
                (self.folder / f"{drive.key}.npy").unlink(missing_ok=True)

    def close(self) -> None:
        """Stops the workers at once and deletes their worlds, unless they are kept."""
        self._closed.set()
        if self._workers is not None:
            self._workers.close()
        self._maker.shutdown(cancel_futures=True)
        self._made.clear()
        if not self.keep and self.worker_count:
            shutil.rmtree(self.folder, ignore_errors=True)
