"""Settings of the machine."""

import subprocess
import sys

import pytest
import torch

from rcnn_odom.training import machine
from rcnn_odom.training.machine import resolve_precision


@pytest.mark.parametrize(
    ("vendor", "capabilities", "expected"),
    [
        ("AuthenticAMD", {"avx512_bf16": True}, "bf16-mixed"),
        ("GenuineIntel", {"avx512_bf16": True}, "32-true"),
        ("GenuineIntel", {"avx512_bf16": True, "amx_bf16": True}, "bf16-mixed"),
        ("AuthenticAMD", {"avx2": True}, "32-true"),
        (None, {"avx512_bf16": True}, "32-true"),
    ],
)
def test_auto_precision_follows_the_processor(monkeypatch, tmp_path, vendor, capabilities, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    monkeypatch.setattr(machine, "CPU_INFO", tmp_path / "cpuinfo")
    if vendor is not None:
        (tmp_path / "cpuinfo").write_text(f"vendor_id\t: {vendor}\n")
    assert resolve_precision("auto", "cpu") == expected
    assert resolve_precision("32-true", "cpu") == "32-true"


@pytest.mark.slow
def test_freed_memory_is_kept():
    if not sys.platform.startswith("linux"):
        pytest.skip("mallopt is glibc's")
    # In a process of its own, since the setting stays. A freed buffer is reused without new page faults.
    code = """
import resource, numpy as np
from rcnn_odom.training.machine import keep_freed_memory
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10): np.ones(4_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
before = faults()
keep_freed_memory()
np.ones(4_000_000)
assert faults() < before / 5, before
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
