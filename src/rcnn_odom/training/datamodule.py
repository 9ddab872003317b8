"""The one DataModule that every model shares: windows of pairs to train on, whole drives to score."""

import logging
import os
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, DistributedSampler, Sampler

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.cache import encode_recordings
from rcnn_odom.recordings.parts import cut, parse_part, trusted_pieces
from rcnn_odom.recordings.recording import Drive, OpenRecording, Recording
from rcnn_odom.recordings.returns import AbsentReturns
from rcnn_odom.training.augmentation import Augmentation
from rcnn_odom.training.fresh_worlds import FreshWorlds
from rcnn_odom.training.windows import Batches, FreshSampler, TrainingLoader, Windows, WindowSampler

log = logging.getLogger(__name__)

SAMPLED_FRAMES = 50
"""Frames of a recording without a return that are looked at to say why."""


class WholeDrives(Dataset):
    """Whole drives in order, each one item: its ``name`` and ``scans`` (N, bins) in metres."""

    def __init__(self, drives: list[Drive]) -> None:
        self.drives = drives

    def __len__(self) -> int:
        return len(self.drives)

    def __getitem__(self, number: int) -> dict[str, Any]:
        drive = self.drives[number]
        return {"name": drive.name, "scans": torch.from_numpy(np.array(drive.scans))}


class OdometryDataModule(L.LightningDataModule):
    """Recordings, encoded once, for every model.

    Args:
        open_recording: name -> recording.
        train, val, test: names of recordings; ``NAME[0.85:]`` takes a part of one, as fractions of it,
            ``NAME[::3]`` every third scan.
        sensor: what the depth vectors are like.
        window: pairs in a training window; 1 for the CNNs. batch_size: windows in a batch.
        stride: frames between the beginnings of windows; None: the window's length.
        repeat: how often each window comes in an epoch.
        cache_dir: where encoded scans are kept. workers: processes that encode; None for all cores.
        seed: of the order and the augmentation.
        fresh_epochs: of a training on new worlds in every epoch, where ``open_recording`` makes a drive for
            any name: see :class:`rcnn_odom.training.fresh_worlds.FreshWorlds`. 0: every epoch sees the same
            drives.
        worlds_dir: of those worlds, removed after use; None: they stay in ``cache_dir``, for other trainings.
        augment: options of :class:`rcnn_odom.training.augmentation.Augmentation`, of the training windows.

    Attributes:
        fresh_first: where the numbers of the new worlds begin: after those of the stage before.
    """

    def __init__(
        self,
        open_recording: OpenRecording,
        train: list[str],
        val: list[str],
        test: list[str],
        sensor: Sensor,
        cache_dir: str | Path,
        window: int = 1,
        batch_size: int = 64,
        stride: int | None = None,
        repeat: int = 1,
        workers: int | None = None,
        seed: int = 0,
        fresh_epochs: int = 0,
        worlds_dir: str | Path | None = None,
        **augment: Any,
    ) -> None:
        super().__init__()
        self.open_recording, self.sensor, self.cache_dir = open_recording, sensor, Path(cache_dir)
        self.names = {"train": train, "val": val, "test": test}
        self.window, self.batch_size, self.seed = window, batch_size, seed
        self.stride, self.repeat = stride, repeat
        self.augmentation = Augmentation(sensor, **augment)
        self.workers = workers or os.cpu_count() or 1
        self.drives: dict[str, list[Drive]] = {}
        self.fresh_epochs, self.fresh_first = fresh_epochs, 0
        self.worlds_dir = worlds_dir and Path(worlds_dir)
        self.worlds: FreshWorlds | None = None
        self.windows: Windows | None = None

    def load(
        self, splits: tuple[str, ...] = ("train", "val", "test"), encode: bool = True
    ) -> "OdometryDataModule":
        """Opens and encodes the drives of these splits.

        Args:
            splits: of ``train``, ``val`` and ``test``.
            encode: False for models that look at whole scans: the drives have no depth vectors, and their
                beams are not compared with the sensor.

        Raises:
            InputError: a split is empty; a recording is missing, damaged, of another laser than the sensor,
                without a return or shorter than a window; new worlds are wanted in place of a part of a
                drive.
        """
        for split in splits:
            if not self.names[split]:
                raise InputError(f"data.{split} names no sequence; give one, data.{split}=[NAME]")
        wanted = [parse_part(name) for split in splits for name in self.names[split]]
        files = list(dict.fromkeys(part.file for part in wanted))
        recordings = [self.open_recording(file) for file in files]
        if "train" in splits:
            self._check_parts(dict(zip(files, recordings, strict=True)))
        for recording in recordings:
            for note in recording.notes:
                log.info("%s: %s", recording.name, note)
        drives = self._encode(recordings) if encode else [Drive.unencoded(each) for each in recordings]
        whole = dict(zip(files, drives, strict=True))
        for split in splits:
            self.drives[split] = [cut(whole, name) for name in self.names[split]]
        if "train" in splits:
            least = self.window + 1
            drives = [piece for drive in self.drives["train"] for piece in trusted_pieces(drive, least)]
            self.drives["train"] = drives
        self._check_windows()
        return self

    def _encode(self, recordings: list[Recording]) -> list[Drive]:
        """The recordings with their depth vectors, each with a return at least."""
        drives = encode_recordings(recordings, self.sensor, self.cache_dir, self.workers)
        for recording, drive in zip(recordings, drives, strict=True):
            self._check_returns(recording, drive)
        return drives

    def _check_parts(self, recordings: dict[str, Recording]) -> None:
        """Refuses parts of training drives that are made anew in every epoch."""
        for name in self.names["train"] if self.fresh_epochs else []:
            whole = parse_part(name).file
            if whole != name and not recordings[whole].keeps_world:
                raise InputError(
                    f"data.train={name}: new worlds come as whole drives; set data.fresh_worlds=false, "
                    f"or name {whole}"
                )

    def _check_returns(self, recording: Recording, drive: Drive) -> None:
        """Refuses a recording in which nothing is seen; tells how many of its scans have no return."""
        empty = np.flatnonzero(~drive.scans.any(1))
        if 0 < len(empty) < len(drive):
            log.warning(
                "%s: %d of %d scans have no return that the sensor has a bin for",
                *(recording.name, len(empty), len(drive)),
            )
        if len(empty) < len(drive):
            return
        absent = AbsentReturns(self.sensor.max_range)
        for frame in np.unique(np.linspace(0, len(drive) - 1, SAMPLED_FRAMES).astype(int)):
            absent.add(recording.read_scan(frame))
        raise InputError(
            f"{recording.name}: {absent}; leave the recording out, or correct what its laser writes"
        )

    def _check_windows(self) -> None:
        for drive in self.drives.get("train", []):
            if len(drive) <= self.window:
                raise InputError(
                    f"training sequence {drive.name} has {len(drive)} frames, a window needs "
                    f"{self.window + 1}; leave it out of data.train or set model.window lower"
                )

    def setup(self, stage: str | None = None) -> None:
        """Lightning's hook: the same as :meth:`load`, once."""
        if not self.drives:
            self.load()

    def training_steps(self) -> FloatArray:
        """The steps (N, 3) of the training drives, metres and radians."""
        return np.concatenate([drive.steps for drive in self.drives["train"]])

    def train_dataloader(self) -> DataLoader:
        """Shuffled batches of windows: see :class:`rcnn_odom.training.windows.Windows`."""
        drives = self.drives["train"]
        self.windows = Windows(drives, self.sensor, self.window, self.augmentation)
        sampler, (rank, processes) = self._sampler(), self._place()
        if self.fresh_epochs:
            self.close()
            self.worlds = FreshWorlds(
                self.open_recording,
                drives,
                self.fresh_epochs,
                self.sensor,
                workers=0 if rank else self.workers,
                folder=self.worlds_dir or self.cache_dir,
                keep=self.worlds_dir is None,
                first=self.fresh_first,
            )
            sampler = FreshSampler(self.windows, self.worlds, *self._sampling())
        # A batch is gathered in one call, so there is nothing to collate; worker processes would only
        # copy what a memory map gives for nothing.
        return TrainingLoader(
            self.windows,
            batch_sampler=Batches(sampler, self._windows_in_batch(), rank, processes),  # type: ignore[arg-type]
            collate_fn=_as_is,
        )

    def _sampler(self) -> WindowSampler:
        lengths = [len(drive) for drive in self.drives["train"]]
        return WindowSampler(lengths, self.window, *self._sampling())

    def _sampling(self) -> tuple[bool, int, int | None, int]:
        return self.augmentation.mirror, self.seed, self.stride, self.repeat

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
        return self.__dict__ | {"drives": {}, "worlds": None, "windows": None}

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
        """Whole validation drives, one an item; several processes share them."""
        return self._whole_drives("val")

    def test_dataloader(self) -> DataLoader:
        """Whole test drives, one an item; several processes share them."""
        return self._whole_drives("test")

    def _whole_drives(self, split: str) -> DataLoader:
        drives = WholeDrives(self.drives[split])
        rank, processes = self._place()
        # Some come twice where they do not come out even, so that no process waits for one that has none.
        sampler: Sampler[int] = DistributedSampler(drives, processes, rank, shuffle=False)
        return DataLoader(drives, sampler=sampler, batch_size=None)


def _as_is(batch: Any) -> Any:
    return batch
