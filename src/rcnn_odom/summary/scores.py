"""The numbers of one method on its test sequences, out of a ``metrics.json``."""

from typing import Any

import numpy as np

Report = dict[str, Any]
"""What a JSON file holds."""

FRAME_ERRORS = ("distance_mae_m", "distance_bias_m", "heading_mae_deg", "heading_bias_deg")
"""Means over the motions of all test sequences."""
LARGEST_ERRORS = ("distance_max_m", "heading_max_deg")
"""Largest of any motion."""


def method_scores(report: Report) -> dict[str, float | None]:
    """Scores of a method, as columns of the table of runs.

    Args:
        report: ``test`` of a ``metrics.json``, or one of its ``baselines``.

    Returns:
        ``drift``, ``drift_NAME`` of each sequence and ``floor`` as ratios, ``rotation_deg_per_m`` (mean over
        sequences), and the errors of single frames in metres and degrees: ``*_mae_*`` and ``*_bias_*``
        are means over all motions (a sequence of N frames has N-1), ``*_max_*`` the largest. None where no
        segment was long enough.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the report is not of that form.
    """
    sequences = report["sequences"]
    scores: dict[str, float | None] = {"drift": _number(report["drift"]), "floor": _number(report["floor"])}
    for name, one in sequences.items():
        scores[f"drift_{name}"] = _number(one["drift"]["t_err"])
    rotations = [one["drift"]["r_err_deg_per_m"] for one in sequences.values() if one["drift"]["segments"]]
    scores["rotation_deg_per_m"] = float(np.mean(rotations)) if rotations else None
    motions = [one["frames"] - 1 for one in sequences.values()]
    for key in FRAME_ERRORS:
        scores[key] = float(np.average([one[key] for one in sequences.values()], weights=motions))
    for key in LARGEST_ERRORS:
        scores[key] = max(float(one[key]) for one in sequences.values())
    return scores


def run_scores(metrics: Report) -> dict[str, Any]:
    """Scores of a whole ``metrics.json``: :func:`method_scores` of its test, and what else it tells.

    What older runs do not tell (latency, training) is None.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: it is not of that form.
    """
    latency, training = metrics.get("latency") or {}, metrics.get("training") or {}
    return {
        **method_scores(metrics["test"]),
        "val_drift": _number((metrics.get("val") or {}).get("drift")),
        "latency_ms": _number(latency.get("median_ms")),
        "seconds": _number(training.get("seconds")),
        "same_as": metrics.get("same_as"),
    }


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
