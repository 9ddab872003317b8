"""Names of the folders of a sweep's jobs, from the command that started the sweep."""

import hashlib
import re
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

LONGEST_NAME = 120
SEPARATOR = "__"
"""Separates the overrides in a name. It is not a comma, which Hydra would read as a sweep."""


def folder_name(overrides: str) -> str:
    """The name of a job's folder, made of its overrides, so that the same command finds the folder again.

    Args:
        overrides: ``hydra.job.override_dirname``, such as ``model-cnn_cls__seed-0``.

    Returns:
        The overrides, with those of the data and the trainer last. Characters that are unsafe in a file name
        are replaced, and long names are cut; such names get a hash, so that different overrides have
        different names.

    >>> folder_name("data-indoor__model-cnn_cls__seed-0")
    'model-cnn_cls__seed-0__data-indoor'
    """
    pairs = sorted(overrides.split(SEPARATOR), key=lambda pair: (pair.startswith(("data", "trainer")), pair))
    wanted = SEPARATOR.join(pairs)
    name = re.sub(r"[^\w.~+-]+", "_", wanted)
    if name == wanted and len(name) <= LONGEST_NAME:
        return name or "defaults"
    return f"{name[:LONGEST_NAME]}-{hashlib.sha256(wanted.encode()).hexdigest()[:8]}"


def expected_folders(sweep: Path) -> list[str] | None:
    """Names of the folders of all jobs of a grid sweep, for its last command.

    Args:
        sweep: folder of the sweep, with Hydra's ``multirun.yaml``.

    Returns:
        None if they are unknown: there is no such file, or the sweeper draws its values at random.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

    try:
        settings = OmegaConf.load(sweep / "multirun.yaml").hydra
        if not settings.sweeper._target_.endswith(".BasicSweeper"):  # Other sweepers draw values.
            return None
        swept = [f"{key}={value}" for key, value in (settings.sweeper.params or {}).items()]
        overrides = OverridesParser.create().parse_overrides([*swept, *settings.overrides.task])
        (jobs,) = BasicSweeper.split_arguments(overrides, None)
        naming = settings.job.config.override_dirname
        excluded, equals = set(naming.exclude_keys), str(naming.kv_sep)
    except (OSError, OmegaConfBaseException, HydraException, AttributeError):
        return None
    names = []
    for job in jobs:
        pairs = [pair for pair in job if pair.split("=")[0].lstrip("+~") not in excluded]
        names.append(folder_name(SEPARATOR.join(pairs).replace("=", equals)))
    return names
