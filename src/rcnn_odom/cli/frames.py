"""The command `rcnn-odom frames`: errors of the single frames of a drive."""

import argparse
import json
from pathlib import Path

from rcnn_odom.cli.arguments import Subcommands
from rcnn_odom.errors import InputError


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "frames",
        help="print the errors of the single frames of a drive",
        description="Print the errors of distance and heading per frame against the ground truth, the errors "
        "of distance against the smoothed true distance (without the jitter of a GPS), and the error of the "
        "end point of the composed motions.",
    )
    parser.add_argument("motions", type=Path, metavar="MOTIONS.csv", help="RUN/trajectories/*_motions.csv")
    parser.add_argument(
        "--frames",
        type=_parse_frames,
        metavar="FIRST:LAST",
        help="only these frames, first and last included, for instance 20:39; frame n is the motion from "
        "scan n-1 to scan n",
    )
    parser.add_argument(
        "--apply",
        choices=["start", "middle", "end"],
        default="end",
        help="where along its turn a step is applied (default: %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON; end_ratio is a ratio, not percent")
    parser.set_defaults(run=_run_frames)


def _parse_frames(text: str) -> tuple[int, int]:
    first, _, last = text.partition(":")
    if not (first.isdecimal() and last.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a range of frames such as 20:39")
    if int(first) > int(last):
        raise argparse.ArgumentTypeError(f"{text!r} is empty: its last frame comes before its first")
    return int(first), int(last)


def _run_frames(arguments: argparse.Namespace) -> int:
    from rcnn_odom.evaluation.scores import frame_table, stretch_errors
    from rcnn_odom.recordings.trajectory import read_motions

    truth, estimates = read_motions(arguments.motions)
    first, last = arguments.frames or (1, len(truth))
    if first < 1 or last > len(truth):
        raise InputError(
            f"{arguments.motions}: --frames {first}:{last} is outside of the drive, "
            f"which has {len(truth)} frames: 1:{len(truth)}"
        )
    chosen = slice(first - 1, last)
    reports = {
        method: stretch_errors(motions, truth, chosen, arguments.apply)
        for method, motions in estimates.items()
    }
    if arguments.json:
        print(json.dumps({"frames": [first, last], "apply": arguments.apply, "methods": reports}, indent=2))
        return 0
    path = reports["estimate"]["path_m"]
    print(f"frames {first} to {last} of {len(truth)}, a path of {path:.2f} m\n\n{frame_table(reports)}")
    return 0
