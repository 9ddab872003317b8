"""Mixes recordings of several formats and lasers in one training; they are named SOURCE/NAME."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

from rcnn_odom.errors import InputError
from rcnn_odom.options import option
from rcnn_odom.recordings import formats
from rcnn_odom.recordings.recording import Recording

PARTLY = "partial"
"""Option of a source: its laser may cover only a part of ``data.sensor``."""
NEW_WORLDS = "fresh_worlds"
"""Option of the formats that make new worlds."""


def _are_sources(sources: Mapping[str, Any]) -> bool:
    return bool(sources) and all(
        "/" not in str(name) and isinstance(source, dict) and isinstance(source.get("format"), str)
        for name, source in sources.items()
    )


@dataclass(kw_only=True)
class Options:
    """Options of ``conf/data/mixed.yaml`` that are not common to all data."""

    fresh_worlds: bool
    keep_worlds: bool
    sources: dict[str, Any] = option(  # noqa: RUF009
        fits=_are_sources,
        wanted="readers by their names, each with its format and options, "
        "{logs: {format: carmen, root: DIR}}",
    )


def load(name: str, *, sources: Mapping[str, Mapping[str, Any]]) -> Recording:
    """Load a recording from one of several sources.

    Args:
        name: ``SOURCE/NAME``; NAME is the recording's name in the source.
        sources: for each SOURCE the ``format``, the options of its ``load``, and optionally ``partial``: true
            if the source's laser may cover only a part of the field of view of ``data.sensor``, with beams
            farther apart than its bins. The beams must lie within that field of view.

    Returns:
        The recording under the name ``SOURCE/NAME``. It keeps its world unless its format makes new ones.

    Raises:
        InputError: the name has no source or an unknown one, an option of the source is wrong, or the
            recording cannot be loaded.
    """
    source, separator, own_name = name.partition("/")
    if not separator or source not in sources or not own_name:
        raise InputError(f"sequence {name}: must be SOURCE/NAME with one of the sources {', '.join(sources)}")
    reader = dict(sources[source])
    partly = reader.pop(PARTLY, False)
    if not isinstance(partly, bool):
        raise InputError(f"data.sources.{source}.{PARTLY}={partly}: must be true or false")
    try:
        recording = formats.open_recording(reader)(own_name)
    except InputError as error:
        raise InputError(f"data.sources.{source}: {str(error).removeprefix('data.reader: ')}") from error
    key = recording.fingerprint
    if partly:  # changes which scans fit, and so the encoded scans
        key = hashlib.sha256(f"{key} {PARTLY}".encode()).hexdigest()
    return replace(
        recording,
        name=name,
        fingerprint=key,
        keeps_world=not _makes_worlds(str(reader["format"])),
        has_partial_laser=partly,
    )


def _makes_worlds(form: str) -> bool:
    options = getattr(formats.find_format(form), "Options", None)
    return is_dataclass(options) and NEW_WORLDS in {each.name for each in fields(options)}
