"""Training windows: consecutive pairs of scans, and in which order they are drawn."""

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
"""What the sampler decides about a window: its first frame, a seed for its augmentation, mirrored or not."""


class Windows(Dataset):
    """Windows of consecutive pairs of scans out of drives laid end to end.

    Args:
        drives: to draw from.
        sensor: theirs.
        length: pairs in a window; 1 gives the CNNs their single pairs.
        augmentation: what happens to them; None: nothing.
    """

    def __init__(
        self, drives: list[Drive], sensor: Sensor, length: int, augmentation: Augmentation | None = None
    ) -> None:
        self.drives, self.sensor, self.length = drives, sensor, length
        self.augmentation = augmentation or Augmentation(sensor)
        self.first_frames = np.cumsum([0] + [len(drive) for drive in drives])

    def __getitems__(self, draws: list[Draw]) -> Batch:
        """A batch of windows.

        Returns:
            ``pairs`` (B, T, 2, bins) in metres, ``steps`` (B, T, 3) in metres and radians, and ``frames``
            (B,), where the windows begin, of all drives laid end to end.
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
        """Which frames of which drives the windows that begin at these frames show, in words."""
        ranges: dict[str, list[str]] = {}
        for frame in sorted(frames):
            drive, start = self._locate(frame)
            ranges.setdefault(drive.name, []).append(f"{start}-{start + self.length}")
        return "; ".join(f"{name}: {' '.join(its)}" for name, its in ranges.items())

    def _locate(self, frame: int) -> tuple[Drive, int]:
        """The drive that holds a frame of all, and the frame's place in it."""
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
        """Fills in pairs (T, 2, bins) and steps (T, 3) of one window."""
        drive, start = self._locate(frame)
        stop, augmentation = start + self.length, self.augmentation
        scans, truth = drive.scans[start : stop + 1], drive.steps[start:stop]
        if augmentation.is_of_scans:
            scans, truth = augmentation.change(scans, truth, seed)
        pairs[:, 0], pairs[:, 1] = scans[:-1], scans[1:]
        steps[:] = truth
        if most := augmentation.max_turn_bins:
            turns = np.random.default_rng(seed).integers(-most, most, self.length, endpoint=True)
            for pair, turn in zip(pairs, turns, strict=True):
                pair[1] = turn_scan(pair[1], int(turn), self.sensor)
            # A turn on the spot after the step: where the laser is stays as it was.
            steps[:, 2] += turns * math.radians(self.sensor.resolution_deg)
        if mirror:
            pairs[:] = pairs[..., ::-1]
            steps[:, 1:] *= -1


def turn_scan(scan: npt.NDArray[np.float32], bins: int, sensor: Sensor) -> npt.NDArray[np.float32]:
    """The depth vector (bins,) as seen by a laser turned left by whole bins.

    What turns out of a partial field of view is lost, and what turns into it is empty.
    """
    if sensor.field_of_view_deg == 360:
        turned = np.roll(scan[:-1], -bins)
        return np.append(turned, turned[0])
    bins = max(-len(scan), min(bins, len(scan)))
    turned = np.roll(scan, -bins)
    turned[len(turned) - bins if bins > 0 else 0 : None if bins > 0 else -bins] = 0
    return turned


class WindowSampler(Sampler[Draw]):
    """Every epoch cuts each drive into windows from another random frame on, and shuffles them.

    All draws come from (seed, epoch), so that an epoch is the same however it was reached.

    Args:
        lengths: frames of each drive. window: pairs in a window. mirror: mirror every other window.
        stride: frames between the beginnings of windows; None: the window's length, so that none overlap.
        repeat: how often each window comes in an epoch, each time augmented in another way.
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
        # Of the frames at which a window can begin, each stride has one; what is left over is the room by
        # which the first window moves, so that every pair has its turn.
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
    """Draws windows out of other drives in every epoch, as long as the first epoch's.

    Args:
        windows: of the first epoch's drives. worlds: the drives of every epoch.
        mirror, seed, stride, repeat: as for :class:`WindowSampler`.
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
        """Lightning calls this before each epoch, of a resumed run as well."""
        super().set_epoch(epoch)
        # Lightning tells only samplers of an epoch; the loader has no processes that would hold a copy.
        self.windows.drives = self.worlds.drives_of(epoch)


class Batches(Sampler[list[Draw]]):
    """Whole batches of draws, of which every process takes its share; an epoch can go on where it stopped.

    Args:
        sampler: of the draws. batch_size: windows in a batch, of all processes together.
        rank: number of this process. processes: how many there are; they divide ``batch_size``.

    Attributes:
        given: batches of the present epoch that have been given away.
    """

    def __init__(self, sampler: WindowSampler, batch_size: int, rank: int = 0, processes: int = 1) -> None:
        # Lightning tells `sampler` of every epoch.
        self.sampler, self.batch_size, self.rank, self.processes = sampler, batch_size, rank, processes
        self.given = 0
        self._skipped = 0

    def go_on_after(self, batches: int) -> None:
        """Lets the next epoch that is asked for begin with a later batch."""
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
    """A DataLoader that tells a checkpoint how far it has come.

    Torchdata's would draw the batches to skip before Lightning has set the sampler's epoch.
    """

    batch_sampler: Batches

    def state_dict(self) -> dict[str, int]:
        """What a checkpoint keeps."""
        return {"batches": self.batch_sampler.given}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Goes on from a checkpoint's."""
        self.batch_sampler.go_on_after(state_dict["batches"])
