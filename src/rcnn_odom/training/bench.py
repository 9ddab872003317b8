"""Measures the computing time of a scan on one thread, for several implementations: ``make bench``.

The full-size network has random weights; their values only affect the share of features that are 0. The
implementations take turns, so that other programs on the machine slow down all of them alike.
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
"""Consecutive scans of one implementation; the first ones load its weights into the caches."""
FRAMES = 1 + ROUNDS * (WARM_UP + TIMED)
"""Frames of the drive; enough for all rounds, since a restart would confuse methods with a map."""
HIDDEN = 1024
"""Hidden size of the paper's LSTM."""
ALL_ROUND, HALF_CIRCLE = "all_round", "half_circle"
"""The shipped networks; the first is measured on a street like all others, the second indoors."""
FINE_SICK = {"kind": "sick", "spacing_deg": 0.5}
"""A laser with 361 beams over 180 degrees."""
MATCHER, KISS = "matcher", "kiss_icp"
PEERS = {KISS: 1.0, "genz_icp": 0.5, "small_gicp": 0.25, "karto": 0.1}
"""Matchers of other projects, and their voxel sizes on streets in metres; see docs/benchmark.md."""
Trained = TypeVar("Trained", bound=TrainedModel)

ComputeFrame = Callable[[int], object]
"""The measured function; its argument is the number of the frame."""
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
"""Options of the paper's networks, without the hidden size."""


@dataclass
class Implementation:
    """A measured implementation.

    Attributes:
        step: computes frame 1, 2 ... ``FRAMES`` - 1.
        timed: number of timed frames in each turn.
        times: the measured times in milliseconds.
    """

    step: ComputeFrame
    timed: int = TIMED
    times: list[float] = field(default_factory=list)
    _next: int = 0

    def take_turn(self) -> None:
        """Measures some consecutive frames after those of the previous turn."""
        for number in range(WARM_UP + self.timed):
            frame = 1 + self._next % (FRAMES - 1)
            self._next += 1
            start = time.perf_counter()
            self.step(frame)
            if number >= WARM_UP:
                self.times.append(1e3 * (time.perf_counter() - start))

    def percentile(self, percent: float) -> float:
        """A percentile of the times in milliseconds."""
        return float(np.percentile(self.times, percent))


class ConstantStepper:
    """A stepper without a network, to measure the time of everything else."""

    description = Description(Sensor(), (1.0, 0.02, 0.02), 0.0, 0.1)

    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """Returns a constant step."""
        return Step(1.0, 0.0, 1.0)

    def reset(self) -> None:
        """Does nothing, since there is no state."""


def main() -> int:
    """Measures all implementations and prints the table."""
    torch.set_num_threads(1)
    network = build(RCNNRegression)
    with torch.inference_mode(), one_core():
        implementations = build_implementations(
            network, read_drive("street"), read_drive("indoor", FINE_SICK)
        )
        for _ in tqdm(range(ROUNDS), desc="rounds", disable=None, leave=False):
            for implementation in implementations.values():
                implementation.take_turn()
    print(report(implementations, network))
    return 0


def read_drive(world: simulated.World, laser: dict[str, Any] | None = None) -> list[Scan]:
    """Reads the scans of a simulated drive, from the default laser of the world or from the given one."""
    drive = simulated.load("05", world=world, scale="small", frames=FRAMES, laser=laser)
    return [drive.read_scan(frame) for frame in range(FRAMES)]


def build(model: type[Trained], hidden: int | None = None) -> Trained:
    """Builds an untrained network of the paper's size, or with another hidden size."""
    torch.manual_seed(0)
    return model(OPTIONS | {"hidden_size": hidden or HIDDEN}, Sensor()).eval()


def build_implementations(
    network: RCNNRegression, scans: list[Scan], indoors: list[Scan]
) -> dict[str, Implementation]:
    """All measured implementations by name; the slowest one is measured on fewer frames.

    Args:
        network: a network of the paper's size.
        scans: scans with a field of view of 360 degrees, for all but ``HALF_CIRCLE``.
        indoors: scans with a field of view of 180 degrees.
    """
    weights = sum(parameter.numel() for parameter in network.lstm.parameters())
    depths = np.stack([Sensor().encode(scan) for scan in scans])
    return {
        "read fp32 weights": Implementation(read_weights(torch.ones(weights))),
        "read int8 weights": Implementation(read_weights(torch.ones(weights // 4))),
        "convolutions": Implementation(run_stepper(export_network(build(CNNRegression), "fp32"), depths)),
        "eager nn.LSTM": Implementation(run_eager_lstm(network, depths), timed=3),
        "onnx fp32": Implementation(
            run_odometer(Odometer(PairTracker(export_network(network, "fp32"))), scans)
        ),
        "onnx int8": Implementation(
            run_odometer(Odometer(PairTracker(export_network(network, "int8"))), scans)
        ),
        ALL_ROUND: Implementation(run_odometer(Odometer.from_onnx(ALL_ROUND), scans)),
        HALF_CIRCLE: Implementation(run_odometer(Odometer.from_onnx(HALF_CIRCLE), indoors)),
        "around the network": Implementation(run_odometer(Odometer(PairTracker(ConstantStepper())), scans)),
        MATCHER: Implementation(run_odometer(Odometer(), scans)),
        **build_peers(scans),
    }


def build_peers(scans: list[Scan]) -> dict[str, Implementation]:
    """Matchers of other projects; prints which ones are not installed."""
    implementations = {}
    for name, voxel in PEERS.items():
        try:
            tracker = find_model(name)({"voxel": voxel}, Sensor()).tracker()
        except InputError as error:
            print(f"{name} is left out: {error}")
            continue
        implementations[name] = Implementation(run_odometer(Odometer(tracker), scans))
    return implementations


def export_network(network: TrainedModel, precision: str) -> OnnxStepper:
    """Exports a network."""
    return OnnxStepper(to_onnx(network, precision).SerializeToString())


def read_weights(weights: Tensor) -> ComputeFrame:
    """Reads a whole array once. An array that was never written would have no memory yet."""
    return lambda _: weights.sum()


def run_stepper(stepper: Stepper, depths: npt.NDArray[np.float32]) -> ComputeFrame:
    """Runs a stepper without an odometer."""
    return lambda frame: stepper(depths[frame - 1 : frame + 1])


def run_eager_lstm(network: RCNNRegression, depths: npt.NDArray[np.float32]) -> ComputeFrame:
    """Runs the network as in a usual training script: convolutions, ``torch.nn.LSTM``, head."""
    lstm = nn.LSTM(network.lstm.weight_ih[0].shape[1], network.lstm.hidden, 2, batch_first=True)
    weights = {name.replace(".", "_l"): value for name, value in network.lstm.state_dict().items()}
    lstm.load_state_dict(weights)
    state = torch.zeros(2, 1, network.lstm.hidden), torch.zeros(2, 1, network.lstm.hidden)

    def step(frame: int) -> object:
        nonlocal state
        features = network.cnn.encoder(torch.from_numpy(depths[None, None, frame - 1 : frame + 1]))
        first = network.cnn.head.standardise(network.cnn.head(features).motion)
        outputs, state = lstm(torch.cat([features, first], -1), state)
        return network.head(outputs)

    return step


def run_odometer(odometer: Odometer, scans: list[Scan]) -> ComputeFrame:
    """Runs complete steps of an odometer, from a scan to a pose."""
    odometer.step(scans[0])
    return lambda frame: odometer.step(scans[frame])


def report(implementations: dict[str, Implementation], network: RCNNRegression) -> str:
    """Formats a table of times, and a table of ratios with their targets."""
    rows = [["ms a scan, one thread", "median", "99th percentile"]]
    rows += [
        [name, *(f"{implementation.percentile(each):.2f}" for each in (50, 99))]
        for name, implementation in implementations.items()
    ]
    time_of = {name: implementation.percentile(50) for name, implementation in implementations.items()}
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
        [f"{MATCHER}, 99th percentile, ms", f"{implementations[MATCHER].percentile(99):.2f}", "<= 2.5"],
    ]
    if KISS in implementations:
        ratios.append([f"{MATCHER} / {KISS}", f"{time_of[MATCHER] / time_of[KISS]:.2f}", "<= 0.6"])
    megabytes = sum(parameter.nbytes for parameter in network.lstm.parameters()) / 1e6
    explanation = (
        f"floor: {megabytes:.0f} MB of LSTM weights, in int8 a quarter, read once, and the convolutions"
    )
    return "\n".join([aligned(rows), "", explanation, "", aligned(ratios)])


if __name__ == "__main__":
    sys.exit(main())
