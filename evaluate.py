"""Scores a finished run again, also on other data: ``python evaluate.py run=outputs/latest``."""

import logging
import sys

import hydra
from omegaconf import DictConfig

from rcnn_odom.job import run_command, run_job

log = logging.getLogger("rcnn_odom")


def evaluate(cfg: DictConfig) -> dict:
    """Scores the run's best checkpoint on its own test sequences, or on those of ``cfg.data``.

    Raises:
        InputError: see its message.
    """
    import os
    from pathlib import Path

    from rcnn_odom import experiment, runs
    from rcnn_odom.checkpoint import load_module
    from rcnn_odom.report import report_test
    from rcnn_odom.scan import Sensor
    from rcnn_odom.settings import plain

    chosen = plain(cfg)
    run, folder = Path(chosen["run"]), Path(chosen["run_dir"])
    settings = runs.read_settings(run)
    settings |= {key: chosen[key] for key in ("data", "trainer", "outputs") if chosen.get(key)}
    trainer = experiment.build_trainer(settings)
    module = load_module(run / runs.BEST, sensor=Sensor(**settings["data"]["sensor"]))
    datamodule = experiment.build_datamodule(settings).load(("test",))
    motions = experiment.estimate_test(module, datamodule, trainer)
    runs.write_config(folder, settings)
    metrics = {
        "run": os.path.relpath(run.resolve()),
        "variant": module.variant,
        "data": settings["data"]["name"],
    }
    metrics |= report_test(module, motions, datamodule.sequences["test"], settings["data"], folder)
    runs.write_json(folder / runs.METRICS, metrics)
    log.info("all of it is in %s", folder)
    return metrics


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(cfg: DictConfig) -> float | None:
    """Runs one job; its test drift."""
    metrics = run_job(evaluate, cfg)
    return None if metrics is None else metrics["test"]["drift"]


if __name__ == "__main__":
    sys.exit(run_command(main))
