"""Options on the command line: quoting for Hydra, and paths that begin with ``~``."""

import os
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import find_weights

PATHS = ("root", "reference", "pretrained", "run", "run_dir", "outputs")
"""Options whose values are paths, also if they look like a number: ``data.root=2011``."""
FOLDERS_OF_HYDRA = ("hydra.run.dir", "hydra.sweep.dir")

PARTS = re.compile(r"(\+{0,2}[\w.@/$-]+)=(.*)", re.DOTALL)
"""Matches an override; the groups are its name and value."""
UNQUOTED = re.compile(r"[A-Za-z0-9_/\-\\+.$%*@?|: \t]")
"""Matches a character that Hydra accepts in a value without quotes."""
CHANGED_BY_HYDRA = re.compile(
    r"^\s|\s$|\\[\\()\[\]{}:=, \t]|^[+-]?(?:[\d._e+-]*|true|false|null|inf|nan)$", re.IGNORECASE
)
"""Matches a value that Hydra would change: spaces at its ends, escapes, numbers and special words."""


def is_path(name: str) -> bool:
    """Whether the value of an option, such as ``data.root``, is a path."""
    name = name.lstrip("+")
    return name in FOLDERS_OF_HYDRA or (not name.startswith("hydra.") and name.split(".")[-1] in PATHS)


def quote_for_hydra(value: str) -> str:
    r"""Puts a value in double quotes for Hydra.

    >>> print(quote_for_hydra('~/say "x"'))
    "~/say \"x\""
    """
    # Only backslashes before a quote must be escaped.
    return '"' + re.sub(r'(\\*)("|$)', lambda found: 2 * found[1] + ('\\"' if found[2] else ""), value) + '"'


def written(name: str, value: str) -> str:
    """An override as one types it in a shell, quoted for Hydra and for the shell where needed.

    >>> print(written("data.root", "here/2011"), written("run", "outputs/a (b)"))
    data.root=here/2011 'run="outputs/a (b)"'
    """
    needs_quotes = _find_special_character(value) or CHANGED_BY_HYDRA.search(value)
    return shlex.quote(f"{name}={quote_for_hydra(value) if needs_quotes else value}")


def _find_special_character(value: str) -> str | None:
    """The first character that Hydra does not accept in a value without quotes; None if there is none."""
    return next((each for each in value if not UNQUOTED.match(each)), None)


def explain_override(override: str) -> str:
    """Explains why Hydra cannot read an override, and how to write it.

    >>> explain_override("data.root=~/x")
    'data.root=~/x: Hydra cannot read \\'~\\' in a value without quotes; write \\'data.root="~/x"\\''
    """
    parts = PARTS.fullmatch(override)
    if parts is None:
        return f"{override}: is not an option; write NAME=VALUE, for instance model=cnn_reg"
    name, value = parts.groups()
    if value.startswith(("[", "{")) and not is_path(name):
        return f"{override}: {_explain_list(name, value)}"
    character = _find_special_character(value)
    what = f"{character!r} in a value" if character else "this value"
    return f"{override}: Hydra cannot read {what} without quotes; write {written(name, value)}"


def _explain_list(name: str, value: str) -> str:
    """Explains how to write a value that is a list or a dictionary."""
    if value[0] == "{" or not value.endswith("]"):
        form = f"{name}={{key: value}}" if value[0] == "{" else f"{name}=[a,b]"
        return f"Hydra cannot read this; write it in the form {shlex.quote(form)}, names in double quotes"
    items = (item.strip() for item in value[1:-1].split(","))
    names = ",".join(item if item[:1] in ("'", '"') else quote_for_hydra(item) for item in items)
    return f"Hydra cannot read these names without quotes; write {shlex.quote(f'{name}=[{names}]')}"


def read_paths(arguments: Sequence[str]) -> list[str]:
    """Replaces ``~`` at the beginning of paths by the user's home folder.

    Args:
        arguments: arguments of ``train.py`` or ``evaluate.py``. Those that Hydra cannot read are not changed.

    Raises:
        InputError: a path is empty, Hydra would read it as a number, or an argument is not valid text.
    """
    for argument in arguments:
        try:
            argument.encode()
        except UnicodeEncodeError:  # Python has decoded bytes that are invalid in the terminal's encoding.
            raise InputError(
                f"{argument}: has characters that are invalid in the terminal's encoding; set PYTHONUTF8=1, "
                "or LC_ALL to a UTF-8 locale"
            ) from None
    return [_read_path(argument) for argument in arguments]


def _read_path(argument: str) -> str:
    """The argument, with ``~`` and the folder of a run replaced if it is an option for a path."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parts = PARTS.fullmatch(argument)
    if parts is None or not is_path(parts[1]):
        return argument
    name, text = parts.groups()
    try:
        override = OverridesParser.create().parse_override(argument)
        value = None if override.is_sweep_override() else override.value()
    except HydraException:  # Hydra reports the error later.
        return argument
    if isinstance(value, str) and not value.strip():
        raise InputError(f"{argument}: is an empty path; give one, or leave {name} out")
    if isinstance(value, bool | int | float) and str(value) != text:
        raise InputError(f"{argument}: Hydra reads {value}, which is not a path; write {written(name, text)}")
    if not isinstance(value, str):
        return argument
    path = os.path.expanduser(value) if value.startswith("~") else value
    if name.split(".")[-1] == "pretrained":
        # Resolved here, since the first job of a sweep changes the links of outputs/latest.
        path = str(find_weights(Path(path)))
    return argument if path == value else f"{name}={quote_for_hydra(path)}"
