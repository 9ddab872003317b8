"""Which options differ between runs, and whether the runs can be compared at all."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import yaml

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.sweep_report.folders import Run

GROUPS = {"model": "model.variant", "data": "data.name"}
"""The value that stands for the choice of a configuration file."""

SAME_DRIVES = tuple(
    f"data.{key}" for key in ("name", "test", "lengths", "world", "scale", "frames", "world_seed", "root")
)
"""What decides which drives are scored, and how: never different in one table."""

NO_SETTING_OF_THEIR_OWN = re.compile(
    r"seed|run_dir|outputs|data\.(workers|keep_worlds)|data\.(reader|passes|epochs|beta|rotation_classes)\..*"
    r"|trainer\.(accelerator|devices|max_time.*)"
)
"""Differences that make no setting of their own: they act through other options, or not at all."""

NOT_IN_ONE_TABLE = "their drifts cannot stand in one table"

Values = tuple[Any, ...]
"""A setting: the values of the swept options in their order, lists as tuples."""


def setting_of(run: Run, options: Sequence[str]) -> Values:
    """What a run's configuration says of several options, None where it does not know one."""
    return tuple(map(run.settings.get, options))


def _differing(runs: Sequence[Run]) -> list[str]:
    """Options that make a setting of their own and are not the same in all of the runs."""
    return [
        name
        for name in dict.fromkeys(name for run in runs for name in run.settings)
        if not NO_SETTING_OF_THEIR_OWN.fullmatch(name) and len({run.settings.get(name) for run in runs}) > 1
    ]


def swept_options(runs: Sequence[Run]) -> list[str]:
    """Options that the runs' commands set and whose values vary, in the order in which they first come.

    After them, any other option in which two runs would differ though all of these are equal, for instance
    because a default has changed between them: means are taken over equal runs only.
    """
    named = dict.fromkeys(_option(override) for run in runs for override in run.overrides)
    differing = _differing(runs)
    options = [option for option in named if option in differing]
    while (other := _unexplained(runs, options)) is not None:
        options.append(other)
    return options


def _option(override: str) -> str:
    """The dotted name that an override sets: ``+data@here=kitti`` sets ``data``, hence its name."""
    key = re.split(r"[=@]", override.lstrip("+~"), maxsplit=1)[0]
    return GROUPS.get(key, key)


def _unexplained(runs: Sequence[Run], options: Sequence[str]) -> str | None:
    """An option that differs between runs of one setting; the networks' own before the rest."""
    groups: dict[Values, list[Run]] = {}
    for run in runs:
        groups.setdefault(setting_of(run, options), []).append(run)
    for group in groups.values():
        # Data that differ unasked are no setting of their own, see check_same_data.
        names = [name for name in _differing(group) if not name.startswith("data.")]
        if names:
            return min(names, key=lambda name: not name.startswith("model."))
    return None


def check_same_data(runs: Sequence[Run], options: Iterable[str]) -> None:
    """Runs of one table must have the same drives, laser and scoring.

    Args:
        runs: the finished ones.
        options: the swept ones; they may differ (``data.realism.tilt``), but not the drives.

    Raises:
        InputError: two runs differ; it names them and says what differs.
    """
    allowed = set(options) - set(SAME_DRIVES)
    for run in runs[1:]:
        for name in sorted(_differing([runs[0], run])):
            if name.startswith("data.") and name not in allowed:
                first, second = (show_value(one.settings.get(name)) for one in (runs[0], run))
                raise InputError(
                    f"{runs[0].name} and {run.name} differ in {name}, {first} and {second}: "
                    f"{NOT_IN_ONE_TABLE}; choose with --only {name}={second if first == '-' else first}, "
                    "or name a folder of fewer runs"
                )
        first, second = (", ".join(one.metrics.sequences) for one in (runs[0], run))
        if first != second:
            raise InputError(
                f"{runs[0].name} was tested on {first}, {run.name} on {second}: "
                f"{NOT_IN_ONE_TABLE}; name a folder of fewer runs"
            )


def same_drives(first: Run, second: Run) -> bool:
    """Whether two finished runs were scored on the same drives, in the same way."""
    same_names = first.metrics.sequences == second.metrics.sequences
    return same_names and setting_of(first, SAME_DRIVES) == setting_of(second, SAME_DRIVES)


def choose(runs: Sequence[Run], only: Iterable[str]) -> list[Run]:
    """The runs whose configuration has the wanted values; those without a readable one stay.

    Args:
        runs: to choose from.
        only: ``KEY=VALUE`` with the option's full name, for instance ``data.scale=full``.

    Raises:
        InputError: a text of another form, or an option or value that no run has.
    """
    kept = list(runs)
    for text in only:
        key, value = parse_choice(text)
        fitting = [run for run in kept if matches(run.settings, key, value)]
        if not fitting:
            known = sorted({show_value(run.settings[key]) for run in kept if key in run.settings})
            have = f"they have {', '.join(known)}" if known else "give an option's full name, data.scale=full"
            raise InputError(f"--only {text}: no run has it; {have}")
        kept = [run for run in kept if run in fitting or not run.settings]
    return kept


def parse_choice(text: str) -> tuple[str, str]:
    """``KEY=VALUE`` as its two parts; a group's name stands for the value that names its choice.

    Raises:
        InputError: the text has another form.
    """
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise InputError(f"{text}: write KEY=VALUE, for instance data.scale=full")
    return GROUPS.get(key, key), value


def matches(values: Mapping[str, Any], key: str, value: str) -> bool:
    """Whether an option (one of the values by their names) has the value that a person wrote."""
    return key in values and (show_value(values[key]) == value or values[key] == _as_value(value))


def _as_value(text: str) -> Any:
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        return text
    return tuple(value) if isinstance(value, list) else value


def show_value(value: Any) -> str:
    """A value as it would be written on the command line; a dash for an option that a run does not have."""
    if isinstance(value, tuple):
        return f"[{','.join(map(show_value, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return "-" if value is None else str(value)
