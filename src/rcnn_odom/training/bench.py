"""How long a scan takes on one thread, by every way of computing it: ``make bench``.

The full-size network has random weights, whose values change nothing but the share of features that are 0.
All ways take turns, so that a machine that others use as well slows down all of them alike.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from tqdm import tqdm

from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.scores import aligned
from rcnn_odom.geometry import Step
from rcnn_odom.models.cnn import CNNRegression
from rcnn_odom.models.contract import Description, Stepper, find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.pairs import PairTracker
from rcnn_odom.models.rcnn import RCNNRegression
from rcnn_odom.models.trained import TrainedModel
from rcnn_odom.recordings import simulated
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.training.benchmark.measure import one_core
from rcnn_odom.training.onnx_graph import to_onnx

ROUNDS = 8
WARM_UP, TIMED = 3, 25
"""Scans of one way in a row: the first ones bring its weights back into the caches."""
FRAMES = 1 + ROUNDS * (WARM_UP + TIMED)
"""Of the drive: it does not begin again, where whoever keeps a map would be lost."""
HIDDEN = 1024
"""Width of the paper's LSTM."""
ALL_ROUND, HALF_CIRCLE = "all_round", "half_circle"
"""The networks that ship along: on a street as everything else, and indoors."""
FINE_SICK = {"kind": "sick", "spacing_deg": 0.5}
"""361 beams over 180 degrees."""
MATCHER, KISS = "matcher", "kiss_icp"
PEERS = {KISS: 1.0, "genz_icp": 0.5, "small_gicp": 0.25, "karto": 0.1}
"""Matchers of other projects, and their voxels on streets in metres, chosen as docs/benchmark.md says."""
Trained = TypeVar("Trained", bound=TrainedModel)

Compute = Callable[[int], object]
"""What is measured: something for one frame."""
OPTIONS = {
    "kernel_size": 3,
    "pooling": "avg",
    "angle": "expectation",
    "dropout": 0.0,
    "rotation_classes": {"count": 112, "width_deg": 0.1},
    "apply": "end",
    "layers": 2,
    "projection": None,
    "freeze": False,
}
"""Of the paper's networks, beside their width."""


@dataclass
class Way:
    """A way of computing something for frame 1, 2 ... ``FRAMES`` - 1, and its times in milliseconds."""

    step: Compute
    timed: int = TIMED
    times: list[float] = field(default_factory=list)
    _next: int = 0

    def take_turn(self) -> None:
        """Measures some frames in a row, going on where the last turn ended."""
        for number in range(WARM_UP + self.timed):
            frame = 1 + self._next % (FRAMES - 1)
            self._next += 1
            start = time.perf_counter()
            self.step(frame)
            if number >= WARM_UP:
                self.times.append(1e3 * (time.perf_counter() - start))

    def percentile(self, percent: float) -> float:
        """Milliseconds within which so many of the times lie."""
        return float(np.percentile(self.times, percent))


class Nothing:
    """A stepper without a network: what is left is the cost of everything around one."""

    description = Description(Sensor(), (1.0, 0.02, 0.02), 0.0, 0.1)

    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """Always the same."""
        return Step(1.0, 0.0, 1.0)

    def reset(self) -> None:
        """There is nothing to forget."""


def main() -> int:
    """Measures and prints."""
    torch.set_num_threads(1)
    network = build(RCNNRegression)
    with torch.inference_mode(), one_core():
        ways = build_ways(network, read_drive("street"), read_drive("indoor", FINE_SICK))
        for _ in tqdm(range(ROUNDS), desc="rounds", disable=None, leave=False):
            for way in ways.values():
                way.take_turn()
    print(report(ways, network))
    return 0


def read_drive(world: simulated.World, laser: dict[str, Any] | None = None) -> list[Scan]:
    """Scans of a simulated drive, as they come from the world's usual laser or from another one."""
    drive = simulated.load("05", world=world, scale="small", frames=FRAMES, laser=laser)
    return [drive.read_scan(frame) for frame in range(FRAMES)]


def build(model: type[Trained], hidden: int | None = None) -> Trained:
    """An untrained network of the paper's size, or with another width of its LSTM."""
    torch.manual_seed(0)
    return model(OPTIONS | {"hidden_size": hidden or HIDDEN}, Sensor()).eval()


def build_ways(network: RCNNRegression, scans: list[Scan], indoors: list[Scan]) -> dict[str, Way]:
    """Everything that is measured, by name; the longest take fewer frames.

    Args:
        network: of the paper's size.
        scans: of a laser that turns all round, for all but ``HALF_CIRCLE``.
        indoors: of one that sees half of the circle.
    """
    weights = sum(parameter.numel() for parameter in network.lstm.parameters())
    depths = np.stack([Sensor().encode(scan) for scan in scans])
    return {
        "read fp32 weights": Way(read(torch.ones(weights))),
        "read int8 weights": Way(read(torch.ones(weights // 4))),
        "convolutions": Way(alone(onnx(build(CNNRegression), "fp32"), depths)),
        "eager nn.LSTM": Way(eager(network, depths), timed=3),
        "onnx fp32": Way(stepping(Odometer(PairTracker(onnx(network, "fp32"))), scans)),
        "onnx int8": Way(stepping(Odometer(PairTracker(onnx(network, "int8"))), scans)),
        ALL_ROUND: Way(stepping(Odometer.from_onnx(ALL_ROUND), scans)),
        HALF_CIRCLE: Way(stepping(Odometer.from_onnx(HALF_CIRCLE), indoors)),
        "around the network": Way(stepping(Odometer(PairTracker(Nothing())), scans)),
        MATCHER: Way(stepping(Odometer(), scans)),
        **peers(scans),
    }


def peers(scans: list[Scan]) -> dict[str, Way]:
    """Whole steps of matchers of other projects; says which are not installed."""
    ways = {}
    for name, voxel in PEERS.items():
        try:
            tracker = find_model(name)({"voxel": voxel}, Sensor()).tracker()
        except InputError as error:
            print(f"{name} is left out: {error}")
            continue
        ways[name] = Way(stepping(Odometer(tracker), scans))
    return ways


def onnx(network: TrainedModel, precision: str) -> OnnxStepper:
    """A network as it is exported."""
    return OnnxStepper(to_onnx(network, precision).SerializeToString())


def read(weights: Tensor) -> Compute:
    """Reads all of an array once; of what was never written the system would not even give the memory."""
    return lambda _: weights.sum()


def alone(stepper: Stepper, depths: npt.NDArray[np.float32]) -> Compute:
    """A stepper without an odometer around it."""
    return lambda frame: stepper(depths[frame - 1 : frame + 1])


def eager(network: RCNNRegression, depths: npt.NDArray[np.float32]) -> Compute:
    """The network as a training script would call it: convolutions, ``torch.nn.LSTM``, head."""
    lstm = nn.LSTM(network.lstm.weight_ih[0].shape[1], network.lstm.hidden, 2, batch_first=True)
    same = {name.replace(".", "_l"): value for name, value in network.lstm.state_dict().items()}
    lstm.load_state_dict(same)
    state = torch.zeros(2, 1, network.lstm.hidden), torch.zeros(2, 1, network.lstm.hidden)

    def step(frame: int) -> object:
        nonlocal state
        features = network.cnn.encoder(torch.from_numpy(depths[None, None, frame - 1 : frame + 1]))
        first = network.cnn.head.standardise(network.cnn.head(features).motion)
        outputs, state = lstm(torch.cat([features, first], -1), state)
        return network.head(outputs)

    return step


def stepping(odometer: Odometer, scans: list[Scan]) -> Compute:
    """Whole steps of an odometer, from the returns of a scan to a pose."""
    odometer.step(scans[0])
    return lambda frame: odometer.step(scans[frame])


def report(ways: dict[str, Way], network: RCNNRegression) -> str:
    """A table of times, and the ratios with what is aimed at."""
    rows = [["ms a scan, one thread", "median", "99th percentile"]]
    rows += [[name, *(f"{way.percentile(each):.2f}" for each in (50, 99))] for name, way in ways.items()]
    time_of = {name: way.percentile(50) for name, way in ways.items()}
    convolutions, eager_time = time_of["convolutions"], time_of["eager nn.LSTM"]
    fp32, int8 = (convolutions + time_of[f"read {kind} weights"] for kind in ("fp32", "int8"))
    ratios = [
        ["ratios of medians", "measured", "aim"],
        ["eager / onnx int8", f"{eager_time / time_of['onnx int8']:.1f}", ">= 33"],
        ["onnx int8 / its floor", f"{time_of['onnx int8'] / int8:.2f}", "<= 1.7"],
        ["onnx fp32 / fp32 floor", f"{time_of['onnx fp32'] / fp32:.2f}", "<= 1.35"],
        [f"{ALL_ROUND}, ms", f"{time_of[ALL_ROUND]:.2f}", "<= 1.0"],
        ["around the network, ms", f"{time_of['around the network']:.2f}", "<= 0.3"],
        [f"{MATCHER}, ms", f"{time_of[MATCHER]:.2f}", "<= 1.0"],
        [f"{MATCHER}, 99th percentile, ms", f"{ways[MATCHER].percentile(99):.2f}", "<= 2.5"],
    ]
    if KISS in ways:
        ratios.append([f"{MATCHER} / {KISS}", f"{time_of[MATCHER] / time_of[KISS]:.2f}", "<= 0.6"])
    megabytes = sum(parameter.nbytes for parameter in network.lstm.parameters()) / 1e6
    about = f"floor: {megabytes:.0f} MB of LSTM weights, in int8 a quarter, read once, and the convolutions"
    return "\n".join([aligned(rows), "", about, "", aligned(ratios)])


if __name__ == "__main__":
    sys.exit(main())
