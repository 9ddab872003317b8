"""Cuts parts from recordings; ``data.train``, ``data.val`` and ``data.test`` name them ``NAME[0.0:0.85]``.

``NAME[::3]`` is every third scan, ``NAME[0.5::3]`` is every third scan of the second half.
"""

import logging
import re
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.recording import Drive

log = logging.getLogger(__name__)

FRACTION = r"(?:\d+\.?\d*|\.\d+)?"
"""A number without a sign, or nothing."""


class Part(NamedTuple):
    """A part of a recording.

    Attributes:
        file: name of the recording.
        start, stop: fractions of the recording, from 0 to 1, at which the part begins and ends.
        every: take every ``every``-th scan of the part; 1: all.
    """

    file: str
    start: float = 0.0
    stop: float = 1.0
    every: int = 1


def parse_part(name: str) -> Part:
    """Parse ``NAME``, ``NAME[a:b]`` or ``NAME[a:b:n]``.

    Raises:
        InputError: the brackets do not hold fractions with a < b, or n is not a whole number above 0.

    >>> parse_part("10[0.25:]")
    Part(file='10', start=0.25, stop=1.0, every=1)
    >>> parse_part("10[::3]").every
    3
    """
    match = re.fullmatch(rf"(.+?)\[({FRACTION}):({FRACTION})(?::([^:\]]*))?\]", name)
    if match is None:
        if "[" in name:
            raise InputError(
                f"sequence {name!r}: a part is written as NAME[0.0:0.85], with fractions of the drive; every "
                "third scan is NAME[::3]"
            )
        return Part(name)
    start, stop, every = float(match[2] or 0), float(match[3] or 1), match[4] or "1"
    if not 0 <= start < stop <= 1:
        raise InputError(f"sequence {name!r}: a part needs two fractions between 0 and 1, the smaller first")
    if not re.fullmatch(r"[0-9]{1,9}", every) or int(every) < 1:
        raise InputError(
            f"sequence {name!r}: after the second colon comes a whole number from 1 on, as in NAME[::3]"
        )
    return Part(match[1], start, stop, int(every))


def cut(drives: Mapping[str, Drive], name: str) -> Drive:
    """Cut a part from a recording, without frames at its ends whose true poses are unknown.

    Args:
        drives: whole recordings by their names.
        name: name of a recording, or ``NAME[a:b]`` or ``NAME[a:b:n]``.

    Raises:
        InputError: true poses are unknown between known ones, or fewer than two frames are left.
    """
    file, start, stop, every = parse_part(name)
    whole = drives[file]
    part = whole.part(round(start * len(whole)), round(stop * len(whole)), name).thin(every)
    known = np.flatnonzero(np.isfinite(part.poses).all((1, 2)))
    if len(known) < 2:
        raise InputError(
            f"sequence {name} has {len(known)} frames with known poses, but two are needed; give a longer "
            "recording or part, or a truth that covers more of it"
        )
    first, last = int(known[0]), int(known[-1])
    assert part.frames is not None
    if len(known) != last - first + 1:
        gap = int(np.flatnonzero(np.diff(known) > 1)[0])
        raise InputError(
            f"sequence {file}: the true pose of frame {part.frames[int(known[gap]) + 1]} is unknown, between "
            "known ones; use parts of the recording, NAME[a:b]"
        )
    if len(known) != len(part):
        log.info("%s: uses frames %d to %d of %d, whose true poses are known", name, first, last, len(part))
    return part.part(first, last + 1)


def trusted_pieces(drive: Drive, least: int) -> list[Drive]:
    """Split a drive at the true steps that are not trusted.

    Args:
        drive: drive to train on.
        least: smallest number of frames of a piece; shorter pieces are dropped.

    Returns:
        The pieces, in which every true step is trusted; the drive itself if all its steps are.

    Raises:
        InputError: there is no piece of ``least`` frames.
    """
    doubted = [] if drive.trusted is None else (np.flatnonzero(~drive.trusted[1:]) + 1).tolist()
    if not doubted:
        return [drive]
    frames = drive.frames or range(len(drive))
    pieces = [
        drive.part(start, stop, f"{drive.name}:{frames[start]}-{frames[stop - 1]}")
        for start, stop in pairwise([0, *doubted, len(drive)])
        if stop - start >= least
    ]
    if not pieces:
        raise InputError(
            f"training sequence {drive.name}: no {least} scans in a row are without a doubtful true step; "
            "leave it out of data.train, or set model.window lower"
        )
    log.info(
        "%s: %d of %d scans to train on, in %d pieces",
        drive.name,
        *(sum(map(len, pieces)), len(drive), len(pieces)),
    )
    return pieces
