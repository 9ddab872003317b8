"""Parts of recordings, as ``data.train``, ``data.val`` and ``data.test`` name them: ``NAME[0.0:0.85]``."""

import logging
import re
from collections.abc import Mapping

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.recording import Drive

log = logging.getLogger(__name__)

FRACTION = r"(?:\d+\.?\d*|\.\d+)?"
"""A number without a sign, or nothing."""


def parse_part(name: str) -> tuple[str, float, float]:
    """``NAME`` or ``NAME[a:b]`` -> name and the fractions of the recording where the part lies.

    Raises:
        InputError: the brackets do not hold fractions with a < b.

    >>> parse_part("10[0.25:]")
    ('10', 0.25, 1.0)
    """
    match = re.fullmatch(rf"(.+?)\[({FRACTION}):({FRACTION})\]", name)
    if match is None:
        if "[" in name:
            raise InputError(f"sequence {name!r}: a part is written NAME[0.0:0.85], fractions of the drive")
        return name, 0.0, 1.0
    start, stop = float(match[2] or 0), float(match[3] or 1)
    if not 0 <= start < stop <= 1:
        raise InputError(f"sequence {name!r}: a part needs two fractions between 0 and 1, the smaller first")
    return match[1], start, stop


def cut(drives: Mapping[str, Drive], name: str) -> Drive:
    """The part of a recording that ``name`` asks for, without the ends whose truth is unknown.

    Args:
        drives: whole recordings by their name.
        name: of a recording, or ``NAME[a:b]``.

    Raises:
        InputError: the truth has gaps inside, or fewer than two frames are left.
    """
    file, start, stop = parse_part(name)
    whole = drives[file]
    part = whole.part(round(start * len(whole)), round(stop * len(whole)), name)
    known = np.flatnonzero(np.isfinite(part.poses).all((1, 2)))
    if len(known) < 2:
        raise InputError(
            f"sequence {name} has {len(known)} frames with known poses, but two are needed; give a longer "
            "recording or part, or a truth that knows more of it"
        )
    first, last = int(known[0]), int(known[-1])
    if len(known) != last - first + 1:
        gap = int(np.flatnonzero(np.diff(known) > 1)[0])
        raise InputError(
            f"sequence {file}: the truth is unknown at frame {round(start * len(whole)) + known[gap] + 1}, "
            "between known ones; use parts of it, NAME[a:b]"
        )
    if len(known) != len(part):
        log.info("%s: frames %d to %d of %d, where the truth is known", name, first, last, len(part))
    return part.part(first, last + 1)
