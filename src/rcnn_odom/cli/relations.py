"""The command `rcnn-odom relations`: scores a trajectory against hand-verified relations between scans."""

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
"""The same as in :mod:`rcnn_odom.evaluation.relations`, whose import would make ``--help`` slow."""


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "relations",
        help="score a trajectory against hand-verified relations between scans",
        description="Score a trajectory against hand-verified relative poses between scans of a CARMEN log "
        "(Kuemmerle et al. 2009). Sequential relations and loop closures are scored separately; they differ "
        "by the path length between their scans, which is measured with the wheel odometry of the log.",
    )
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help="CARMEN log, also packed as .gz or .bz2")
    add(
        "estimate",
        type=Path,
        metavar="EST",
        help="RUN/trajectories/NAME.txt (KITTI's format: 12 numbers a line, one line for each scan of LOG) "
        "or NAME.tum (stamp x y z qx qy qz qw; may be a part of LOG, whose scans are found by the stamps)",
    )
    add("relations", type=Path, metavar="RELATIONS", help="lines of t1 t2 x y z roll pitch yaw")
    add(
        "--frame",
        choices=["camera", "laser"],
        default="camera",
        help="frame of the poses in EST: camera (x right, z forward), as runs write them, or laser (x "
        "forward, y left), as many other programs write them (default: %(default)s)",
    )
    add(
        "--loop-path",
        type=metres,
        metavar="M",
        default=LOOP_PATH,
        help="a relation closes a loop if the robot drove more than M metres between its scans (default: "
        "%(default)s)",
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
        raise InputError(f"{arguments.log}: no such file; give the log to which the relations belong")
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
    """Reads the poses of the estimate.

    Args:
        path: file in KITTI's or TUM's format.
        log: the log, for error messages.
        stamps: (N,) stamps of all scans of the log, see :func:`rcnn_odom.evaluation.relations.stamp_keys`.

    Returns:
        Poses (N, 4, 4), nan for a scan without a pose in the file.

    Raises:
        InputError: the file cannot be read, or does not fit the log.
    """
    import numpy as np

    from rcnn_odom.evaluation.relations import stamp_keys
    from rcnn_odom.recordings.trajectory import read_kitti, read_tum

    if _count_columns(path) != TUM_COLUMNS:
        poses = read_kitti(path)
        if len(poses) != len(stamps):
            raise InputError(
                f"{path}: {len(poses)} poses, but {log} has {len(stamps)} scans; for a part of a log, give "
                "the file NAME.tum, which has the stamps"
            )
        return poses
    times, poses = read_tum(path)
    numbers = {stamp: number for number, stamp in enumerate(stamps.tolist())}
    every = np.full((len(stamps), 4, 4), np.nan)
    for line, (stamp, pose) in enumerate(zip(stamp_keys(times).tolist(), poses, strict=True), start=1):
        if stamp not in numbers:
            raise InputError(
                f"{path}:{line}: no scan of {log} has the stamp {stamp / 1e6:.6f}; give the log of EST"
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
    """Formats the errors as a text table."""
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
