"""How fast training is, against a plain loop and the machine's own limits: ``make bench-train``.

Every way runs in a process of its own, since what ours asks of the memory allocator would help the plain
loop too, and all take turns, so that a machine that others use as well slows down all of them alike.
"""

import logging
import multiprocessing
import subprocess
import sys
import time
from collections.abc import Callable
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
from torch.utils.data import DataLoader, Dataset
from torch.utils.flop_counter import FlopCounterMode
from tqdm import tqdm

from rcnn_odom.evaluation.scores import aligned
from rcnn_odom.models import networks
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.models.losses import regression_loss
from rcnn_odom.models.networks import CHANNELS, STRIDES
from rcnn_odom.recordings import kitti
from rcnn_odom.recordings.cache import EncodedSequence
from rcnn_odom.training import modules
from rcnn_odom.training import stages as experiment
from rcnn_odom.training.datamodule import Windows
from rcnn_odom.training.machine import resolve_precision
from rcnn_odom.training.settings import Settings, plain

ROOT = Path(__file__).parents[2]
CASES = {
    "CNN, batches of 64": ("cnn_reg", "model.batch_size=64"),
    "CNN, batches of 128": ("cnn_reg", "model.batch_size=128"),
    "RCNN, 16 windows of 16": ("rcnn_reg", "model.batch_size=16"),
}
"""Variant and option by name. The recipe's batches, and twice as many pairs for the CNN."""
ROUNDS = 3
WARM_UP = 3
SECONDS = 6.0
"""Of timed steps in each round."""
FRAMES = 1500
"""Of the simulated drive that is trained on, over and over: an epoch is as long as KITTI's."""
TRAINING, VALIDATION = 17037, 1201
"""Frames of KITTI's training and validation drives."""
RINGS, BEAMS = 64, 1900
"""Of a Velodyne's revolution, some 120,000 points."""


class Pace(Callback):
    """Counts the frames that training takes in a second, and ends it.

    Attributes:
        clock: with the pace, after the end.
    """

    class Enough(Exception):
        """The end."""

    def __init__(self) -> None:
        self.clock = Clock()

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """After every step."""
        if self.clock.tick(batch["motions"][..., 0].numel()):
            raise self.Enough


class Clock:
    """Frames in a second, without those of the first steps."""

    def __init__(self) -> None:
        self.steps, self.frames, self.start = 0, 0, 0.0

    def tick(self, frames: int) -> bool:
        """After a step of so many frames: whether that is enough."""
        self.steps += 1
        if self.steps == WARM_UP:
            self.start = time.perf_counter()
        elif self.steps > WARM_UP:
            self.frames += frames
            self.seconds = time.perf_counter() - self.start
        return self.steps > WARM_UP and self.seconds > SECONDS

    @property
    def pace(self) -> float:
        """Frames a second."""
        return self.frames / self.seconds


def settings_of(case: str, outputs: str, *overrides: str) -> Settings:
    """The default settings of a training on one simulated drive."""
    variant, batch_size = CASES[case]
    options = [f"model={variant}", f"data.frames={FRAMES}", "data.train=['00']", "data.val=['10']"]
    options += ["data.test=['10']", "data.fresh_worlds=false", f"outputs={outputs}", "run_dir=unused"]
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return plain(compose("config", [*options, batch_size, *overrides]))


def ours(case: str, outputs: str, precision: str, without: str = "") -> float:
    """Frames a second of this project's training, by Lightning with all its callbacks.

    Args:
        case: of ``CASES``.
        outputs: folder with the cache.
        precision: Lightning's.
        without: one of ``LEFT_OUT``.
    """
    settings = settings_of(case, outputs, f"trainer.precision={precision}", "trainer.accelerator=cpu")
    logging.getLogger().addHandler(logging.NullHandler())  # no line for an epoch
    if without:
        LEFT_OUT[without]()
    with TemporaryDirectory() as run:
        datamodule = experiment.build_datamodule(settings).load()
        datamodule.sequences["train"] *= TRAINING // FRAMES
        trainer = experiment.build_trainer(settings, Path(run))
        pace = Pace()
        trainer.callbacks.append(pace)  # type: ignore[attr-defined]
        with suppress(Pace.Enough):
            trainer.fit(experiment.build_module(settings, datamodule), datamodule=datamodule)
    return pace.clock.pace


def _return_memory() -> None:
    modules.keep_freed_memory = lambda: None


def _unfuse_adam() -> None:
    adam = torch.optim.Adam
    torch.optim.Adam = lambda parameters, lr, fused: adam(parameters, lr)  # type: ignore


def _plain_layout() -> None:
    made = networks.Encoder.__init__

    def build(self: networks.Encoder, *arguments: Any) -> None:
        made(self, *arguments)
        self.layers.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]

    networks.Encoder.__init__ = build  # type: ignore
    networks.Encoder.lay_out = lambda self, pairs: pairs.unsqueeze(2)  # type: ignore


class _TorchLSTM(nn.Module):
    """``torch.nn.LSTM`` in place of ours."""

    def __init__(self, inputs: int, hidden: int, layers: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.lstm = nn.LSTM(inputs, hidden, layers, batch_first=True)
        self.weight_ih = [self.lstm.weight_ih_l0]

    def forward(self, inputs: Tensor, state: None = None) -> tuple[Tensor, None]:
        return self.lstm(inputs)[0], None


def _torch_lstm() -> None:
    networks.LSTM = _TorchLSTM  # type: ignore


LEFT_OUT = {
    "the allocator keeping memory": _return_memory,
    "fused Adam": _unfuse_adam,
    "channels innermost": _plain_layout,
    "our LSTM": _torch_lstm,
}
"""What makes a training fast, each with what takes it away."""


class Singles(Dataset):
    """Windows one by one, as a plain loop would have them."""

    def __init__(self, drive: EncodedSequence, window: int, sensor: Sensor) -> None:
        self.windows = Windows([drive], sensor, window)

    def __len__(self) -> int:
        return len(self.windows.sequences[0]) - self.windows.length

    def __getitem__(self, frame: int) -> tuple[Tensor, Tensor]:
        batch = self.windows.__getitems__([(frame, 0, False)])
        return batch["pairs"][0], batch["motions"][0]


class PlainNetwork(nn.Module):
    """The paper's network as one would write it down: ``Conv1d``, ``LSTM``, a linear layer."""

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
        """Motions (B, T, 2) of pairs (B, T, 2, bins)."""
        features = self.encoder(pairs.flatten(0, 1) / self.max_range).flatten(1).unflatten(0, pairs.shape[:2])
        if self.lstm is None:
            return self.head(features)
        outputs, _ = self.lstm(torch.cat([features, self.first(features)], -1))
        return self.head(outputs)


def stock(case: str, outputs: str) -> float:
    """Frames a second of a plain loop: fp32, Adam as it comes, a DataLoader of single samples."""
    settings = settings_of(case, outputs)
    model, sensor = settings["model"], Sensor(**settings["data"]["sensor"])
    [drive] = experiment.build_datamodule(settings).load(("train",)).sequences["train"]
    singles = Singles(drive, model["window"], sensor)
    network = PlainNetwork(sensor, model.get("hidden_size"))
    optimizer = torch.optim.Adam(network.parameters(), model["learning_rate"])
    clock = Clock()
    while True:
        for pairs, truth in DataLoader(singles, model["batch_size"], shuffle=True, drop_last=True):
            optimizer.zero_grad()
            regression_loss(network(pairs), truth, model["beta"]).total.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            if clock.tick(truth[..., 0].numel()):
                return clock.pace


def peak(dtype: str) -> float:
    """Operations a second of matrix products, the best of some shapes."""
    best = 0.0
    for rows, inner, columns in ((2048, 2048, 2048), (4096, 4096, 4096), (1024, 14464, 4096)):
        a = torch.randn(rows, inner).to(getattr(torch, dtype))
        b = torch.randn(inner, columns).to(getattr(torch, dtype))
        for _ in range(4):
            start = time.perf_counter()
            a @ b
            best = max(best, 2 * rows * inner * columns / (time.perf_counter() - start))
    return best


def validation(case: str, outputs: str) -> float:
    """Frames a second of estimating a validation drive."""
    settings = settings_of(case, outputs)
    datamodule = experiment.build_datamodule(settings).load()
    module = experiment.build_module(settings, datamodule).eval()
    module.setup("validate")
    [drive] = datamodule.sequences["val"]
    scans = torch.from_numpy(np.array(drive.scans))
    module.estimate(scans[:200])
    start = time.perf_counter()
    module.estimate(scans)
    return (len(scans) - 1) / (time.perf_counter() - start)


def operations(case: str, outputs: str) -> float:
    """Operations for a frame, forward and backward."""
    settings = settings_of(case, outputs)
    datamodule = experiment.build_datamodule(settings).load()
    module = experiment.build_module(settings, datamodule)
    batch = next(iter(datamodule.train_dataloader()))
    with FlopCounterMode(display=False) as counter:
        estimate, _ = module.network(batch["pairs"])
        estimate.motion.sum().backward()
    return counter.get_total_flops() / batch["motions"][..., 0].numel()


def encoding(outputs: str) -> dict[str, float]:
    """Frames a second of encoding scans of a Velodyne's size from KITTI's files, and of reading the bytes."""
    folder = Path(outputs) / "velodyne"
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    azimuth = np.tile(np.linspace(0, 2 * np.pi, BEAMS, endpoint=False), RINGS)
    elevation = np.repeat(np.deg2rad(np.linspace(2, -24.8, RINGS)), BEAMS)
    for frame in range(40):
        ranges = rng.uniform(3, 70, len(azimuth))
        flat = ranges * np.cos(elevation)
        points = [flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(elevation), 0 * ranges]
        np.stack(points, 1).astype("<f4").tofile(folder / f"{frame:06d}.bin")
    paths = sorted(map(str, folder.glob("*.bin")))
    reader = kitti.RingReader(tuple(paths), 5, float(elevation[5 * BEAMS]))
    ways: dict[str, Callable[[int], object]] = {
        "reading the bytes": lambda frame: Path(paths[frame]).read_bytes(),
        "reading the ring": reader,
        "reading and encoding": lambda frame: encode(*reader(frame), Sensor()),
    }
    found = {}
    for name, way in ways.items():
        times = []
        for _ in range(3):
            start = time.perf_counter()
            for frame in range(len(paths)):
                way(frame)
            times.append(time.perf_counter() - start)
        found[name] = len(paths) / min(times)
    return found


def start_up(outputs: str) -> dict[str, float]:
    """Seconds from a command to its answer."""
    tiny = [
        "data.frames=20",
        "data.fresh_worlds=false",
        "model=cnn_reg",
        "model.epochs=1",
        f"outputs={outputs}",
    ]
    commands = {"train.py --help": ["--help"], "train.py, one epoch of two steps": [*tiny]}
    seconds = {}
    for name, options in commands.items():
        command = [sys.executable, str(ROOT / "train.py"), *options]
        times = []
        for _ in range(3):  # the first fills the cache
            start = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            times.append(time.perf_counter() - start)
        seconds[name] = min(times)
    return seconds


def alone(function: Callable[..., Any], *arguments: object) -> Any:
    """What a function returns in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


Paces = dict[str, dict[str, list[float]]]
"""Frames a second in every round, by case and way."""


def measure(outputs: str) -> tuple[Paces, dict[str, list[float]]]:
    """Paces of every case by every way, and the peaks, of all rounds."""
    default = resolve_precision("auto", "cpu")
    precisions = {"32-true": "float32", default: "bfloat16" if default == "bf16-mixed" else "float32"}
    paces: Paces = {case: {} for case in CASES}
    peaks: dict[str, list[float]] = {}
    for _ in tqdm(range(ROUNDS), desc="rounds", disable=None, leave=False):
        for dtype in dict.fromkeys(precisions.values()):
            peaks.setdefault(dtype, []).append(alone(peak, dtype))
        for case, found in paces.items():
            found.setdefault("plain loop, 32-true", []).append(alone(stock, case, outputs))
            for precision in precisions:
                found.setdefault(f"ours, {precision}", []).append(alone(ours, case, outputs, precision))
            for what in LEFT_OUT:
                if what != "our LSTM" or CASES[case][0] == "rcnn_reg":
                    pace = alone(ours, case, outputs, default, what)
                    found.setdefault(f"ours, {default}, without {what}", []).append(pace)
            found.setdefault("validation", []).append(alone(validation, case, outputs))
    return paces, peaks


def report(paces: Paces, peaks: dict[str, list[float]], operations_of: dict[str, float]) -> str:
    """Tables of medians."""
    top = {dtype: float(np.median(found)) for dtype, found in peaks.items()}
    default = f"ours, {resolve_precision('auto', 'cpu')}"
    rows = [[f"frames a second, {torch.get_num_threads()} threads", "median", "times plain", "of the peak"]]
    shares = [["an epoch of KITTI's drives", "training, s", "validation, s", "share"]]
    for case, ways in paces.items():
        pace = {way: float(np.median(found)) for way, found in ways.items()}
        validating = VALIDATION / pace.pop("validation")
        for way, frames in pace.items():
            share = frames * operations_of[case] / top["bfloat16" if "bf16" in way else "float32"]
            times = frames / pace["plain loop, 32-true"]
            rows.append([f"{case}: {way}", f"{frames:.0f}", f"{times:.2f}", f"{share:.2f}"])
        training = TRAINING / pace[default]
        shares.append([case, f"{training:.0f}", f"{validating:.1f}", f"{100 * validating / training:.0f} %"])
    peak_rows = [["matrix products, 10^9 operations a second", "median"]]
    peak_rows += [[dtype, f"{value / 1e9:.0f}"] for dtype, value in top.items()]
    return "\n\n".join(map(aligned, (rows, peak_rows, shares)))


def main() -> int:
    """Measures and prints."""
    with TemporaryDirectory() as outputs:
        operations_of = {case: alone(operations, case, outputs) for case in CASES}
        print(report(*measure(outputs), operations_of), end="\n\n")
        rows = [[f"frames of {RINGS * BEAMS:,} points, one thread", "a second"]]
        rows += [[name, f"{pace:.0f}"] for name, pace in alone(encoding, outputs).items()]
        print(aligned(rows), end="\n\n")
        rows = [["start-up", "s"]] + [[name, f"{seconds:.1f}"] for name, seconds in start_up(outputs).items()]
        print(aligned(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
