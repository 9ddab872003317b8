"""The setting that the others are compared with."""

from collections.abc import Sequence
from pathlib import Path

import yaml

from rcnn_odom.errors import InputError
from rcnn_odom.settings import flat
from rcnn_odom.summary.folders import HYDRA, Run
from rcnn_odom.summary.options import GROUPS, Values, parse_choice, show_value
from rcnn_odom.summary.runs_table import Sweep


def reference_setting(sweep: Sweep, wanted: Sequence[str] = ()) -> tuple[Values, str]:
    """The setting that the others are compared with, and in words why it is this one.

    Args:
        sweep: with at least one setting.
        wanted: ``KEY=VALUE`` of swept options that single it out; without any it is the configuration's
            default if that was swept, else the first.

    Raises:
        InputError: no setting has these values, or several have.
    """
    settings = list(sweep.counting())
    if wanted:
        return _chosen(sweep, settings, wanted), "chosen by --reference"
    default = _default_setting(sweep)
    if default in settings:
        return default, "the default"
    return settings[0], "the first, as the default is not " + ("among them" if default else "known")


def _chosen(sweep: Sweep, settings: list[Values], wanted: Sequence[str]) -> Values:
    pairs = [parse_choice(text) for text in wanted]
    short = {option.rsplit(".", 1)[-1]: option for option in sweep.options}
    found = [
        setting
        for setting in settings
        if all(
            show_value(dict(zip(sweep.options, setting, strict=True)).get(short.get(key, key))) == value
            for key, value in pairs
        )
    ]
    if len(found) != 1:
        several = "several settings have it" if found else "no setting has it"
        have = "; ".join(map(sweep.label, found or settings))
        raise InputError(f"--reference {' '.join(wanted)}: {several}: {have}")
    return found[0]


def _default_setting(sweep: Sweep) -> Values | None:
    """What the swept options are when no command sets them, by the configuration that the runs came from."""
    from hydra import compose, initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    run = next((run for run in sweep.runs if run.settings and run.overrides), None)
    folder = run and _configuration(run)
    if run is None or folder is None:
        return None
    kept = [override for override in run.overrides if not _is_swept(override, sweep.options)]
    try:
        with initialize_config_dir(str(folder), version_base="1.3"):
            config = compose("config", kept)
        parts = ("data", "model", "trainer")
        values = flat({part: OmegaConf.to_container(config[part], resolve=True) for part in parts})
    except (HydraException, OmegaConfBaseException):
        return None
    found = (values.get(option) for option in sweep.options)
    return tuple(tuple(value) if isinstance(value, list) else value for value in found)


def _is_swept(override: str, options: Sequence[str]) -> bool:
    key = override.lstrip("+~").split("=", 1)[0]
    return GROUPS.get(key, key) in options or key in ("sweeps", "seed", "run_dir", "outputs")


def _configuration(run: Run) -> Path | None:
    """The folder of configuration files that a run was started with, if it is still there."""
    try:
        hydra = yaml.safe_load((run.folder / HYDRA).read_text())["hydra"]
        sources = hydra["runtime"]["config_sources"]
        folder = next(Path(source["path"]) for source in sources if source["provider"] == "main")
    except (OSError, yaml.YAMLError, KeyError, TypeError, StopIteration):
        return None
    return folder if (folder / "config.yaml").is_file() else None
