"""`rcnn-odom report`: what differs between the runs of a sweep."""

import argparse
import json
import shlex
from pathlib import Path

from rcnn_odom.cli.arguments import Subcommands


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "report",
        help="compare the runs of a sweep: tables, differences with intervals, figures",
        description="Writes report.md, report.html and report_figures into a folder of runs: drift and "
        "other metrics by setting over seeds, which differences are shown and which are not, the paper's "
        "figures, curves, trajectories, times and commands. Runs that are not finished are named, and in "
        "no mean.",
    )
    parser.add_argument(
        "directory", type=Path, metavar="DIR", help="outputs/SWEEP, or any folder around runs"
    )
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="take only runs with this option, such as data.scale=full; can be repeated",
    )
    parser.add_argument(
        "--reference",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="compare with this setting, such as model.kernel_size=3; can be repeated (without it: the "
        "paper's choice, else the first)",
    )
    parser.add_argument(
        "--json",
        action="store_true",
        help="print the runs and the comparisons as JSON; the files are written as well",
    )
    parser.set_defaults(run=_run_report)


def _run_report(arguments: argparse.Namespace) -> int:
    from rcnn_odom.evaluation.sweep_report.build import make_report
    from rcnn_odom.training.sweep import expected_folders

    expected = expected_folders(arguments.directory)
    written = make_report(arguments.directory, arguments.only, arguments.reference, expected)
    if arguments.json:
        print(json.dumps(written.content, indent=1))
        return 0
    print(f"{written.table}\n")
    if written.unfinished:
        print(f"not finished, and in no mean: {written.unfinished}; the report begins with their list\n")
    print(f"{shlex.quote(str(written.markdown))}\n{shlex.quote(str(written.html))}")
    return 0
