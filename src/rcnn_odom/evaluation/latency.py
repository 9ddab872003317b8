"""How long an estimator takes for a frame, one frame after the other as on a robot."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

WARM_UP = 5
"""Frames before the clock starts: memory and caches find their places."""


def measure(step: Callable[[int], object], frames: int) -> dict[str, Any]:
    """Median and 99th percentile of the time of single frames, on one thread.

    Args:
        step: estimates the motion to frame 1, 2 ... ``frames``, one call each.
        frames: to measure; up to ``WARM_UP`` of them are also gone through before.

    Returns:
        ``median_ms``, ``p99_ms``, ``frames`` and ``threads``.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for frame in range(1, min(WARM_UP, frames) + 1):
            step(frame)
        times = [_timed(step, frame) for frame in range(1, frames + 1)]
    finally:
        torch.set_num_threads(threads)
    median, p99 = np.percentile(times, [50, 99]).tolist()
    return {"median_ms": median, "p99_ms": p99, "frames": frames, "threads": 1}


def _timed(step: Callable[[int], object], frame: int) -> float:
    start = time.perf_counter()
    step(frame)
    return 1e3 * (time.perf_counter() - start)
