"""The command `rcnn-odom report`: compares the runs of a sweep."""

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
        description="Write report.md, report.html and report_figures into a folder of runs. The report "
        "contains the drift and other metrics of each setting over seeds, tests of the differences between "
        "settings, the results of the paper, figures, training times and commands. Unfinished runs are "
        "listed and left out of all means.",
    )
    parser.add_argument(
        "directory", type=Path, metavar="DIR", help="outputs/SWEEP, or any folder that contains runs"
    )
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="take only runs with this value, for instance data.scale=full; can be repeated",
    )
    parser.add_argument(
        "--reference",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="compare the others with this setting, for instance model.kernel_size=3; can be repeated "
        "(default: the setting of the paper, otherwise the first)",
    )
    parser.add_argument(
        "--json",
        action="store_true",
        help="print the runs and the comparisons as JSON; the files are also written",
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
        print(
            f"runs that did not finish: {written.unfinished}; the report lists them, no mean contains them\n"
        )
    print(f"{shlex.quote(str(written.markdown))}\n{shlex.quote(str(written.html))}")
    return 0
