"""How long an estimator takes for a frame, one frame after the other as on a robot."""

import sys
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.models.contract import Stepper

WARM_UP = 5
"""Frames before the clock starts: memory and caches find their places."""
FRAMES = 100
"""That are measured at most."""


def measure(stepper: Stepper, scans: npt.NDArray[np.float32]) -> dict[str, Any]:
    """Median and 99th percentile of the time from an encoded scan to a step, on one thread.

    Args:
        stepper: estimates the steps.
        scans: encoded, (N, bins), at least two.

    Returns:
        ``median_ms``, ``p99_ms``, ``frames`` and ``threads``.
    """
    scans = np.array(scans[: FRAMES + 1])
    pairs = [scans[frame : frame + 2] for frame in range(len(scans) - 1)]
    torch = sys.modules.get("torch")  # A stepper that computes with it has imported it; others need it not.
    threads = torch.get_num_threads() if torch else 1
    try:
        if torch:
            torch.set_num_threads(1)
        for warm in (pairs[:WARM_UP], pairs):
            stepper.reset()
            times = [_milliseconds(stepper, pair) for pair in warm]
    finally:
        if torch:
            torch.set_num_threads(threads)
    stepper.reset()
    median, p99 = np.percentile(times, [50, 99]).tolist()
    return {"median_ms": median, "p99_ms": p99, "frames": len(pairs), "threads": 1}


def _milliseconds(stepper: Stepper, pair: npt.NDArray[np.float32]) -> float:
    start = time.perf_counter()
    stepper(pair)
    return 1e3 * (time.perf_counter() - start)
