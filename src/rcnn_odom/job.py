"""What stands around a Hydra job: mistakes of the user become one line and an exit status."""

import logging
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from rcnn_odom.errors import InputError

log = logging.getLogger(__name__)

Result = TypeVar("Result")
_failed: list[Exception] = []


def run_job(job: Callable[[DictConfig], Result], cfg: DictConfig) -> Result | None:
    """The job's result in the folder that Hydra gave it; None after a mistake, which has been told.

    Raises:
        KeyboardInterrupt: stopped, which also stops a sweep.

    The mistake is remembered for :func:`run_command` and not raised: the other jobs of a sweep go on.
    """
    folder, here = Path(HydraConfig.get().runtime.output_dir), Path.cwd()
    cfg.run_dir = str(folder.relative_to(here) if folder.is_relative_to(here) else folder)
    try:
        return job(cfg)
    except SystemExit:  # how Lightning ends after Ctrl-C
        raise KeyboardInterrupt from None
    except (InputError, OSError) as error:
        log.error("error: %s", error)
        _failed.append(error)
        return None


def run_command(main: Callable[[], object]) -> int:
    """Runs a function decorated with ``hydra.main``; the exit status: 1 after a mistake of the user."""
    # Hydra would print and exit by itself, also where a folder cannot be made.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    try:
        main()
    except KeyboardInterrupt:
        return 130
    except (HydraException, OmegaConfBaseException, OSError) as error:
        # What follows is Hydra's own place in the configuration, not the user's mistake.
        message = re.split(r"\s+(?:full_key:|Config search path:)", str(error))[0]
        hint = "; choose another outputs= or run_dir=" if isinstance(error, OSError) else ""
        print(f"error: {' '.join(message.split())}{hint}", file=sys.stderr)
        return 1
    return 1 if _failed else 0
