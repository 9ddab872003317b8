"""`rcnn-odom relations`: a trajectory against hand-verified relations between scans."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rcnn_odom.cli.arguments import Subcommands, metres
from rcnn_odom.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from rcnn_odom.geometry import FloatArray

TUM_COLUMNS = 8
LOOP_PATH = 5.0
"""Metres, as in :mod:`rcnn_odom.evaluation.relations`, which would slow ``--help`` down."""


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "relations",
        help="score a trajectory against hand-verified relations between scans",
        description="Score a trajectory against hand-verified relative poses between scans of a CARMEN log "
        "(Kuemmerle et al. 2009). Sequential relations, from one place to the next, and loops are separated "
        "by the way between their scans, along the log's wheel odometry.",
    )
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help="CARMEN log; plain, .gz or .bz2")
    add(
        "estimate",
        type=Path,
        metavar="EST",
        help="RUN/trajectories/NAME.txt (KITTI: 12 numbers a line, one for each scan of LOG), or NAME.tum "
        "(stamp x y z qx qy qz qw, also of a part of LOG, found by the stamps)",
    )
    add("relations", type=Path, metavar="RELATIONS", help="lines of t1 t2 x y z roll pitch yaw")
    add(
        "--frame",
        choices=["camera", "laser"],
        default="camera",
        help="whose poses EST holds: camera (x right, z forward), as runs write them, or laser (x forward, "
        "y left), as many other programs do (%(default)s)",
    )
    add(
        "--loop-path",
        type=metres,
        metavar="M",
        default=LOOP_PATH,
        help="a relation closes a loop if the robot drove more metres between its scans (%(default)s)",
    )
    add("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=_run_relations)


def _run_relations(arguments: argparse.Namespace) -> int:
    import numpy as np

    from rcnn_odom.evaluation.drift import travelled
    from rcnn_odom.evaluation.relations import read_relations, score_relations, stamp_keys
    from rcnn_odom.geometry import FORWARD_CAMERA, change_frame
    from rcnn_odom.recordings import carmen

    if not arguments.log.is_file():
        raise InputError(f"{arguments.log}: no such file; give the log that the relations are of")
    relations = read_relations(arguments.relations)
    log = carmen.load(arguments.log.name, root=arguments.log.parent)
    stamps = stamp_keys(log.stamps)
    poses = _read_poses(arguments.estimate, arguments.log, stamps)
    if arguments.frame == "camera":
        poses = change_frame(poses, np.linalg.inv(FORWARD_CAMERA))
    assert log.wheel_odometry is not None
    report = score_relations(relations, stamps, travelled(log.wheel_odometry), poses, arguments.loop_path)
    report = {"loop_path_m": arguments.loop_path, "frame": arguments.frame, **report}
    print(json.dumps(report, indent=2) if arguments.json else _format(report))
    return 0


def _read_poses(path: Path, log: Path, stamps: "npt.NDArray[np.int64]") -> "FloatArray":
    """Poses (N, 4, 4) for all stamps (N,) of the log, nan where the file has none."""
    import numpy as np

    from rcnn_odom.evaluation.relations import stamp_keys
    from rcnn_odom.recordings.trajectory import read_kitti, read_tum

    if _count_columns(path) != TUM_COLUMNS:
        poses = read_kitti(path)
        if len(poses) != len(stamps):
            raise InputError(
                f"{path}: {len(poses)} poses, but {log} has {len(stamps)} scans; of a part of a log give the "
                "file NAME.tum, whose stamps say which"
            )
        return poses
    times, poses = read_tum(path)
    numbers = {stamp: number for number, stamp in enumerate(stamps.tolist())}
    every = np.full((len(stamps), 4, 4), np.nan)
    for line, (stamp, pose) in enumerate(zip(stamp_keys(times).tolist(), poses, strict=True), start=1):
        if stamp not in numbers:
            raise InputError(
                f"{path}:{line}: no scan of {log} has the stamp {stamp / 1e6:.6f}; give its own log"
            )
        every[numbers[stamp]] = pose
    return every


def _count_columns(path: Path) -> int:
    try:
        with path.open(encoding="utf-8", errors="replace") as stream:
            return next((len(line.split()) for line in stream if not line.startswith("#")), 0)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _format(report: dict[str, Any]) -> str:
    """A table for people."""
    lines = [f"{'relations':<12}{'count':>7}   {'translation (m)':^17}   {'rotation (deg)':^17}"]
    lines.append(f"{'':<12}{'':>7}   {'mean':>8} {'median':>8}   {'mean':>8} {'median':>8}")
    for name in ("sequential", "loop", "all"):
        group = report[name]
        cells = [
            f"{group[key]:8.4f}" if key in group else f"{'-':>8}"
            for key in (
                "translation_mean_m",
                "translation_median_m",
                "rotation_mean_deg",
                "rotation_median_deg",
            )
        ]
        lines.append(f"{name:<12}{group['count']:>7}   {' '.join(cells[:2])}   {' '.join(cells[2:])}")
    lines.append(f"\nloop: more than {report['loop_path_m']:g} m driven between its scans")
    for key, where in (("not_in_log", "the log"), ("not_in_estimate", "the estimate")):
        if report[key]:
            lines.append(f"left out: {report[key]} relations whose times are not in {where}")
    return "\n".join(lines)
