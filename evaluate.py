"""Scores a finished run again, also on other data: ``python evaluate.py run=outputs/latest``.

Or scan matching, which has no run: ``python evaluate.py model=icp data=simulated``.
"""

import logging
import sys

import hydra
from omegaconf import DictConfig

from rcnn_odom.training.job import run_command, run_job

log = logging.getLogger("rcnn_odom")


def evaluate(cfg: DictConfig) -> dict:
    """Scores a run's best checkpoint, or scan matching; what its ``metrics.json`` holds.

    Raises:
        InputError: see its message.
    """
    from pathlib import Path

    from rcnn_odom.errors import InputError
    from rcnn_odom.training import run_state as runs
    from rcnn_odom.training.settings import plain

    variant = cfg.model.variant if cfg.get("model") else None
    if variant not in (None, "icp"):
        raise InputError(
            f"model={variant}: a trained network is scored by its run, run=outputs/...; leave out model="
        )
    if variant and not cfg.get("data"):
        raise InputError("model=icp needs recordings: add data=simulated, indoor, kitti or carmen")
    chosen = plain(cfg)
    settings, metrics = _match_scans(chosen) if variant else _estimate_run(chosen)
    folder = Path(chosen["run_dir"])
    runs.write_config(folder, settings)
    runs.write_json(folder / runs.METRICS, metrics)
    log.info("all of it is in %s", folder)
    return metrics


def _estimate_run(chosen: dict) -> tuple[dict, dict]:
    """Settings and metrics of a run's network on its own test sequences, or on those of ``data``."""
    import os
    from pathlib import Path

    from rcnn_odom.evaluation.run_report import report_test
    from rcnn_odom.models.encoding import Sensor
    from rcnn_odom.training import run_state as runs
    from rcnn_odom.training import stages as experiment
    from rcnn_odom.training.checkpoint import load_module

    run, folder = Path(chosen["run"]), Path(chosen["run_dir"])
    settings = runs.read_settings(run)
    settings |= {key: chosen[key] for key in ("data", "trainer", "outputs") if chosen.get(key)}
    trainer = experiment.build_trainer(settings)
    module = load_module(run / runs.BEST, sensor=Sensor(**settings["data"]["sensor"]))
    datamodule = experiment.build_datamodule(settings).load(("test",))
    estimates = experiment.estimate_test(module, datamodule, trainer)
    metrics = {
        "run": os.path.relpath(run.resolve()),
        "variant": module.variant,
        "data": settings["data"]["name"],
    }
    metrics |= report_test(module, estimates, datamodule.sequences["test"], settings["data"], folder)
    return settings, metrics


def _match_scans(chosen: dict) -> tuple[dict, dict]:
    """Settings and metrics of scan matching on the test sequences of ``data``."""
    from pathlib import Path

    from hydra.utils import instantiate

    from rcnn_odom.evaluation.run_report import report_icp
    from rcnn_odom.models.constant import mean_motion
    from rcnn_odom.models.encoding import Sensor
    from rcnn_odom.models.icp import PointToLineICP
    from rcnn_odom.training.datamodule import OdometryDataModule

    data, sensor = chosen["data"], Sensor(**chosen["data"]["sensor"])
    icp = PointToLineICP(sensor, **{key: value for key, value in chosen["model"].items() if key != "variant"})
    read = instantiate({**data["reader"], "_partial_": True, "_convert_": "all"})
    cache = Path(chosen["outputs"]) / "cache"
    names = data["train"], data["val"], data["test"]
    datamodule = OdometryDataModule(read, *names, sensor, cache, workers=data["workers"]).load(("test",))
    sequences = datamodule.sequences["test"]
    mean = mean_motion(read, data["train"])
    steps = {sequence.name: icp.estimate(sequence.scans) for sequence in sequences}
    report = report_icp(icp, steps, mean, sequences, data, Path(chosen["run_dir"]))
    settings = {key: value for key, value in chosen.items() if key not in ("run", "trainer")}
    return settings, {"variant": "icp", "data": data["name"], **report}


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(cfg: DictConfig) -> float | None:
    """Runs one job; its test drift."""
    metrics = run_job(evaluate, cfg)
    return None if metrics is None else metrics["test"]["drift"]


if __name__ == "__main__":
    sys.exit(run_command(main))
