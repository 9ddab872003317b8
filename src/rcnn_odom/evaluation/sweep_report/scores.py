"""What a report reads of a ``metrics.json``, all of it at once."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

Report = dict[str, Any]
"""What a JSON file holds."""

Scores = dict[str, Any]
"""Of one run or method; None for what is not known."""

FRAME_ERRORS = ("distance_mae_m", "distance_bias_m", "heading_mae_deg", "heading_bias_deg")
"""Means over the motions of all test sequences."""
LARGEST_ERRORS = ("distance_max_m", "heading_max_deg")
"""Largest of any motion."""


@dataclass(frozen=True)
class Metrics:
    """The content of a ``metrics.json``; everything is empty for a run that is not finished.

    Attributes:
        variant: of the network, or the name of another method.
        data: name of the data.
        is_training: whether a training wrote it, and not ``evaluate.py``.
        sequences: names of the test sequences.
        lengths: of the segments of its drift, in metres.
        scores: see :func:`method_scores`; beside them ``val_drift`` (a ratio), ``latency_ms``, ``seconds`` of
            training and ``same_as``. What older runs do not tell is None.
        baselines: scores of each, by its name.
        versions: of packages, by their names.
    """

    variant: str = ""
    data: str = ""
    is_training: bool = False
    sequences: tuple[str, ...] = ()
    lengths: tuple[float, ...] = ()
    scores: Scores = field(default_factory=dict)
    baselines: dict[str, Scores] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)


def read_metrics(content: Report) -> Metrics:
    """Everything that a report needs of a ``metrics.json``.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError: it is not of that form.
    """
    test, latency, training = content["test"], content.get("latency") or {}, content.get("training") or {}
    others = {
        "val_drift": _number((content.get("val") or {}).get("drift")),
        "latency_ms": _number(latency.get("median_ms")),
        "seconds": _number(training.get("seconds")),
        "same_as": content.get("same_as"),
    }
    return Metrics(
        str(content["variant"]),
        str(content["data"]),
        "seed" in content,
        tuple(test["sequences"]),
        tuple(map(float, test["lengths"])),
        method_scores(test) | others,
        {name: method_scores(report) for name, report in content.get("baselines", {}).items()},
        {name: str(version) for name, version in (content.get("versions") or {}).items()},
    )


def method_scores(report: Report) -> Scores:
    """Scores of a method, as columns of the table of runs.

    Args:
        report: ``test`` of a ``metrics.json``, or one of its ``baselines``.

    Returns:
        ``drift`` and ``floor``, ``drift_NAME`` and ``floor_NAME`` of each sequence as ratios,
        ``rotation_deg_per_m`` (mean over sequences), and the errors of single frames in metres and degrees:
        ``*_mae_*`` and ``*_bias_*`` are means over all motions (a sequence of N frames has N-1), ``*_max_*``
        the largest. None where no segment was long enough.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError: the report is not of that form.
    """
    sequences = report["sequences"]
    scores: Scores = {}
    for kind in ("drift", "floor"):
        scores[kind] = _number(report[kind])
        scores |= {f"{kind}_{name}": _number(one[kind]["t_err"]) for name, one in sequences.items()}
    rotations = [one["drift"]["r_err_deg_per_m"] for one in sequences.values() if one["drift"]["segments"]]
    scores["rotation_deg_per_m"] = float(np.mean(rotations)) if rotations else None
    motions = [one["frames"] - 1 for one in sequences.values()]
    for key in FRAME_ERRORS:
        scores[key] = float(np.average([one[key] for one in sequences.values()], weights=motions))
    for key in LARGEST_ERRORS:
        scores[key] = max(float(one[key]) for one in sequences.values())
    return scores


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
