"""How long a scan takes on one thread, by every way of computing it: ``make bench``.

The full-size network has random weights, whose values change nothing but the share of features that are 0.
All ways take turns, so that a machine that others use as well slows down all of them alike.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from rcnn_odom.deployment.odometer import Description, Odometer
from rcnn_odom.deployment.onnx_model import OnnxStepper
from rcnn_odom.evaluation.run_report import icp_stepping
from rcnn_odom.evaluation.scores import aligned
from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.models.icp import PointToLineICP
from rcnn_odom.models.networks import RCNN
from rcnn_odom.recordings import simulated
from rcnn_odom.training.checkpoint_stepper import CheckpointStepper
from rcnn_odom.training.modules import VARIANTS, OdometryModule
from rcnn_odom.training.onnx_graph import to_onnx

ROUNDS = 8
WARM_UP, TIMED = 3, 25
"""Scans of one way in a row: the first ones bring its weights back into the caches."""
FRAMES = 60
HIDDEN = 1024
"""Width of the paper's LSTM."""
SMALL = "rcnn_small"

Step = Callable[[int], object]


@dataclass
class Way:
    """A way of computing something for frame 1, 2 ... ``FRAMES`` - 1, and its times in milliseconds."""

    step: Step
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

    @property
    def median(self) -> float:
        """Milliseconds."""
        return float(np.median(self.times))

    @property
    def p99(self) -> float:
        """Milliseconds."""
        return float(np.percentile(self.times, 99))


class Nothing:
    """A stepper without a network: what is left is the cost of everything around one."""

    description = Description(Sensor(), "end", (1.0, 0.02), 0.0, 0.1)

    def __call__(self, pair: Any) -> tuple[FloatArray, FloatArray]:
        """Always the same."""
        return np.ones(2), np.ones(2)

    def reset(self) -> None:
        """There is nothing to forget."""


def main() -> int:
    """Measures and prints."""
    torch.set_num_threads(1)
    scans = [simulated.load("05", scale="small", frames=FRAMES).read_scan(frame) for frame in range(FRAMES)]
    module = build("rcnn_reg")
    ways = build_ways(module, scans)
    with torch.inference_mode():
        for _ in tqdm(range(ROUNDS), desc="rounds", disable=None, leave=False):
            for way in ways.values():
                way.take_turn()
    print(report(ways, module))
    return 0


def build(variant: str, hidden: int | None = None) -> OdometryModule:
    """An untrained module of the paper's size, or with another width of its LSTM."""
    torch.manual_seed(0)
    model = {
        "kernel_size": 3,
        "pooling": "avg",
        "angle": "expectation",
        "dropout": 0.0,
        "rotation_classes": {"count": 112, "width_deg": 0.1},
        "hidden_size": hidden or HIDDEN,
        "layers": 2,
        "projection": None,
        "freeze": False,
    }
    return VARIANTS[variant](model, Sensor().as_dict(), {"lengths": [100.0], "apply": "end"}).eval()


def build_ways(module: OdometryModule, scans: list[tuple[FloatArray, FloatArray]]) -> dict[str, Way]:
    """Everything that is measured, by name; the longest take fewer frames."""
    assert isinstance(module.network, RCNN)
    weights = sum(parameter.numel() for parameter in module.network.lstm.parameters())
    depths = np.stack([encode(*scan, Sensor()) for scan in scans])
    graphs = {
        "onnx fp32": to_onnx(module, "fp32"),
        "onnx int8": to_onnx(module, "int8"),
        "convolutions": to_onnx(build("cnn_reg"), "fp32"),
    }
    onnx = {name: OnnxStepper(graph.SerializeToString()) for name, graph in graphs.items()}
    icp, _ = icp_stepping(PointToLineICP(Sensor()), depths)
    return {
        "read fp32 weights": Way(read(torch.ones(weights))),
        "read int8 weights": Way(read(torch.ones(weights // 4))),
        "convolutions": Way(lambda frame: onnx["convolutions"](depths[frame - 1 : frame + 1])),
        "eager nn.LSTM": Way(eager(module.network, depths), timed=3),
        "checkpoint": Way(stepping(Odometer(CheckpointStepper(module)), scans)),
        "onnx fp32": Way(stepping(Odometer(onnx["onnx fp32"]), scans)),
        "onnx int8": Way(stepping(Odometer(onnx["onnx int8"]), scans)),
        SMALL: Way(stepping(Odometer.from_onnx(SMALL), scans)),
        "around the network": Way(stepping(Odometer(Nothing()), scans)),
        "icp": Way(icp),
    }


def read(weights: Tensor) -> Step:
    """Reads all of an array once; of what was never written the system would not even give the memory."""
    return lambda _: weights.sum()


def eager(network: RCNN, depths: np.ndarray) -> Step:
    """The network as a training script would call it: convolutions, ``torch.nn.LSTM``, head."""
    lstm = nn.LSTM(network.lstm.weight_ih[0].shape[1], network.lstm.hidden, 2, batch_first=True)
    same = {name.replace(".", "_l"): value for name, value in network.lstm.state_dict().items()}
    lstm.load_state_dict(same)
    state = torch.zeros(2, 1, network.lstm.hidden), torch.zeros(2, 1, network.lstm.hidden)

    def step(frame: int) -> object:
        nonlocal state
        features = network.cnn.encode(torch.from_numpy(depths[None, None, frame - 1 : frame + 1]))
        first = network.cnn.head.standardise(network.cnn.head(features).motion)
        outputs, state = lstm(torch.cat([features, first], -1), state)
        return network.head(outputs)

    return step


def stepping(odometer: Odometer, scans: list[tuple[FloatArray, FloatArray]]) -> Step:
    """Whole steps of an odometer, from the returns of a scan to a pose."""
    odometer.step(scans[0][1], angles=scans[0][0])
    return lambda frame: odometer.step(scans[frame][1], angles=scans[frame][0])


def report(ways: dict[str, Way], module: OdometryModule) -> str:
    """A table of times, and the ratios with what is aimed at."""
    rows = [["ms a scan, one thread", "median", "99th percentile"]]
    rows += [[name, f"{way.median:.2f}", f"{way.p99:.2f}"] for name, way in ways.items()]
    time_of = {name: way.median for name, way in ways.items()}
    convolutions, eager_time = time_of["convolutions"], time_of["eager nn.LSTM"]
    fp32, int8 = (convolutions + time_of[f"read {kind} weights"] for kind in ("fp32", "int8"))
    ratios = [
        ["ratios of medians", "measured", "aim"],
        ["eager / onnx int8", f"{eager_time / time_of['onnx int8']:.1f}", ">= 33"],
        ["onnx int8 / its floor", f"{time_of['onnx int8'] / int8:.2f}", "<= 1.7"],
        ["eager / checkpoint", f"{eager_time / time_of['checkpoint']:.1f}", ">= 10"],
        ["checkpoint / fp32 floor", f"{time_of['checkpoint'] / fp32:.2f}", "<= 1.5"],
        ["onnx fp32 / fp32 floor", f"{time_of['onnx fp32'] / fp32:.2f}", "<= 1.35"],
        [f"eager / {SMALL}", f"{eager_time / time_of[SMALL]:.0f}", ""],
        [f"icp / {SMALL}", f"{time_of['icp'] / time_of[SMALL]:.1f}", ""],
        [f"{SMALL}, ms", f"{time_of[SMALL]:.2f}", "<= 1.5"],
        ["around the network, ms", f"{time_of['around the network']:.2f}", "<= 0.3"],
    ]
    assert isinstance(module.network, RCNN)
    megabytes = sum(parameter.nbytes for parameter in module.network.lstm.parameters()) / 1e6
    about = f"floor: {megabytes:.0f} MB of LSTM weights, in int8 a quarter, read once, and the convolutions"
    return "\n".join([aligned(rows), "", about, "", aligned(ratios)])


if __name__ == "__main__":
    sys.exit(main())
