"""The one DataModule that every variant shares: windows of pairs to train on, whole drives to score."""

import logging
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from torch.utils.data import BatchSampler, DataLoader, Dataset, DistributedSampler, Sampler

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.cache import EncodedSequence, encode_sequences
from rcnn_odom.recordings.recording import Sequence
from rcnn_odom.training.fresh_worlds import FreshWorlds

log = logging.getLogger(__name__)

Batch = dict[str, torch.Tensor]
Draw = tuple[int, int, bool]
"""What the sampler decides about one window: its first frame, a seed for the turns, mirrored or not."""


class Windows(Dataset):
    """Windows of consecutive pairs of scans out of drives laid end to end.

    Args:
        sequences: the drives.
        sensor: theirs.
        length: pairs in a window; 1 gives the CNNs their single pairs.
        max_turn_bins: the second scan of each pair is turned by up to so many whole bins, and the true
            heading change with it; both stay exact. 0: never.
    """

    def __init__(
        self, sequences: list[EncodedSequence], sensor: Sensor, length: int, max_turn_bins: int = 0
    ) -> None:
        self.sequences, self.sensor, self.length = sequences, sensor, length
        self.max_turn_bins = max_turn_bins
        self.first_frames = np.cumsum([0] + [len(sequence) for sequence in sequences])

    def __getitems__(self, draws: list[Draw]) -> Batch:
        """A batch of windows.

        Returns:
            ``pairs`` (B, T, 2, bins) in metres, ``motions`` (B, T, 2) in metres and radians, and ``frames``
            (B,), where the windows begin, of all drives laid end to end.
        """
        pairs = np.empty((len(draws), self.length, 2, self.sensor.bins), np.float32)
        motions = np.empty((len(draws), self.length, 2), np.float32)
        for number, draw in enumerate(draws):
            self._write_window(pairs[number], motions[number], *draw)
        return {
            "pairs": torch.from_numpy(pairs),
            "motions": torch.from_numpy(motions),
            "frames": torch.tensor([frame for frame, _, _ in draws]),
        }

    def describe(self, frames: list[int]) -> str:
        """Which frames of which drives the windows that begin at these frames show, in words."""
        ranges: dict[str, list[str]] = {}
        for frame in sorted(frames):
            sequence, start = self._locate(frame)
            ranges.setdefault(sequence.name, []).append(f"{start}-{start + self.length}")
        return "; ".join(f"{name}: {' '.join(its)}" for name, its in ranges.items())

    def _locate(self, frame: int) -> tuple[EncodedSequence, int]:
        """The drive that holds a frame of all, and the frame's place in it."""
        number = int(np.searchsorted(self.first_frames, frame, side="right")) - 1
        return self.sequences[number], frame - int(self.first_frames[number])

    def _write_window(
        self, pairs: np.ndarray, motions: np.ndarray, frame: int, seed: int, mirror: bool
    ) -> None:
        """Fills in pairs (T, 2, bins) and motions (T, 2) of one window."""
        sequence, start = self._locate(frame)
        stop = start + self.length
        pairs[:, 0], pairs[:, 1] = sequence.scans[start:stop], sequence.scans[start + 1 : stop + 1]
        truth = sequence.motions[start:stop].copy()
        if self.max_turn_bins:
            turns = np.random.default_rng(seed).integers(
                -self.max_turn_bins, self.max_turn_bins, self.length, endpoint=True
            )
            for pair, turn in zip(pairs, turns, strict=True):
                pair[1] = turn_scan(pair[1], int(turn), self.sensor)
            truth[:, 1] += turns * math.radians(self.sensor.resolution_deg)
        if mirror:
            pairs[:] = pairs[..., ::-1]
            truth[:, 1] *= -1
        motions[:] = truth


def turn_scan(scan: np.ndarray, bins: int, sensor: Sensor) -> np.ndarray:
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
    """

    def __init__(self, lengths: list[int], window: int, mirror: bool, seed: int) -> None:
        self.lengths, self.window, self.mirror, self.seed = lengths, window, mirror, seed
        # One window fewer than would fit leaves the room by which the first frame moves.
        self.counts = [max(1, length // window - 1) if window > 1 else length - 1 for length in lengths]
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return sum(self.counts)

    def __iter__(self) -> Iterator[Draw]:
        rng = np.random.default_rng([self.seed, self.epoch])
        frames, first = [], 0
        for length, count in zip(self.lengths, self.counts, strict=True):
            room = length - 1 - count * self.window
            offset = int(rng.integers(room + 1))
            frames += [first + offset + window * self.window for window in range(count)]
            first += length
        for frame in rng.permutation(frames):
            yield int(frame), int(rng.integers(2**32)), self.mirror and bool(rng.integers(2))


class FreshSampler(WindowSampler):
    """Draws windows out of other drives in every epoch, as long as the first epoch's.

    Args:
        windows: of the first epoch's drives. worlds: the drives of every epoch.
        mirror, seed: as for :class:`WindowSampler`.
    """

    def __init__(self, windows: Windows, worlds: FreshWorlds, mirror: bool, seed: int) -> None:
        super().__init__([len(drive) for drive in worlds.drives], windows.length, mirror, seed)
        self.windows, self.worlds = windows, worlds

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before each epoch, of a resumed run as well."""
        super().set_epoch(epoch)
        # Lightning tells only samplers of an epoch; the loader has no processes that would hold a copy.
        self.windows.sequences = self.worlds.of(epoch)


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


class Drives(Dataset):
    """Whole sequences in order, each one item: its ``number`` and ``scans`` (N, bins) in metres."""

    def __init__(self, sequences: list[EncodedSequence]) -> None:
        self.sequences = sequences

    def __len__(self) -> int:
        return len(self.sequences)

    def __getitem__(self, number: int) -> dict[str, Any]:
        sequence = self.sequences[number]
        return {"number": number, "scans": torch.from_numpy(np.array(sequence.scans))}


class OdometryDataModule(L.LightningDataModule):
    """Recordings, encoded once, for all four variants.

    Args:
        read: name -> ``Sequence``.
        train, val, test: names of sequences; ``NAME[0.85:]`` takes a part of one, as fractions of it.
        sensor: what the depth vectors are like.
        window: pairs in a training window; 1 for the CNNs. batch_size: windows in a batch.
        max_turn_deg, mirror: label-exact augmentation of the training windows; 0 and False: none.
        cache_dir: where encoded scans are kept. workers: processes that encode; None for all cores.
        seed: of the order and the augmentation.
        fresh_epochs: of a training on new worlds in every epoch, where ``read`` makes a drive for any
            name: see :class:`rcnn_odom.training.fresh_worlds.FreshWorlds`. 0: every epoch sees the same
            drives.
        fresh_first: where the numbers of those worlds begin.
        worlds_dir: of those worlds, removed after use; None: they stay in ``cache_dir``, for other trainings.
    """

    def __init__(
        self,
        read: Callable[[str], Sequence],
        train: list[str],
        val: list[str],
        test: list[str],
        sensor: Sensor,
        cache_dir: str | Path,
        window: int = 1,
        batch_size: int = 64,
        max_turn_deg: float = 0.0,
        mirror: bool = False,
        workers: int | None = None,
        seed: int = 0,
        fresh_epochs: int = 0,
        fresh_first: int = 0,
        worlds_dir: str | Path | None = None,
    ) -> None:
        super().__init__()
        self.read, self.sensor, self.cache_dir = read, sensor, Path(cache_dir)
        self.names = {"train": train, "val": val, "test": test}
        self.window, self.batch_size, self.seed = window, batch_size, seed
        self.max_turn_bins, self.mirror = round(max_turn_deg / sensor.resolution_deg), mirror
        self.workers = workers or os.cpu_count() or 1
        self.sequences: dict[str, list[EncodedSequence]] = {}
        self.fresh_epochs, self.fresh_first = fresh_epochs, fresh_first
        self.worlds_dir = worlds_dir and Path(worlds_dir)
        self.worlds: FreshWorlds | None = None
        self.windows: Windows | None = None

    def load(self, splits: tuple[str, ...] = ("train", "val", "test")) -> "OdometryDataModule":
        """Reads and encodes the sequences of these splits.

        Raises:
            InputError: a split is empty; a recording is missing, damaged or shorter than a window; new
                worlds are wanted in place of a part of a drive.
        """
        self._check_names(splits)
        wanted = [parse_part(name) for split in splits for name in self.names[split]]
        files = list(dict.fromkeys(file for file, _, _ in wanted))
        recordings = [self.read(file) for file in files]
        for recording in recordings:
            for note in recording.notes:
                log.info("%s: %s", recording.name, note)
        encoded = dict(
            zip(files, encode_sequences(recordings, self.sensor, self.cache_dir, self.workers), strict=True)
        )
        for split in splits:
            self.sequences[split] = [cut(encoded, name) for name in self.names[split]]
        self._check_windows()
        return self

    def _check_names(self, splits: tuple[str, ...]) -> None:
        for split in splits:
            if not self.names[split]:
                raise InputError(f"data.{split} names no sequence; give one, data.{split}=[NAME]")
        for name in self.names["train"] if "train" in splits else []:
            whole = parse_part(name)[0]
            if self.fresh_epochs and whole != name:
                raise InputError(
                    f"data.train={name}: new worlds come as whole drives; set data.fresh_worlds=false, "
                    f"or name {whole}"
                )

    def _check_windows(self) -> None:
        for sequence in self.sequences.get("train", []):
            if len(sequence) <= self.window:
                raise InputError(
                    f"training sequence {sequence.name} has {len(sequence)} frames, a window needs "
                    f"{self.window + 1}; leave it out of data.train or set model.window lower"
                )

    def setup(self, stage: str | None = None) -> None:
        """Lightning's hook: the same as :meth:`load`, once."""
        if not self.sequences:
            self.load()

    def motion_statistics(self) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation (2,), (2,) of the training motions, metres and radians."""
        motions = np.concatenate([sequence.motions for sequence in self.sequences["train"]])
        return motions.mean(0), np.maximum(motions.std(0), 1e-6)

    def train_dataloader(self) -> DataLoader:
        """Shuffled batches of windows: see :class:`Windows`.

        Raises:
            InputError: a sequence is shorter than a window.
        """
        sequences = self.sequences["train"]
        self._check_windows()
        self.windows = windows = Windows(sequences, self.sensor, self.window, self.max_turn_bins)
        sampler = self._sampler()
        rank, processes = self._place()
        if self.fresh_epochs:
            self.close()
            self.worlds = FreshWorlds(
                self.read,
                sequences,
                self.fresh_epochs,
                self.sensor,
                workers=0 if rank else self.workers,
                folder=self.worlds_dir or self.cache_dir,
                keep=self.worlds_dir is None,
                first=self.fresh_first,
            )
            sampler = FreshSampler(windows, self.worlds, self.mirror, self.seed)
        # A batch is gathered in one call, so there is nothing to collate; worker processes would only
        # copy what a memory map gives for nothing.
        return TrainingLoader(
            windows,
            batch_sampler=Batches(sampler, self._windows_in_batch(), rank, processes),  # type: ignore[arg-type]
            collate_fn=_as_is,
        )

    def _sampler(self) -> WindowSampler:
        lengths = [len(sequence) for sequence in self.sequences["train"]]
        return WindowSampler(lengths, self.window, self.mirror, self.seed)

    @property
    def batches_per_epoch(self) -> int:
        """Steps that an epoch takes."""
        return len(self._sampler()) // self._windows_in_batch()

    def _windows_in_batch(self) -> int:
        """Of all processes together: as many as wanted, or as many as there are, shared evenly."""
        windows, (_, processes) = len(self._sampler()), self._place()
        if windows < processes:
            raise InputError(
                f"the training drives have {windows} windows of {self.window} pairs, fewer than the "
                f"{processes} devices; set model.window or trainer.devices lower"
            )
        return min(self.batch_size, windows // processes * processes)

    def _place(self) -> tuple[int, int]:
        """Number of this process among those that train, and how many these are."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def __getstate__(self) -> dict[str, Any]:
        """What a process that trains needs: it finds the scans in the cache, instead of being sent them."""
        return self.__dict__ | {"sequences": {}, "worlds": None, "windows": None}

    def close(self) -> None:
        """Ends what is being made of new worlds."""
        if self.worlds is not None:
            self.worlds.close()

    def teardown(self, stage: str) -> None:
        """Lightning's hook after training."""
        self.close()

    def on_exception(self, exception: BaseException) -> None:
        """Lightning's hook when training is stopped or fails."""
        self.close()

    def val_dataloader(self) -> DataLoader:
        """Whole validation sequences, one an item; several processes share them."""
        return self._drives("val")

    def test_dataloader(self) -> DataLoader:
        """Whole test sequences, one an item; several processes share them."""
        return self._drives("test")

    def _drives(self, split: str) -> DataLoader:
        drives = Drives(self.sequences[split])
        rank, processes = self._place()
        # Some come twice where they do not come out even, so that no process waits for one that has none.
        sampler: Sampler[int] = DistributedSampler(drives, processes, rank, shuffle=False)
        return DataLoader(drives, sampler=sampler, batch_size=None)


def _as_is(batch: Any) -> Any:
    return batch


def parse_part(name: str) -> tuple[str, float, float]:
    """``NAME`` or ``NAME[a:b]`` -> name and the fractions of the recording where the part lies.

    Raises:
        InputError: the brackets do not hold fractions with a < b.
    """
    match = re.fullmatch(r"(.+?)\[([\d.]*):([\d.]*)\]", name)
    if match is None:
        if "[" in name:
            raise InputError(f"sequence {name!r}: a part is written NAME[0.0:0.85], fractions of the drive")
        return name, 0.0, 1.0
    try:
        start, stop = float(match[2] or 0), float(match[3] or 1)
    except ValueError:
        start, stop = 1.0, 0.0
    if not 0 <= start < stop <= 1:
        raise InputError(f"sequence {name!r}: a part needs two fractions between 0 and 1, the smaller first")
    return match[1], start, stop


def cut(encoded: Mapping[str, EncodedSequence], name: str) -> EncodedSequence:
    """The part of a recording that ``name`` asks for, without the ends whose truth is unknown.

    Raises:
        InputError: the truth has gaps inside, or fewer than two frames are left.
    """
    file, start, stop = parse_part(name)
    whole = encoded[file]
    part = whole.part(round(start * len(whole)), round(stop * len(whole)), name)
    known = np.flatnonzero(np.isfinite(part.poses).all((1, 2)))
    if len(known) < 2:
        raise InputError(f"sequence {name} has {len(known)} frames with known poses; two are needed")
    first, last = int(known[0]), int(known[-1])
    if len(known) != last - first + 1:
        gap = int(np.flatnonzero(np.diff(known) > 1)[0])
        raise InputError(
            f"sequence {file}: the truth is unknown at frame {round(start * len(whole)) + known[gap] + 1}, "
            "between known ones; "
            "use parts of it, NAME[a:b]"
        )
    if len(known) != len(part):
        log.info("%s: frames %d to %d of %d, where the truth is known", name, first, last, len(part))
    return part.part(first, last + 1)
