"""The DataModule of all models: windows of pairs for training, whole drives for validation and test."""

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
"""Number of frames that are examined to explain why a recording has no return."""


class WholeDrives(Dataset):
    """A dataset whose items are whole drives: ``name``, and ``scans`` (N, bins) in metres."""

    def __init__(self, drives: list[Drive]) -> None:
        self.drives = drives

    def __len__(self) -> int:
        return len(self.drives)

    def __getitem__(self, number: int) -> dict[str, Any]:
        drive = self.drives[number]
        return {"name": drive.name, "scans": torch.from_numpy(np.array(drive.scans))}


class OdometryDataModule(L.LightningDataModule):
    """Opens and encodes recordings, and gives training windows and whole drives.

    Args:
        open_recording: function from a name to the recording.
        train, val, test: names of recordings. ``NAME[0.85:]`` is a part of a recording, in fractions of it;
            ``NAME[::3]`` is every third scan.
        sensor: the sensor of the depth vectors.
        cache_dir: folder of the encoded scans.
        window: pairs in a training window; 1 for the CNNs.
        batch_size: windows in a batch.
        stride: frames between the beginnings of windows; None: the length of a window.
        repeat: how often each window is drawn in an epoch.
        workers: number of processes that encode scans; None: one for each core.
        seed: seed of the order of the windows and of the augmentation.
        fresh_epochs: number of epochs of a training with new simulated drives in every epoch; then
            ``open_recording`` must accept any name, see :class:`rcnn_odom.training.fresh_worlds.FreshWorlds`.
            0: all epochs have the same drives.
        worlds_dir: folder of the new drives, which are removed after use; None: they stay in ``cache_dir``
            for other trainings.
        augment: options of :class:`rcnn_odom.training.augmentation.Augmentation` for the training windows.

    Attributes:
        drives: the loaded drives by split.
        fresh_first: number of the first new world; a second stage continues after the worlds of the first.
        worlds: the new worlds of the present training; None without them.
        windows: the windows of the present training.
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
            splits: some of ``train``, ``val`` and ``test``.
            encode: False for models that use whole scans: the drives get no depth vectors, and their beams
                are not compared with the sensor.

        Returns:
            This DataModule.

        Raises:
            InputError: a split is empty; a recording is missing or damaged, was taken by a laser other than
                the sensor, has no return or is shorter than a window; or a part of a simulated drive is
                named while new worlds are made in every epoch.
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
        """Encodes recordings; refuses one in which no scan has a return."""
        drives = encode_recordings(recordings, self.sensor, self.cache_dir, self.workers)
        for recording, drive in zip(recordings, drives, strict=True):
            self._check_returns(recording, drive)
        return drives

    def _check_parts(self, recordings: dict[str, Recording]) -> None:
        """Refuses a part of a training drive if the drive is simulated anew in every epoch."""
        for name in self.names["train"] if self.fresh_epochs else []:
            whole = parse_part(name).file
            if whole != name and not recordings[whole].keeps_world:
                raise InputError(
                    f"data.train={name}: new worlds come as whole drives; set data.fresh_worlds=false, "
                    f"or name {whole}"
                )

    def _check_returns(self, recording: Recording, drive: Drive) -> None:
        """Refuses a recording without any return; warns of scans without a return."""
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
        """Refuses training drives that are shorter than a window."""
        for drive in self.drives.get("train", []):
            if len(drive) <= self.window:
                raise InputError(
                    f"training sequence {drive.name} has {len(drive)} frames, a window needs "
                    f"{self.window + 1}; leave it out of data.train or set model.window lower"
                )

    def setup(self, stage: str | None = None) -> None:
        """Lightning's hook: calls :meth:`load` unless the drives are loaded."""
        if not self.drives:
            self.load()

    def training_steps(self) -> list[FloatArray]:
        """The steps (N, 3) of each training drive, metres and radians."""
        return [drive.steps for drive in self.drives["train"]]

    def train_dataloader(self) -> DataLoader:
        """Shuffled batches of windows: see :class:`rcnn_odom.training.windows.Windows`."""
        drives = self.drives["train"]
        self.windows = Windows(drives, self.sensor, self.window, self.augmentation)
        sampler, (rank, processes) = self._sampler(), self._rank_and_size()
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
            sampler = FreshSampler(self.windows, self.worlds, *self._sampler_options())
        # A batch is built in one call, so there is nothing to collate. Worker processes would only add
        # copies, since scans are memory-mapped.
        return TrainingLoader(
            self.windows,
            batch_sampler=Batches(sampler, self._windows_in_batch(), rank, processes),  # type: ignore[arg-type]
            collate_fn=_return_unchanged,
        )

    def _sampler(self) -> WindowSampler:
        lengths = [len(drive) for drive in self.drives["train"]]
        return WindowSampler(lengths, self.window, *self._sampler_options())

    def _sampler_options(self) -> tuple[bool, int, int | None, int]:
        return self.augmentation.mirror, self.seed, self.stride, self.repeat

    @property
    def batches_per_epoch(self) -> int:
        """Number of training steps in an epoch."""
        return len(self._sampler()) // self._windows_in_batch()

    def _windows_in_batch(self) -> int:
        """Windows in a batch of all processes: ``batch_size``, or fewer if an epoch has fewer windows."""
        windows, (_, processes) = len(self._sampler()), self._rank_and_size()
        if windows < processes:
            raise InputError(
                f"the training drives have {windows} windows of {self.window} pairs, fewer than the "
                f"{processes} devices; set model.window or trainer.devices lower"
            )
        return min(self.batch_size, windows // processes * processes)

    def _rank_and_size(self) -> tuple[int, int]:
        """The rank of this process and the number of processes that train."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def __getstate__(self) -> dict[str, Any]:
        """The state for another process, which reads the scans from the cache."""
        return self.__dict__ | {"drives": {}, "worlds": None, "windows": None}

    def close(self) -> None:
        """Stops making new worlds."""
        if self.worlds is not None:
            self.worlds.close()

    def teardown(self, stage: str) -> None:
        """Lightning's hook after training."""
        self.close()

    def on_exception(self, exception: BaseException) -> None:
        """Lightning's hook when training is stopped or fails."""
        self.close()

    def val_dataloader(self) -> DataLoader:
        """Whole validation drives, one per item; several processes share them."""
        return self._whole_drives("val")

    def test_dataloader(self) -> DataLoader:
        """Whole test drives, one per item; several processes share them."""
        return self._whole_drives("test")

    def _whole_drives(self, split: str) -> DataLoader:
        drives = WholeDrives(self.drives[split])
        rank, processes = self._rank_and_size()
        # If the number of drives is not a multiple of the number of processes, some drives are estimated
        # twice, so that all processes have the same number of items.
        sampler: Sampler[int] = DistributedSampler(drives, processes, rank, shuffle=False)
        return DataLoader(drives, sampler=sampler, batch_size=None)


def _return_unchanged(batch: Any) -> Any:
    return batch
