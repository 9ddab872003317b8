"""`rcnn-odom run`: poses from a recording or a live laser."""

import argparse
import io
import json
import logging
import math
import shlex
import sys
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rcnn_odom.cli.arguments import (
    Subcommands,
    degrees,
    height,
    laser_pose,
    split_thinning,
    whole_number,
)
from rcnn_odom.cli.full import need_full
from rcnn_odom.errors import InputError

if TYPE_CHECKING:
    from rcnn_odom.deployment.odometer import Pose
    from rcnn_odom.deployment.output import Output
    from rcnn_odom.models.contract import ScanTracker
    from rcnn_odom.recordings.stream import ScanStream

MATCHER, FUSED, OLD_NAME = "matcher", "fused", "icp"
FORMAT_OPTIONS = ("topic", "ring", "height", "field_of_view_deg", "base", "odom_topic")
"""Options that are a format's own."""
FILE_OPTIONS = (*FORMAT_OPTIONS[1:], "wheels")
"""Those of recordings alone."""
WHEEL_OPTIONS, MATCHER_OPTIONS, NETWORK_OPTIONS = ("wheels", "odom_topic"), ("deskew",), ("threads",)
"""Those that only scan matching alone has, those that scan matching has, and those that a network has."""
FIRST_SCANS = 100
"""In which the wheels must have been heard of."""


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "run",
        help="poses from a recording or a live laser",
        description="Estimate the trajectory of any 2D laser by scan matching, or with --model by a trained "
        "network, from a recording: a folder of a KITTI sequence or of a KITTI raw "
        "drive, a CARMEN log, a ROS bag with LaserScan or PointCloud2 messages (ROS 1, ROS 2 sqlite3 or "
        "mcap; no ROS needed), or a file of JSON lines; packed ones too. Writes trajectory.txt "
        "(KITTI), trajectory.tum, steps.jsonl (each step with its uncertainty), summary.json and "
        "report.html, which is made to be looked at. "
        "With --live: scans as JSON lines from standard input, such as "
        '{"stamp": 1.0, "ranges": [2.5, ...], "angle_min": -3.14, "angle_increment": 0.0031}, and a pose '
        "for each on standard output.",
    )
    add = parser.add_argument
    add("paths", nargs="*", metavar="INPUT", help="the recording; INPUT[::3] takes every third scan of it")
    add("--out", type=Path, metavar="DIR", help="folder to write to; must not hold a trajectory yet")
    add("--live", action="store_true", help="read scans from standard input, write poses to standard output")
    add(
        "--model",
        metavar="MODEL",
        help="matcher (scan matching, the default), an exported .onnx, a .ckpt, or all_round or "
        "half_circle, which ship along; or fused: scan matching with a network's steps as its priors",
    )
    add(
        "--network",
        metavar="NETWORK",
        help="of --model fused: an exported .onnx, a network that ships along (all_round), or held",
    )
    add("--every", type=whole_number(1), metavar="N", help="take every N-th scan only")
    _add_outputs(parser)
    _add_poses_and_priors(parser)
    _add_format_options(parser)
    add("--threads", type=whole_number(1), metavar="N", help="of a network's computation (1)")
    parser.set_defaults(run=lambda arguments: _run(parser, arguments))


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--mcap",
        type=Path,
        metavar="FILE.mcap",
        help="write odometry, path, scans, local map and transforms as messages of ROS 2, for Foxglove or "
        "ros2 bag",
    )
    add("--rerun", type=Path, metavar="FILE.rrd", help="write the same for rerun's viewer (the extra view)")
    add("--view", action="store_true", help="open rerun's viewer while the run goes (the extra view)")


def _add_poses_and_priors(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--laser-pose",
        type=laser_pose,
        metavar="X Y HEADING",
        help="where the laser sits on the robot, upright, in metres, metres and degrees: gives the robot's "
        "poses",
    )
    add("--base", metavar="FRAME", help="the robot's frame, base_link: its poses, by a bag's /tf_static")
    add("--wheels", action="store_true", help="the odometry in a log helps the matcher")
    add("--odom-topic", metavar="TOPIC", help="the odometry of this topic of a bag helps the matcher")
    add(
        "--deskew",
        choices=("auto", "on", "off"),
        help="take the motion within a scan out of it (auto: on unless the recording has done it)",
    )


def _add_format_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--topic", help="of the messages in a bag, or in JSON lines of rosbridge, that has several")
    add("--ring", type=whole_number(0), metavar="N", help="of KITTI or a point cloud (the most level one)")
    add("--height", type=height, metavar="LOW:HIGH", help="metres: cuts a slice of a point cloud, not a ring")
    add(
        "--field-of-view-deg",
        type=degrees,
        metavar="DEG",
        help="that the beams of a CARMEN log's FLASER lines cover (what the log says, or 180)",
    )


def _run(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    _check(parser, arguments)
    outputs = _make_outputs(arguments)
    from rcnn_odom.deployment.odometer import Odometer
    from rcnn_odom.deployment.run import PAGE, run
    from rcnn_odom.deployment.three_lines import format_lines

    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stderr)
    model = arguments.model or MATCHER
    network = None if model in (MATCHER, FUSED) else _load_network(model, arguments.threads or 1)
    stream = _open(parser, arguments)
    odometer = Odometer(
        network or _build_matcher(arguments, stream), arguments.laser_pose or stream.laser_pose
    )
    if not arguments.live:
        for note in stream.notes:
            print(f"{stream.name}: {note}")
    on_pose = _print_pose if arguments.live else None
    name, settings = Path(model).stem, _settings(arguments)
    summary = run(odometer, stream, name, arguments.out, on_pose, settings, outputs)
    page = arguments.out / PAGE if arguments.out else None
    # What answers a live laser is poses alone.
    print(format_lines(summary, page), file=sys.stderr if arguments.live else sys.stdout)
    return 0


def _make_outputs(arguments: argparse.Namespace) -> "list[Output]":
    """What takes the poses beside the folder; each says at once whether it can.

    Raises:
        InputError: one cannot.
    """
    outputs: list[Output] = []
    if arguments.mcap:
        from rcnn_odom.deployment.mcap_log import McapLog

        outputs.append(McapLog(arguments.mcap, (arguments.base or "base_link").lstrip("/")))
    if arguments.rerun:
        from rcnn_odom.deployment.rerun_log import RerunFile

        outputs.append(RerunFile(arguments.rerun))
    if arguments.view:
        from rcnn_odom.deployment.rerun_log import RerunViewer

        outputs.append(RerunViewer())
    return outputs


def _settings(arguments: argparse.Namespace) -> dict[str, str]:
    """The options that were given, for the report."""
    given = {
        _option(name): " ".join(_as_words(name, value)) or "yes"
        for name, value in vars(arguments).items()
        if name not in ("paths", "out", "run") and value not in (None, False)
    }
    return {"INPUT": " ".join(arguments.paths), **given} if arguments.paths else given


def _check(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Refuses what does not go together.

    Raises:
        InputError: the model comes before the recording, or has the name, that it had in earlier versions.
    """
    _refuse_old_order(arguments)
    if arguments.model == OLD_NAME:
        raise InputError(f"--model {OLD_NAME} has become --model {MATCHER}, the default; leave --model out")
    if len(arguments.paths) != (0 if arguments.live else 1):
        parser.error("give one INPUT or --live")
    if not (arguments.live or arguments.out or arguments.mcap or arguments.rerun or arguments.view):
        parser.error("--out DIR is needed, or --mcap, --rerun or --view")
    if arguments.base and arguments.laser_pose:
        parser.error("--base and --laser-pose say the same; give one of them")
    if arguments.wheels and arguments.odom_topic:
        parser.error("--wheels and --odom-topic are two odometries; give one of them")
    is_matcher, is_fused = arguments.model in (None, MATCHER), arguments.model == FUSED
    for names, is_refused, why in (
        (FILE_OPTIONS, arguments.live, "is of recordings, not of --live"),
        (WHEEL_OPTIONS, is_fused, "is of the matcher alone, not of --model fused, whose prior is a network"),
        (("network",), not is_fused, "is of --model fused"),
        (
            WHEEL_OPTIONS + MATCHER_OPTIONS,
            not (is_matcher or is_fused),
            "is of the matcher, not of a network",
        ),
        (NETWORK_OPTIONS, is_matcher, "is of a network (--model), not of the matcher"),
    ):
        for name in names:
            if is_refused and getattr(arguments, name) not in (None, False):
                parser.error(f"{_option(name)} {why}")


def _refuse_old_order(arguments: argparse.Namespace) -> None:
    """Answers ``run MODEL INPUT`` and ``run MODEL --live`` with what they have become."""
    paths = arguments.paths
    if arguments.model or len(paths) != (1 if arguments.live else 2):
        return
    from rcnn_odom.deployment.shipped import shipped_models

    model = paths[0]
    if not (model.endswith((".onnx", ".ckpt")) or model in (MATCHER, *shipped_models())):
        return
    words = ["rcnn-odom", "run", *paths[1:], "--model", model]
    for name, value in vars(arguments).items():
        if name not in ("paths", "model", "run") and value not in (None, False):
            words += [_option(name), *_as_words(name, value)]
    raise InputError(f"the recording comes first, and the model is an option: {shlex.join(words)}")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _as_words(name: str, value: Any) -> list[str]:
    """An option's value as it is written on the command line."""
    if name == "laser_pose":
        x, y, heading = value
        return [f"{x:g}", f"{y:g}", f"{math.degrees(heading):g}"]
    if name == "height":
        return [":".join(f"{each:g}" for each in value)]
    return [] if value is True else [str(value)]


def _open(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> "ScanStream":
    """The scans that are asked for.

    Raises:
        InputError: there is no such recording, or it lacks what an option asks for.
    """
    from rcnn_odom.recordings import json_lines
    from rcnn_odom.recordings.formats import open_stream
    from rcnn_odom.recordings.stream import thin

    if arguments.live:
        stream = _assume_turns(arguments, json_lines.stream_lines(_read_live(), topic=arguments.topic))
        return thin(stream, arguments.every or 1)
    path, every = split_thinning(arguments.paths[0])
    if every and arguments.every:
        parser.error(f"--every and [::{every}] say the same; give one of them")
    options = {name: getattr(arguments, name) for name in FORMAT_OPTIONS}
    if arguments.odom_topic:
        options["laser_pose"] = arguments.laser_pose  # by which the odometry is carried over to the laser
    stream = _assume_turns(arguments, open_stream(path, options))
    if arguments.wheels or arguments.odom_topic:
        stream = _need_wheels(stream, "--wheels" if arguments.wheels else "--odom-topic")
    return thin(stream, every or arguments.every or 1)


def _assume_turns(arguments: argparse.Namespace, stream: "ScanStream") -> "ScanStream":
    """With ``--deskew on`` also beams have times of which only the time of a turn is known."""
    from rcnn_odom.recordings.laser_scan import assume_even_turn

    return replace(stream, scans=map(assume_even_turn, stream.scans)) if arguments.deskew == "on" else stream


def _need_wheels(stream: "ScanStream", option: str) -> "ScanStream":
    """The same stream, after a look whether its first scans come with the robot's own odometry.

    Raises:
        InputError: they do not.
    """
    first = list(islice(stream.scans, FIRST_SCANS))
    if first and not any(scan.wheel_pose for scan in first):
        advice = f"leave {option} out" + (
            "; of a bag, name its topic: --odom-topic" if option == "--wheels" else ""
        )
        raise InputError(f"{stream.name}: has no odometry of the robot with its scans; {advice}")
    return replace(stream, scans=chain(first, stream.scans))


def _read_live() -> Iterable[str]:
    """The lines of standard input.

    Raises:
        InputError: there is none.
    """
    if sys.stdin is None:
        raise InputError("standard input is closed; --live reads scans from it")
    if isinstance(sys.stdin, io.TextIOWrapper):
        # Bytes that are no text are a line that is no scan.
        sys.stdin.reconfigure(encoding="utf-8", errors="replace")
    return sys.stdin


def _print_pose(pose: "Pose") -> None:
    print(json.dumps(pose.as_dict()), flush=True)


def _build_matcher(arguments: argparse.Namespace, stream: "ScanStream") -> "ScanTracker":
    from rcnn_odom.models.matcher import MatcherTracker
    from rcnn_odom.recordings.recording import wants_deskew

    deskew = wants_deskew(arguments.deskew or "auto", stream.is_compensated)
    if arguments.model == FUSED:
        from rcnn_odom.models.fused import FusedOptions, fused_tracker

        return fused_tracker(arguments.network or FusedOptions.network, deskew, arguments.threads or 1)
    return MatcherTracker(wheels=bool(arguments.wheels or arguments.odom_topic), deskew=deskew)


def _load_network(model: str, threads: int) -> "ScanTracker":
    if model.endswith(".ckpt"):
        need_full(f"{model}: a checkpoint")
        from rcnn_odom.training.export import load_odometer

        return load_odometer(Path(model), threads).tracker
    from rcnn_odom.deployment.odometer import Odometer

    return Odometer.from_onnx(model, threads=threads).tracker
