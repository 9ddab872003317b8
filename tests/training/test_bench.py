"""The measurements of ``make bench``: that they run, and what their table says."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from rcnn_odom.models.networks import RCNN
from rcnn_odom.training import bench
from rcnn_odom.training.bench import Way


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
        "checkpoint",
        "onnx fp32",
        "onnx int8",
        "rcnn_small",
        "icp",
        "around the network",
    ):
        assert f"\n{row} " in printed


def test_ratios_are_those_of_the_medians():
    times = {"read fp32 weights": 9.0, "read int8 weights": 2.0, "convolutions": 1.0, "eager nn.LSTM": 150.0}
    times |= {"checkpoint": 12.0, "onnx fp32": 13.0, "onnx int8": 4.5, "rcnn_small": 0.9}
    times |= {"around the network": 0.1, "icp": 4.5}
    ways = {name: Way(lambda frame: None, times=[value, value, 50.0]) for name, value in times.items()}
    rows = {
        line[:25].strip(): line[25:].split()[0]
        for line in bench.report(ways, bench.build("rcnn_reg")).splitlines()
        if "=" in line
    }
    assert float(rows["eager / onnx int8"]) == pytest.approx(33.3)
    assert float(rows["onnx int8 / its floor"]) == 1.5
    assert float(rows["checkpoint / fp32 floor"]) == 1.2
    assert float(rows["onnx fp32 / fp32 floor"]) == 1.3


def test_the_eager_network_is_the_same_network():
    """What is slower computes the same: with its weights copied, ``nn.LSTM`` gives the module's motions."""
    module = bench.build("rcnn_reg", hidden=16)
    assert isinstance(module.network, RCNN)
    depths = np.random.default_rng(0).uniform(0, 70, (6, 3601)).astype(np.float32)
    step = bench.eager(module.network, depths)
    with torch.inference_mode():
        got = [step(frame).motion.flatten().numpy() for frame in range(1, 6)]
    np.testing.assert_allclose(got, module.estimate(torch.from_numpy(depths)).motions, atol=1e-5)


def test_the_floor_reads_memory_that_is_there(monkeypatch):
    """An array that was never written is one page of zeros for the system, read from the nearest cache."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        pytest.skip(f"no {statm} on this system")

    def resident():
        return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    module = bench.build("rcnn_reg", hidden=512)
    scans = [(np.linspace(-3, 3, 1800), np.full(1800, 5.0))] * 2
    ways = bench.build_ways(module, scans)
    for way in ways.values():
        way.step(1)
    before = resident()
    floor = ways.pop("read fp32 weights")
    weights = sum(parameter.nbytes for parameter in module.network.lstm.parameters())
    del floor, way
    assert before - resident() > 0.9 * weights
