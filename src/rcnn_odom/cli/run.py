"""`rcnn-odom run`: poses from a recording or a live laser."""

import argparse
import io
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rcnn_odom.cli.arguments import Subcommands, whole_number

if TYPE_CHECKING:
    from rcnn_odom.deployment.odometer import Odometer


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "run",
        help="poses from a recording or a live laser",
        description="Estimate the trajectory of a recording: a KITTI sequence folder, a CARMEN log, or a ROS "
        "bag with LaserScan messages (ROS 1, ROS 2 sqlite3 or mcap; no ROS needed). Writes trajectory.txt "
        "(KITTI), trajectory.tum, steps.jsonl (each step with its uncertainty), map.png and summary.json. "
        "With --live: scans as JSON lines from standard input, such as "
        '{"stamp": 1.0, "ranges": [2.5, ...], "angle_min": -3.14, "angle_increment": 0.0031}, and a pose '
        "for each on standard output.",
    )
    add = parser.add_argument
    add(
        "model",
        metavar="MODEL",
        help="an exported .onnx, a .ckpt, or rcnn_small, which ships along",
    )
    add("input", nargs="?", type=Path, metavar="INPUT", help="the recording")
    add("--live", action="store_true", help="read scans from standard input, write poses to standard output")
    add("--out", type=Path, metavar="DIR", help="folder to write to; must not hold a trajectory yet")
    add("--topic", help="of the LaserScan messages in a bag that has several")
    add("--ring", type=whole_number(0), metavar="N", help="of a KITTI sequence (the most level one)")
    add(
        "--field-of-view-deg",
        type=float,
        default=180.0,
        metavar="DEG",
        help="that the beams of a CARMEN log's FLASER lines cover (%(default)g)",
    )
    add("--threads", type=whole_number(1), default=1, metavar="N", help="of the computation (%(default)s)")
    parser.set_defaults(run=lambda arguments: _run(parser, arguments))


def _run(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    if arguments.live == (arguments.input is not None):
        parser.error("give either INPUT or --live")
    if not arguments.live and arguments.out is None:
        parser.error("--out DIR is needed")

    from rcnn_odom.deployment.run import format_summary, print_pose, run
    from rcnn_odom.recordings import json_lines
    from rcnn_odom.recordings.formats import open_stream

    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stderr)
    odometer = _load(arguments.model, arguments.threads)
    model = Path(arguments.model).stem
    if arguments.live:
        if isinstance(sys.stdin, io.TextIOWrapper):
            sys.stdin.reconfigure(errors="replace")  # bytes that are no text are a line that is no scan
        summary = run(odometer, json_lines.stream(sys.stdin), model, arguments.out, print_pose)
        print(format_summary(summary), file=sys.stderr)
        return 0
    stream = open_stream(
        arguments.input,
        topic=arguments.topic,
        ring=arguments.ring,
        field_of_view_deg=arguments.field_of_view_deg,
    )
    for note in stream.notes:
        print(f"{stream.name}: {note}")
    print(format_summary(run(odometer, stream, model, arguments.out)))
    print(f"all of it is in {arguments.out}")
    return 0


def _load(model: str, threads: int) -> "Odometer":
    from rcnn_odom.deployment.odometer import Odometer

    if not model.endswith(".ckpt"):
        return Odometer.from_onnx(model, threads=threads)
    import torch

    torch.set_num_threads(threads)
    return Odometer.from_checkpoint(model)
