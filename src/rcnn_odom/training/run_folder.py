"""Where ``python train.py`` works: in the folder of the same run that was stopped, or in a new one."""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcnn_odom.errors import InputError
from rcnn_odom.training.run_state import find_stopped
from rcnn_odom.training.settings import plain


def run_folder(new: str, *, _root_: DictConfig) -> str:
    """The folder of a run that was stopped and has the very same settings, else a new one.

    Args:
        new: the folder for a new run; older ones are looked for beside it.
        _root_: the whole configuration, which OmegaConf gives.
    """
    chosen = [str(key) for key in _root_ if key not in ("hydra", "run_dir")]
    try:
        settings = plain(OmegaConf.masked_copy(_root_, chosen))
    except (InputError, OmegaConfBaseException):  # will be told when the run begins
        return new
    stopped = find_stopped(Path(new).parent, settings)
    return new if stopped is None else str(stopped)


OmegaConf.register_new_resolver("run_folder", run_folder, replace=True)
