"""What the jobs of a sweep need to know of each other: their folders, and whose turn it is."""

import hashlib
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

log = logging.getLogger(__name__)

LONGEST_NAME = 120
SEPARATOR = "__"
"""Between the overrides in a name: no comma, which Hydra would take for a sweep."""


def folder_name(overrides: str) -> str:
    """The name of a job's folder: its overrides, so that the same command finds it again.

    Args:
        overrides: ``hydra.job.override_dirname``, such as ``model-cnn_cls__seed-0``.

    Returns:
        The same, what is told of the data and the trainer last. Characters that folders should not have are
        replaced and long names cut; a hash then keeps apart what was different.
    """
    pairs = sorted(overrides.split(SEPARATOR), key=lambda pair: (pair.startswith(("data", "trainer")), pair))
    wanted = SEPARATOR.join(pairs)
    name = re.sub(r"[^\w.~+-]+", "_", wanted)
    if name == wanted and len(name) <= LONGEST_NAME:
        return name or "defaults"
    return f"{name[:LONGEST_NAME]}-{hashlib.sha256(wanted.encode()).hexdigest()[:8]}"


OmegaConf.register_new_resolver("folder_name", folder_name, replace=True)


def expected_folders(sweep: Path) -> list[str] | None:
    """Names of the folders of all jobs that the last command of a grid sweep asked for.

    Args:
        sweep: its folder, with Hydra's ``multirun.yaml``.

    Returns:
        None where that cannot be known: no such file, or a sweeper that draws its jobs.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

    try:
        settings = OmegaConf.load(sweep / "multirun.yaml").hydra
        if draws_its_jobs(settings.sweeper._target_):
            return None
        swept = [f"{key}={value}" for key, value in (settings.sweeper.params or {}).items()]
        overrides = OverridesParser.create().parse_overrides([*swept, *settings.overrides.task])
        (jobs,) = BasicSweeper.split_arguments(overrides, None)
    except (OSError, OmegaConfBaseException, HydraException, AttributeError):
        return None
    naming = settings.job.config.override_dirname
    names = []
    for job in jobs:
        pairs = [pair for pair in job if pair.split("=")[0].lstrip("+~") not in naming.exclude_keys]
        names.append(folder_name(SEPARATOR.join(pairs).replace("=", naming.kv_sep)))
    return names


@contextmanager
def one_at_a_time(outputs: Path, fingerprint: str) -> Iterator[None]:
    """Lets one process at a time train what this fingerprint stands for; the others wait.

    The lock ends with its process, however that ends. On a network file system it needs working
    ``flock``, as NFS 4 and Lustre have.
    """
    folder = outputs / "cache"
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / f".{fingerprint}.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        log.info("another process is training the same; waiting for it")
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def draws_its_jobs(sweeper: str) -> bool:
    """Whether a sweeper, a class' full name, draws values, unlike Hydra's own, which goes through a grid."""
    return not sweeper.endswith(".BasicSweeper")
