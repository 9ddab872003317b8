"""What a user sets on the command line: how Hydra wants a value written, and paths that begin with ``~``."""

import os
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import find_weights

PATHS = ("root", "reference", "pretrained", "run", "run_dir", "outputs")
"""Options that may look like a number on the command line, ``data.root=2011``, and are a path."""
FOLDERS_OF_HYDRA = ("hydra.run.dir", "hydra.sweep.dir")

PARTS = re.compile(r"(\+{0,2}[\w.@/$-]+)=(.*)", re.DOTALL)
"""Name and value of an override."""
FREE = re.compile(r"[A-Za-z0-9_/\-\\+.$%*@?|: \t]")
"""What Hydra reads in a value without quotes."""
NOT_AS_IS = re.compile(
    r"^\s|\s$|\\[\\()\[\]{}:=, \t]|^[+-]?(?:[\d._e+-]*|true|false|null|inf|nan)$", re.IGNORECASE
)
"""What Hydra would read as something else: spaces at the ends, escapes, and what looks like no word."""


def is_path(name: str) -> bool:
    """Whether an option, ``data.root``, is a path."""
    name = name.lstrip("+")
    return name in FOLDERS_OF_HYDRA or (not name.startswith("hydra.") and name.split(".")[-1] in PATHS)


def quoted(value: str) -> str:
    r"""A value in double quotes, as Hydra reads it back.

    >>> print(quoted('~/say "x"'))
    "~/say \"x\""
    """
    # Backslashes count as such only before a quote.
    return '"' + re.sub(r'(\\*)("|$)', lambda found: 2 * found[1] + ('\\"' if found[2] else ""), value) + '"'


def written(name: str, value: str) -> str:
    """An override as it must be typed into a shell: quoted for Hydra and for the shell where they need it.

    >>> print(written("data.root", "here/2011"), written("run", "outputs/a (b)"))
    data.root=here/2011 'run="outputs/a (b)"'
    """
    needs_quotes = _strange(value) or NOT_AS_IS.search(value)
    return shlex.quote(f"{name}={quoted(value) if needs_quotes else value}")


def _strange(value: str) -> str | None:
    """The first character that Hydra cannot read in a value without quotes."""
    return next((each for each in value if not FREE.match(each)), None)


def explain(override: str) -> str:
    """One sentence on an override that Hydra cannot read: what is wrong and how to write it.

    >>> explain("data.root=~/x")
    'data.root=~/x: Hydra cannot read \\'~\\' in a value without quotes; write \\'data.root="~/x"\\''
    """
    parts = PARTS.fullmatch(override)
    if parts is None:
        return f"{override}: is not an option; write NAME=VALUE, for instance model=cnn_reg"
    name, value = parts.groups()
    if value.startswith(("[", "{")) and not is_path(name):
        return f"{override}: {_of_a_list(name, value)}"
    character = _strange(value)
    what = f"{character!r} in a value" if character else "this value"
    return f"{override}: Hydra cannot read {what} without quotes; write {written(name, value)}"


def _of_a_list(name: str, value: str) -> str:
    if value[0] == "{" or not value.endswith("]"):
        form = f"{name}={{key: value}}" if value[0] == "{" else f"{name}=[a,b]"
        return f"Hydra cannot read this; write it in the form {shlex.quote(form)}, names in double quotes"
    items = (item.strip() for item in value[1:-1].split(","))
    names = ",".join(item if item[:1] in ("'", '"') else quoted(item) for item in items)
    return f"Hydra cannot read these names without quotes; write {shlex.quote(f'{name}=[{names}]')}"


def read_paths(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command with ``~`` at the beginning of paths replaced by the user's home.

    Args:
        arguments: of ``train.py`` or ``evaluate.py``; what Hydra cannot read stays as it is.

    Raises:
        InputError: a path is empty, or Hydra would take it for a number; an argument is no text.
    """
    for argument in arguments:
        try:
            argument.encode()
        except UnicodeEncodeError:  # as Python decodes bytes that the terminal's encoding does not know
            raise InputError(
                f"{argument}: has letters that the terminal's encoding lacks; set PYTHONUTF8=1, or LC_ALL to "
                "one of UTF-8"
            ) from None
    return [_read_path(argument) for argument in arguments]


def _read_path(argument: str) -> str:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parts = PARTS.fullmatch(argument)
    if parts is None or not is_path(parts[1]):
        return argument
    name, text = parts.groups()
    try:
        override = OverridesParser.create().parse_override(argument)
        value = None if override.is_sweep_override() else override.value()
    except HydraException:  # Hydra will say so
        return argument
    if isinstance(value, str) and not value.strip():
        raise InputError(f"{argument}: is an empty path; give one, or leave {name} out")
    if isinstance(value, bool | int | float) and str(value) != text:
        raise InputError(f"{argument}: Hydra reads {value}, which is no path; write {written(name, text)}")
    if not isinstance(value, str):
        return argument
    path = os.path.expanduser(value) if value.startswith("~") else value
    if name.split(".")[-1] == "pretrained":
        # Here, since the first job of a sweep makes outputs/latest another run's.
        path = str(find_weights(Path(path)))
    return argument if path == value else f"{name}={quoted(path)}"
