"""The measurements of ``make bench``: that they run, and what their table says."""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch

from rcnn_odom.models.rcnn import RCNNRegression
from rcnn_odom.training import bench, bench_train
from rcnn_odom.training.bench import Implementation


@pytest.mark.slow
def test_all_ways_are_measured_and_compared(monkeypatch, capsys):
    threads = torch.get_num_threads()
    for name, value in {"ROUNDS": 1, "WARM_UP": 0, "TIMED": 2, "FRAMES": 8, "HIDDEN": 32}.items():
        monkeypatch.setattr(bench, name, value)
    try:
        assert bench.main() == 0
    finally:
        torch.set_num_threads(threads)
    printed = capsys.readouterr().out
    for row in (
        "eager nn.LSTM",
        "onnx fp32",
        "onnx int8",
        "all_round",
        "half_circle",
        "matcher",
        "around the network",
        *bench.PEERS,
    ):
        assert f"\n{row} " in printed or f"{row} is left out: " in printed


def test_ratios_are_those_of_the_medians():
    times = {"read fp32 weights": 9.0, "read int8 weights": 2.0, "convolutions": 1.0, "eager nn.LSTM": 150.0}
    times |= {"onnx fp32": 13.0, "onnx int8": 4.5, "all_round": 0.8, "half_circle": 0.7}
    times |= {"around the network": 0.1, "matcher": 0.9, "kiss_icp": 1.8}
    ways = {
        name: Implementation(lambda frame: None, times=[value, value, 50.0]) for name, value in times.items()
    }
    rows = {
        line[:30].strip(): line[30:].split()[0]
        for line in bench.report(ways, bench.build(RCNNRegression)).splitlines()
        if "=" in line
    }
    assert float(rows["eager / onnx int8"]) == pytest.approx(33.3)
    assert float(rows["onnx int8 / its floor"]) == 1.5
    assert float(rows["onnx fp32 / fp32 floor"]) == 1.3
    assert float(rows["matcher / kiss_icp"]) == 0.5
    assert float(rows["all_round, ms"]) == 0.8
    assert 0.9 < float(rows["matcher, 99th percentile, ms"]) <= 50


def test_the_eager_network_is_the_same_network():
    """What is slower computes the same: with its weights copied, ``nn.LSTM`` gives the same motions."""
    network = bench.build(RCNNRegression, hidden=16)
    depths = np.random.default_rng(0).uniform(0, 70, (6, 3601)).astype(np.float32)
    step = bench.run_eager_lstm(network, depths)
    with torch.inference_mode():
        got = [step(frame).motion.flatten().numpy() for frame in range(1, 6)]
        pairs = torch.from_numpy(np.stack([depths[:-1], depths[1:]], axis=1))[None]
        expected, _ = network.motions(pairs)
    np.testing.assert_allclose(got, expected.motion[0].numpy(), atol=1e-5)


FREES_THE_FLOOR = """
import os
import numpy as np
from pathlib import Path
from rcnn_odom.models.rcnn import RCNNRegression
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.training import bench

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

network = bench.build(RCNNRegression, hidden=512)
scans = [Scan(np.full(1800, 5.0), np.linspace(-3, 3, 1800))] * 2
indoors = [Scan(np.full(181, 5.0), np.linspace(-1.5, 1.5, 181))] * 2
ways = bench.build_implementations(network, scans, indoors)
for way in ways.values():
    way.step(1)
before = resident()
floor = ways.pop("read fp32 weights")
del floor, way
print(before - resident(), sum(parameter.nbytes for parameter in network.lstm.parameters()))
"""


@pytest.mark.slow
def test_the_floor_reads_memory_that_is_there():
    """An array that was never written is one page of zeros for the system, read from the nearest cache.

    In a process of its own: after a training in the same one, freed memory is kept.
    """
    if not Path("/proc/self/statm").exists():
        pytest.skip("no /proc/self/statm on this system")
    command = [sys.executable, "-c", FREES_THE_FLOOR]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    freed, weights = map(int, done.stdout.split())
    assert freed > 0.9 * weights


def test_training_is_compared_with_a_plain_loop(monkeypatch):
    for name, value in {"SECONDS": 0.0, "WARM_UP": 1, "FRAMES": 30, "EPOCH": 600}.items():
        monkeypatch.setattr(bench_train, name, value)
    with TemporaryDirectory() as outputs:
        for model in bench_train.CASES.values():
            settings = bench_train.settings_of(model, "32-true", outputs)
            settings["data"]["sensor"]["resolution_deg"] = 1.0
            settings["model"]["batch_size"] = 2
            if "hidden_size" in settings["model"]:
                settings["model"]["hidden_size"] = 16
            assert bench_train.plain_loop(settings) > 0
            assert bench_train.ours(settings) > 0


def test_the_table_compares_medians_with_the_plain_loop():
    paces = {"CNN": {"plain loop, fp32": [90.0, 100.0, 500.0], "ours, fp32": [250.0, 240.0, 260.0]}}
    rows = [line.split() for line in bench_train.report(paces).splitlines()[1:]]
    assert [row[-2:] for row in rows] == [["100", "1.00"], ["250", "2.50"]]
