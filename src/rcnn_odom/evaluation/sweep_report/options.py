"""Finds the options that differ between runs, and checks that the runs can be compared."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import yaml

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.sweep_report.folders import Run

GROUPS = {"model": "model.variant", "data": "data.name"}
"""For each group of configuration files, the option whose value identifies the chosen file."""

SAME_DRIVES = tuple(
    f"data.{key}" for key in ("name", "test", "lengths", "world", "scale", "frames", "world_seed", "root")
)
"""Options that decide which drives are scored, and how; all runs of one table must have the same values."""

IGNORED_OPTIONS = re.compile(
    r"seed|run_dir|outputs|data\.(workers|keep_worlds)|data\.(reader|passes|epochs|beta|rotation_classes)\..*"
    r"|trainer\.(accelerator|devices|max_time.*)"
)
"""Options that do not define a setting: they have no effect on the result, or act through other options."""

NOT_COMPARABLE = "their drifts cannot be compared in one table"

Values = tuple[Any, ...]
"""A setting: the values of the swept options in the order of the options, with lists as tuples."""


def setting_of(run: Run, options: Sequence[str]) -> Values:
    """The values of several options in a run's configuration; None for an option that it does not have."""
    return tuple(map(run.settings.get, options))


def _differing_options(runs: Sequence[Run]) -> list[str]:
    """Options that define a setting and whose values are not the same in all of the runs."""
    return [
        name
        for name in dict.fromkeys(name for run in runs for name in run.settings)
        if not IGNORED_OPTIONS.fullmatch(name) and len({run.settings.get(name) for run in runs}) > 1
    ]


def swept_options(runs: Sequence[Run]) -> list[str]:
    """Options that the commands of the runs set and whose values vary, in the order of their appearance.

    They are followed by every other option that differs between two runs with equal values of these options,
    for instance because a default has changed between the runs. Means are taken over equal runs only.
    """
    set_by_command = dict.fromkeys(_option_name(override) for run in runs for override in run.overrides)
    differing = _differing_options(runs)
    options = [option for option in set_by_command if option in differing]
    while (other := _find_other_difference(runs, options)) is not None:
        options.append(other)
    return options


def _option_name(override: str) -> str:
    """The option that an override sets; ``+data@here=kitti`` sets the group ``data``, hence ``data.name``."""
    key = re.split(r"[=@]", override.lstrip("+~"), maxsplit=1)[0]
    return GROUPS.get(key, key)


def _find_other_difference(runs: Sequence[Run], options: Sequence[str]) -> str | None:
    """An option that differs between runs of one setting, options of the model first; None without one."""
    groups: dict[Values, list[Run]] = {}
    for run in runs:
        groups.setdefault(setting_of(run, options), []).append(run)
    for group in groups.values():
        # Data that differ without being swept are refused by check_same_data.
        names = [name for name in _differing_options(group) if not name.startswith("data.")]
        if names:
            return min(names, key=lambda name: not name.startswith("model."))
    return None


def check_same_data(runs: Sequence[Run], options: Iterable[str]) -> None:
    """Checks that all runs have the same drives, laser and scoring, so that one table can compare them.

    Args:
        runs: the finished runs.
        options: the swept options. They may differ (for instance ``data.realism.tilt``), except those of
            ``SAME_DRIVES``.

    Raises:
        InputError: two runs differ; the message names the runs and the option.
    """
    allowed = set(options) - set(SAME_DRIVES)
    for run in runs[1:]:
        for name in sorted(_differing_options([runs[0], run])):
            if name.startswith("data.") and name not in allowed:
                first, second = (show_value(each.settings.get(name)) for each in (runs[0], run))
                raise InputError(
                    f"{runs[0].name} and {run.name} differ in {name}, {first} and {second}: "
                    f"{NOT_COMPARABLE}; choose with --only {name}={second if first == '-' else first}, "
                    "or name a folder with fewer runs"
                )
        first, second = (", ".join(each.metrics.sequences) for each in (runs[0], run))
        if first != second:
            raise InputError(
                f"{runs[0].name} was tested on {first}, {run.name} on {second}: "
                f"{NOT_COMPARABLE}; name a folder with fewer runs"
            )


def same_drives(first: Run, second: Run) -> bool:
    """Whether two finished runs were scored on the same drives, in the same way."""
    same_names = first.metrics.sequences == second.metrics.sequences
    return same_names and setting_of(first, SAME_DRIVES) == setting_of(second, SAME_DRIVES)


def select_runs(runs: Sequence[Run], only: Iterable[str]) -> list[Run]:
    """Selects the runs whose configuration has the given values; runs without a readable one are kept.

    Args:
        runs: the runs to select from.
        only: texts ``KEY=VALUE`` with the full name of an option, for instance ``data.scale=full``.

    Raises:
        InputError: a text has another form, or no run has this option or value.
    """
    kept = list(runs)
    for text in only:
        key, value = parse_choice(text)
        fitting = [run for run in kept if has_value(run.settings, key, value)]
        if not fitting:
            known = sorted({show_value(run.settings[key]) for run in kept if key in run.settings})
            have = f"they have {', '.join(known)}" if known else "give an option's full name, data.scale=full"
            raise InputError(f"--only {text}: no run has this value; {have}")
        kept = [run for run in kept if run in fitting or not run.settings]
    return kept


def parse_choice(text: str) -> tuple[str, str]:
    """Splits ``KEY=VALUE`` into its two parts; the name of a group is replaced by that of its option.

    Raises:
        InputError: the text has another form.

    Example:
        >>> parse_choice("model=rcnn_reg")
        ('model.variant', 'rcnn_reg')
    """
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise InputError(f"{text}: write KEY=VALUE, for instance data.scale=full")
    return GROUPS.get(key, key), value


def has_value(values: Mapping[str, Any], key: str, value: str) -> bool:
    """Whether the option ``key`` has the value that a user wrote as text."""
    return key in values and (show_value(values[key]) == value or values[key] == _parse_value(value))


def _parse_value(text: str) -> Any:
    """Reads a text as YAML, with lists as tuples; a text that is not YAML is returned as it is."""
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        return text
    return tuple(value) if isinstance(value, list) else value


def show_value(value: Any) -> str:
    """Formats a value as on the command line; a dash for None, an option that a run does not have.

    Example:
        >>> show_value((True, 0.5)), show_value(None)
        ('[true,0.5]', '-')
    """
    if isinstance(value, tuple):
        return f"[{','.join(map(show_value, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return "-" if value is None else str(value)
