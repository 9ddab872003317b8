"""Measures the speed of training in comparison with a simple training loop: ``make bench-train``.

Each measurement runs in its own process, since this project's settings of the memory allocator would also
speed up the simple loop. The measurements take turns, so that other programs on the machine slow down all of
them alike.
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lightning as L
import numpy as np
import torch
from hydra import compose, initialize_config_dir
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm

from rcnn_odom.evaluation.run_folder import Settings
from rcnn_odom.evaluation.scores import aligned
from rcnn_odom.geometry import motions_of
from rcnn_odom.models.cnn import CHANNELS, STRIDES
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.losses import regression_loss
from rcnn_odom.training.entry import CONF
from rcnn_odom.training.settings import plain
from rcnn_odom.training.stages import build_datamodule, build_module, build_trainer

CASES = {"CNN, batches of 64": "cnn_reg", "RCNN, 16 windows of 16": "rcnn_reg"}
"""Models by the name of the case, with the batches of the recipe."""
ROUNDS, WARM_UP, SECONDS = 3, 3, 6.0
"""Number of rounds; in each of them, the number of untimed steps, and seconds of timed steps after them."""
FRAMES, EPOCH = 1500, 16500
"""Frames of the simulated drive, and of an epoch, which repeats the drive; about as many as KITTI has."""


class Pace(Callback):
    """Measures the training speed after the first steps.

    Attributes:
        frames, seconds: frames and seconds of the timed steps.
    """

    class Finished(Exception):
        """Enough steps have been timed."""

    def __init__(self) -> None:
        self.steps, self.frames, self.start, self.seconds = 0, 0, 0.0, 0.0

    def count(self, frames: int) -> None:
        """Counts a step with this number of frames.

        Raises:
            Finished: enough steps have been timed.
        """
        self.steps += 1
        if self.steps == WARM_UP:
            self.start = time.perf_counter()
        elif self.steps > WARM_UP:
            self.frames, self.seconds = self.frames + frames, time.perf_counter() - self.start
        if self.seconds > SECONDS:
            raise self.Finished

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Lightning's hook after every step."""
        self.count(batch["steps"].shape[:2].numel())


def settings_of(model: str, precision: str, outputs: str) -> Settings:
    """The default settings of a model, for training on one simulated drive."""
    options = [f"model={model}", f"trainer.precision={precision}", "trainer.accelerator=cpu"]
    options += [f"data.frames={FRAMES}", "data.train=['00']", "data.val=['10']", "data.test=['10']"]
    options += ["data.fresh_worlds=false", f"outputs={outputs}", f"run_dir={outputs}/run"]
    with initialize_config_dir(CONF, version_base="1.3"):
        return plain(compose("config", options))


def ours(settings: Settings) -> float:
    """Frames per second of this project's training with Lightning and all callbacks."""
    pace, datamodule = Pace(), build_datamodule(settings).load()
    datamodule.drives["train"] *= EPOCH // FRAMES
    trainer = build_trainer(settings, Path(settings["run_dir"]))
    trainer.callbacks.append(pace)  # type: ignore[attr-defined]
    with suppress(Pace.Finished):
        trainer.fit(build_module(settings, datamodule), datamodule=datamodule)
    return pace.frames / pace.seconds


class PlainNetwork(nn.Module):
    """The paper's network in standard PyTorch: ``Conv1d``, ``LSTM``, a linear layer."""

    def __init__(self, sensor: Sensor, hidden: int | None) -> None:
        super().__init__()
        self.max_range = sensor.max_range
        layers: list[nn.Module] = []
        inputs = 2
        for number, (channels, stride) in enumerate(zip(CHANNELS, STRIDES, strict=True)):
            if number in (2, 4):
                layers.append(nn.AvgPool1d(2))
            layers += [nn.Conv1d(inputs, channels, 3, stride, padding=1), nn.ReLU()]
            inputs = channels
        self.encoder = nn.Sequential(*layers)
        features = self.encoder(torch.zeros(1, 2, sensor.bins)).numel()
        self.first = nn.Linear(features, 2)
        self.lstm = nn.LSTM(features + 2, hidden, 2, batch_first=True) if hidden else None
        self.head = nn.Linear(hidden or features, 2)

    def forward(self, pairs: Tensor) -> Tensor:
        """Estimates motions (B, T, 2) of pairs (B, T, 2, bins)."""
        features = self.encoder(pairs.flatten(0, 1) / self.max_range).flatten(1).unflatten(0, pairs.shape[:2])
        if self.lstm is not None:
            features, _ = self.lstm(torch.cat([features, self.first(features)], -1))
        return self.head(features)


def plain_loop(settings: Settings) -> float:
    """Frames per second of a simple training loop: fp32, default Adam, a DataLoader of single windows."""
    options, sensor = settings["model"], Sensor(**settings["data"]["sensor"])
    [drive] = build_datamodule(settings).load(("train",)).drives["train"]
    scans, motions = (
        torch.from_numpy(np.array(drive.scans)),
        torch.from_numpy(motions_of(drive.steps)).float(),
    )
    pairs, window = torch.stack([scans[:-1], scans[1:]], 1), options["window"]
    windows: Any = [(pairs[i : i + window], motions[i : i + window]) for i in range(len(pairs) - window + 1)]
    network, pace = PlainNetwork(sensor, options.get("hidden_size")), Pace()
    optimizer = torch.optim.Adam(network.parameters(), options["learning_rate"])
    with suppress(Pace.Finished):
        while True:
            for inputs, truth in DataLoader(windows, options["batch_size"], shuffle=True, drop_last=True):
                optimizer.zero_grad()
                regression_loss(network(inputs), truth, options["beta"]).total.backward()
                nn.utils.clip_grad_norm_(network.parameters(), 1.0)
                optimizer.step()
                pace.count(truth.shape[:2].numel())
    return pace.frames / pace.seconds


WAYS = {
    "plain loop, fp32": (plain_loop, "32-true"),
    "ours, fp32": (ours, "32-true"),
    "ours, bf16": (ours, "bf16-mixed"),
}
"""The measuring function and the precision by name; the simple loop comes first, for comparison."""


def report(paces: dict[str, dict[str, list[float]]]) -> str:
    """Formats a table of the medians of all rounds.

    Args:
        paces: frames per second by case and by name in ``WAYS``.
    """
    rows = [[f"frames a second, {torch.get_num_threads()} threads", "median", "times plain"]]
    for case, found in paces.items():
        medians = {way: float(np.median(each)) for way, each in found.items()}
        reference = next(iter(medians.values()))
        rows += [
            [f"{case}: {way}", f"{pace:.0f}", f"{pace / reference:.2f}"] for way, pace in medians.items()
        ]
    return aligned(rows)


def main() -> None:
    """Measures all cases and prints the table."""
    paces: dict[str, dict[str, list[float]]] = {case: {way: [] for way in WAYS} for case in CASES}
    turns = [(case, way) for _ in range(ROUNDS) for case in CASES for way in WAYS]
    with TemporaryDirectory() as outputs:
        for case, way in tqdm(turns, disable=None, leave=False):
            measure, precision = WAYS[way]
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                pace = pool.submit(measure, settings_of(CASES[case], precision, outputs)).result()
            paces[case][way].append(pace)
    print(report(paces))


if __name__ == "__main__":
    main()
