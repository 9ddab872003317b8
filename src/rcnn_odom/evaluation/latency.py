"""Measures the computing time per frame of an estimator, one frame after the other as on a robot."""

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.models.contract import ScanTracker, Stepper
from rcnn_odom.models.tracking import Tracking
from rcnn_odom.recordings.scan import Scan

WARM_UP = 5
"""Frames before the measurement, which fill the caches and allocate memory."""
FRAMES = 100
"""Largest number of measured frames."""


def measure(stepper: Stepper, scans: npt.NDArray[np.float32]) -> dict[str, Any]:
    """Median and 99th percentile of the time from an encoded scan to its step, on one thread.

    Args:
        stepper: the estimator.
        scans: encoded scans (N, bins), at least two.

    Returns:
        ``median_ms`` and ``p99_ms`` in milliseconds, ``frames`` (how many were measured) and ``threads``.
    """
    scans = np.array(scans[: FRAMES + 1])
    pairs = [scans[frame : frame + 2] for frame in range(len(scans) - 1)]
    return _measure(stepper, stepper.reset, pairs)


def measure_tracker(tracker: ScanTracker, scans: Sequence[Scan]) -> dict[str, Any]:
    """The same as :func:`measure` for a model of whole scans: the time from a raw scan to its step.

    Args:
        tracker: the estimator.
        scans: raw scans, at least two.
    """
    tracking = Tracking(tracker)

    def restart() -> None:
        tracking.reset()
        tracking.step(scans[0])

    return _measure(tracking.step, restart, scans[1 : FRAMES + 1])


def _measure(
    step: Callable[[Any], object], restart: Callable[[], None], frames: Sequence[Any]
) -> dict[str, Any]:
    """Times each call of ``step``; ``restart`` resets the estimator before and after."""
    torch = sys.modules.get("torch")  # None: the estimator does not use torch, otherwise it is imported.
    threads = torch.get_num_threads() if torch else 1
    try:
        if torch:
            torch.set_num_threads(1)
        for batch in (frames[:WARM_UP], frames):
            restart()
            times = [_milliseconds(step, frame) for frame in batch]
    finally:
        if torch:
            torch.set_num_threads(threads)
    restart()
    median, p99 = np.percentile(times, [50, 99]).tolist()
    return {"median_ms": median, "p99_ms": p99, "frames": len(frames), "threads": 1}


def _milliseconds(step: Callable[[Any], object], frame: Any) -> float:
    start = time.perf_counter()
    step(frame)
    return 1e3 * (time.perf_counter() - start)
