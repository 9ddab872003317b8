"""Training windows of consecutive pairs of scans, and the order in which they are drawn."""

import math
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import BatchSampler, DataLoader, Dataset, Sampler

from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.trained import Batch
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.training.augmentation import Augmentation
from rcnn_odom.training.fresh_worlds import FreshWorlds

Draw = tuple[int, int, bool]
"""The sampler's choice for a window: first frame, seed of the augmentation, and whether it is mirrored."""


class Windows(Dataset):
    """Windows of consecutive pairs of scans. Frames are numbered through all drives.

    Args:
        drives: the drives to draw windows from.
        sensor: the sensor of their scans.
        length: pairs in a window; 1 for the CNNs.
        augmentation: changes of the windows; None: no change.
    """

    def __init__(
        self, drives: list[Drive], sensor: Sensor, length: int, augmentation: Augmentation | None = None
    ) -> None:
        self.drives, self.sensor, self.length = drives, sensor, length
        self.augmentation = augmentation or Augmentation(sensor)
        self.first_frames = np.cumsum([0] + [len(drive) for drive in drives])

    def __getitems__(self, draws: list[Draw]) -> Batch:
        """Builds a batch of windows.

        Returns:
            ``pairs`` (B, T, 2, bins) in metres, ``steps`` (B, T, 3) in metres and radians, and ``frames``
            (B,), the first frames of the windows, numbered through all drives.
        """
        pairs = np.empty((len(draws), self.length, 2, self.sensor.bins), np.float32)
        steps = np.empty((len(draws), self.length, 3), np.float32)
        for number, draw in enumerate(draws):
            self._write_window(pairs[number], steps[number], *draw)
        return {
            "pairs": torch.from_numpy(pairs),
            "steps": torch.from_numpy(steps),
            "frames": torch.tensor([frame for frame, _, _ in draws]),
        }

    def describe(self, frames: list[int]) -> str:
        """Names the drives and frames of the windows that begin at these frames, for a message."""
        ranges: dict[str, list[str]] = {}
        for frame in sorted(frames):
            drive, start = self._locate(frame)
            ranges.setdefault(drive.name, []).append(f"{start}-{start + self.length}")
        return "; ".join(f"{name}: {' '.join(frames_of_drive)}" for name, frames_of_drive in ranges.items())

    def _locate(self, frame: int) -> tuple[Drive, int]:
        """The drive of a frame that is numbered through all drives, and the frame's number in that drive."""
        number = int(np.searchsorted(self.first_frames, frame, side="right")) - 1
        return self.drives[number], frame - int(self.first_frames[number])

    def _write_window(
        self,
        pairs: npt.NDArray[np.float32],
        steps: npt.NDArray[np.float32],
        frame: int,
        seed: int,
        mirror: bool,
    ) -> None:
        """Writes one window into ``pairs`` (T, 2, bins) and ``steps`` (T, 3), in place."""
        drive, start = self._locate(frame)
        stop, augmentation = start + self.length, self.augmentation
        scans, truth = drive.scans[start : stop + 1], drive.steps[start:stop]
        if augmentation.changes_scans:
            scans, truth = augmentation.change(scans, truth, seed)
        pairs[:, 0], pairs[:, 1] = scans[:-1], scans[1:]
        steps[:] = truth
        if max_turn := augmentation.max_turn_bins:
            turns = np.random.default_rng(seed).integers(-max_turn, max_turn, self.length, endpoint=True)
            for pair, turn in zip(pairs, turns, strict=True):
                pair[1] = turn_scan(pair[1], int(turn), self.sensor)
            # The laser turns on the spot after the step, so its position does not change.
            steps[:, 2] += turns * math.radians(self.sensor.resolution_deg)
        if mirror:
            pairs[:] = pairs[..., ::-1]
            steps[:, 1:] *= -1


def turn_scan(scan: npt.NDArray[np.float32], bins: int, sensor: Sensor) -> npt.NDArray[np.float32]:
    """The depth vector (bins,) of a laser that is turned left by whole bins.

    In a partial field of view, returns that leave it are lost, and bins that enter it are empty.

    >>> sensor = Sensor(resolution_deg=90.0, field_of_view_deg=180.0)
    >>> turn_scan(np.array([1.0, 2.0, 3.0], np.float32), 1, sensor).tolist()
    [2.0, 3.0, 0.0]
    """
    if sensor.field_of_view_deg == 360:
        turned = np.roll(scan[:-1], -bins)
        return np.append(turned, turned[0])
    bins = max(-len(scan), min(bins, len(scan)))
    turned = np.roll(scan, -bins)
    turned[len(turned) - bins if bins > 0 else 0 : None if bins > 0 else -bins] = 0
    return turned


class WindowSampler(Sampler[Draw]):
    """Cuts each drive into windows and shuffles them.

    The first window of a drive begins at another random frame in every epoch. All random numbers depend on
    the seed and the epoch only. So an epoch of a resumed training is the same.

    Args:
        lengths: number of frames of each drive.
        window: pairs in a window.
        mirror: whether half of the windows are mirrored.
        seed: seed of the random numbers.
        stride: frames between the beginnings of windows; None: the length of a window, so that none overlap.
        repeat: how often each window is drawn in an epoch, each time with another augmentation.
    """

    def __init__(
        self,
        lengths: list[int],
        window: int,
        mirror: bool,
        seed: int,
        stride: int | None = None,
        repeat: int = 1,
    ) -> None:
        self.lengths, self.window, self.mirror, self.seed = lengths, window, mirror, seed
        self.stride, self.repeat = stride or window, repeat
        # The first window begins at a random frame within the frames that the strides leave over. So all
        # pairs are used over the epochs.
        self.counts = [max(1, (length - window) // self.stride) for length in lengths]
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return sum(self.counts) * self.repeat

    def __iter__(self) -> Iterator[Draw]:
        rng = np.random.default_rng([self.seed, self.epoch])
        frames, first = [], 0
        for length, count in zip(self.lengths, self.counts, strict=True):
            room = length - 1 - self.window - (count - 1) * self.stride
            offset = int(rng.integers(room + 1))
            frames += [first + offset + window * self.stride for window in range(count)]
            first += length
        for frame in rng.permutation(frames * self.repeat):
            yield int(frame), int(rng.integers(2**32)), self.mirror and bool(rng.integers(2))


class FreshSampler(WindowSampler):
    """Draws windows from new drives in every epoch. Their lengths are those of the first epoch's drives.

    Args:
        windows: windows of the first epoch's drives; later epochs replace the drives in it.
        worlds: the drives of every epoch.
        mirror, seed, stride, repeat: see :class:`WindowSampler`.
    """

    def __init__(
        self,
        windows: Windows,
        worlds: FreshWorlds,
        mirror: bool,
        seed: int,
        stride: int | None = None,
        repeat: int = 1,
    ) -> None:
        lengths = [len(drive) for drive in worlds.drives]
        super().__init__(lengths, windows.length, mirror, seed, stride, repeat)
        self.windows, self.worlds = windows, worlds

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before each epoch, also in a resumed run."""
        super().set_epoch(epoch)
        # Lightning passes the epoch to samplers only. The loader has no worker processes with copies of the
        # windows.
        self.windows.drives = self.worlds.drives_of(epoch)


class Batches(Sampler[list[Draw]]):
    """Batches of draws, shared evenly among processes. An interrupted epoch can continue at its next batch.

    Args:
        sampler: gives the draws.
        batch_size: windows in a batch of all processes together.
        rank: number of this process.
        processes: number of processes; it divides ``batch_size``.

    Attributes:
        given: number of batches of the present epoch that have been drawn.
    """

    def __init__(self, sampler: WindowSampler, batch_size: int, rank: int = 0, processes: int = 1) -> None:
        # Lightning calls `set_epoch` of the attribute `sampler`.
        self.sampler, self.batch_size, self.rank, self.processes = sampler, batch_size, rank, processes
        self.given = 0
        self._skipped = 0

    def skip_batches(self, batches: int) -> None:
        """Lets the next iteration skip this number of batches."""
        self._skipped = batches

    def __len__(self) -> int:
        return len(self.sampler) // self.batch_size

    def __iter__(self) -> Iterator[list[Draw]]:
        self.given, self._skipped = self._skipped, 0
        whole: Any = BatchSampler(self.sampler, self.batch_size, drop_last=True)  # type: ignore[arg-type]
        for batch in islice(whole, self.given, None):
            self.given += 1
            yield batch[self.rank :: self.processes]


class TrainingLoader(DataLoader):
    """A DataLoader whose position within an epoch is saved in checkpoints.

    Torchdata's loader does not fit: it draws the skipped batches before Lightning has set the sampler's
    epoch.
    """

    batch_sampler: Batches

    def state_dict(self) -> dict[str, int]:
        """The position, for a checkpoint."""
        return {"batches": self.batch_sampler.given}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Continues at the position of a checkpoint."""
        self.batch_sampler.skip_batches(state_dict["batches"])
