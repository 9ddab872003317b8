"""Runs a Hydra job: chooses its folder, and reports mistakes of the user as one line and an exit status."""

import errno
import logging
import os
import re
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import ERROR
from rcnn_odom.terminal import show_any_text
from rcnn_odom.training import cluster
from rcnn_odom.training.overrides import explain_override, is_path, read_paths, written
from rcnn_odom.training.run_state import find_stopped
from rcnn_odom.training.settings import RENAMED, plain
from rcnn_odom.training.sweep import folder_name
from rcnn_odom.training.trainer_options import explain_refusal

log = logging.getLogger(__name__)

Result = TypeVar("Result")

NO_JOB_SUCCEEDED = "No trials are completed yet."
"""Optuna's message at the end of a sweep in which all jobs have failed."""
HYDRA_VALUE_ERRORS = ("Config group override", "Only one of --run")
"""Beginnings of messages of Hydra's ValueErrors, for ``model=null`` and for ``-m`` with ``--cfg``."""

_failed: list[Exception] = []


def run_folder(new: str, *, _root_: DictConfig) -> str:
    """The folder of a stopped run with exactly the same settings; otherwise a new folder.

    Args:
        new: the folder for a new run; stopped runs are searched for beside it.
        _root_: the whole configuration; passed by OmegaConf.
    """
    chosen = [str(key) for key in _root_ if key not in ("hydra", "run_dir")]
    try:
        settings = plain(OmegaConf.masked_copy(_root_, chosen))
    except (InputError, OmegaConfBaseException):  # The run reports the error later.
        return new
    return str(find_stopped(Path(new).parent, settings) or new)


# For conf/config.yaml.
OmegaConf.register_new_resolver("run_folder", run_folder, replace=True)
OmegaConf.register_new_resolver("folder_name", folder_name, replace=True)


def in_sweep() -> bool:
    """Whether the present job belongs to a multirun."""
    return not OmegaConf.is_missing(HydraConfig.get().job, "num")


def run_job(job: Callable[[DictConfig], Result], cfg: DictConfig) -> Result | None:
    """Runs a job in the folder that Hydra has created, and logs a mistake of the user.

    The mistake is saved for :func:`run_command`. In a sweep it is also written to ``error.txt`` in the job's
    folder and raised: Hydra continues with the other jobs and raises it again at the end.

    Returns:
        The result of the job; None after a mistake.

    Raises:
        KeyboardInterrupt: the job was stopped, which also stops a sweep.
        InputError, OSError: a mistake in a sweep.
    """
    folder, here = Path(HydraConfig.get().runtime.output_dir), Path.cwd()
    try:
        if HydraConfig.get().job.chdir:
            raise InputError(
                "hydra.job.chdir=true: paths must be relative to the folder of the command; leave it out"
            )
        if in_sweep():
            cluster.refuse_sweep(cluster.find_world())
            if any(override.split("=")[0] == "run_dir" for override in HydraConfig.get().overrides.task):
                raise InputError(
                    "run_dir= is the folder of a single run; set the folder of a sweep by hydra.sweep.dir="
                )
            (folder / ERROR).unlink(missing_ok=True)
        elif "sweeps" in HydraConfig.get().runtime.choices:
            raise InputError("+sweeps= needs -m: it has no effect on a single run")
        cfg.run_dir = str(folder.relative_to(here) if folder.is_relative_to(here) else folder)
        return job(cfg)
    except SystemExit:  # Lightning raises it after Ctrl-C.
        raise KeyboardInterrupt from None
    except Exception as error:
        is_users = isinstance(error, InputError | OSError)
        if is_users:
            is_full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            log.error("error: %s%s", error, "; make room, then repeat the command" if is_full else "")
            _failed.append(error)
        if in_sweep():
            with suppress(OSError):  # The error may be that the disk is full.
                (folder / ERROR).write_text(_one_line(f"{type(error).__name__}: {error}") + "\n", "utf-8")
        if in_sweep() or not is_users:
            raise
        return None


def run_command(main: Callable[[], object]) -> int:
    """Runs a function decorated with ``hydra.main``; the exit status is 1 after a mistake of the user."""
    # Otherwise Hydra prints an error and exits, also if it cannot create a folder.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM acts like Ctrl-C.
    logging.raiseExceptions = False  # Otherwise logging prints a traceback per line if the disk is full.
    show_any_text()
    try:
        sys.argv[1:] = read_paths(sys.argv[1:])
        world = cluster.find_world()
        if world is None or world.size == 1:
            return _run(main)
        if {"-m", "--multirun"} & set(sys.argv[1:]):
            if world.rank > 0:  # The first process reports the error.
                return 1
            cluster.refuse_sweep(world)
        return cluster.run_in(world, partial(_run, main))
    except KeyboardInterrupt:
        return 130
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _run(main: Callable[[], object]) -> int:
    """Runs the function in this process; returns the exit status."""
    try:
        main()
    except KeyboardInterrupt:
        return 130
    except InputError:  # A job of a sweep has logged it.
        return 1
    except (HydraException, OmegaConfBaseException, OSError, yaml.YAMLError) as error:
        print(f"error: {_explain(error)}", file=sys.stderr)
        return 1
    except ValueError as error:
        is_users = str(error).startswith(HYDRA_VALUE_ERRORS) or (_failed and str(error) == NO_JOB_SUCCEEDED)
        if not is_users:
            raise
        # The error of each failed job is already logged.
        print(f"error: {_one_line(str(error))}", file=sys.stderr)
        return 1
    return 1 if _failed else 0


def _one_line(text: str) -> str:
    """The text with every line break and run of spaces replaced by one space."""
    return " ".join(text.split())


def _explain(error: Exception) -> str:
    """Explains an error of Hydra or of the system in one line: what is wrong, and what to do."""
    if isinstance(error, OverrideParseException):
        return explain_override(error.override)
    # The rest of the message is a place in Hydra's configuration, of no use to the user.
    message = _one_line(re.split(r"\s+(?:full_key:|Config search path:)", str(error))[0])
    for before, now in RENAMED.items():
        if f"'{before}" in message:
            return f"{before} has become {now}; set that"
    if found := re.search(r"Could not find '([^']*)/([^'/]*)' Available options in '.*?': (.*)", message):
        group, chosen, names = found.groups()
        if successor := RENAMED.get(f"{group}={chosen}"):
            return f"{group}={chosen} has become {successor}; set that"
        return f"{group}={chosen}: there is no such choice; there are {', '.join(names.split())}"
    if found := re.match(r"Could not override '([\w.]+)'", message):
        return _explain_name(found[1])
    if found := re.match(r"Ambiguous value for argument '(.*?)=(.*?)' 1\.", message):
        return _explain_commas(*found.groups())
    # Some errors of Hydra are OSErrors too.
    is_folder = isinstance(error, OSError) and not isinstance(error, HydraException)
    return message + ("; choose another outputs= or run_dir=" if is_folder else "")


def _explain_name(name: str) -> str:
    """Explains an option that is not in the configuration."""
    if name.startswith("trainer."):
        return (
            explain_refusal(name.removeprefix("trainer."))
            or f"{name}: is not in the configuration; write +{name}=..."
        )
    return f"{name}: there is no such option; --help shows all options"


def _explain_commas(name: str, value: str) -> str:
    """Explains a comma in a value without ``-m``."""
    if is_path(name):
        return (
            f"{name}={value}: Hydra cannot read ',' in a value without quotes; write {written(name, value)}"
        )
    return f"{name}={value}: several values; write '{name}=[{value}]' for a list, or add -m for separate runs"
