"""Prints the drift of evaluations as tables in Markdown: ``python docs/drift_table.py FOLDER ...``.

There is a table for each folder, a row for each evaluation in it (of ``evaluate.py``, alone or in a sweep) in
the order in which they were made, and a column for each drive.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import yaml

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import METRICS
from rcnn_odom.evaluation.scores import percent
from rcnn_odom.evaluation.sweep_report.document import markdown_table

PLACES = ("model=", "run_dir=", "outputs=", "+sweeps=")
"""Options that a row does not name: where an evaluation lies, and the model, which is named without them."""


def table(folder: Path) -> str:
    """The table of one folder.

    Raises:
        InputError: there is no evaluation in the folder, or they are of different drives.
    """
    files = sorted(folder.rglob(METRICS), key=lambda path: path.stat().st_mtime_ns)
    if not files:
        raise InputError(f"{folder}: no evaluation in it, that is, no {METRICS}")
    reports = [json.loads(path.read_text("utf-8")) for path in files]
    drives = list(reports[0]["test"]["sequences"])
    for path, report in zip(files, reports, strict=True):
        if list(report["test"]["sequences"]) != drives:
            raise InputError(f"{path}: of other drives than {files[0]}; give each folder its own table")
    rows = [[label, *drifts(report)] for label, report in zip(labels(files, reports), reports, strict=True)]
    return markdown_table(["drift in %", *drives], rows)


def labels(files: list[Path], reports: list[dict[str, Any]]) -> list[str]:
    """The model of each evaluation, and the options that not all evaluations have."""
    options = [read_options(path) for path in files]
    return [
        " ".join([report["variant"], *(text for text in own if not all(text in other for other in options))])
        for report, own in zip(reports, options, strict=True)
    ]


def read_options(metrics: Path) -> list[str]:
    """The options with which an evaluation was started, as Hydra keeps them beside its metrics."""
    kept = metrics.parent / ".hydra" / "overrides.yaml"
    texts = yaml.safe_load(kept.read_text("utf-8")) if kept.exists() else []
    return [text for text in texts if not text.startswith(PLACES)]


def drifts(report: dict[str, Any]) -> list[str]:
    """The drift of each drive in percent."""
    return [percent(scores["drift"]["t_err"]) for scores in report["test"]["sequences"].values()]


def main() -> None:
    """Prints a table for each folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="a folder of evaluations")
    try:
        print("\n\n".join(table(folder) for folder in parser.parse_args().folders))
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
