"""Entry points of ``rcnn-odom train`` and ``rcnn-odom evaluate``, and of ``train.py`` and ``evaluate.py``."""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import hydra
from omegaconf import DictConfig

from rcnn_odom.training.job import in_sweep, run_command, run_job

CONF = str((Path(__file__).parents[1] / "conf").resolve())
"""The folder of Hydra's configuration: a link to ``conf`` in a checkout, a copy of it in a wheel."""


def train(cfg: DictConfig, *, reuse: bool = False) -> dict | None:
    """Trains and tests one run: see :func:`rcnn_odom.training.stages.train`."""
    # Imported here, so that `--help` and a mistyped option do not wait for torch.
    from rcnn_odom.training import stages
    from rcnn_odom.training.settings import plain

    return stages.train(plain(cfg), reuse=reuse)


def evaluate(cfg: DictConfig) -> dict:
    """Scores a run or a model, or measures a method on many sets of recordings (``benchmark``)."""
    from rcnn_odom.training import scoring

    if cfg.get("benchmark"):
        from rcnn_odom.training.benchmark.job import run_benchmark

        return run_benchmark(cfg)

    return scoring.evaluate(cfg)


@hydra.main(version_base="1.3", config_path=CONF, config_name="config")
def _train_job(cfg: DictConfig) -> float | None:
    """Runs one job; returns its validation drift, which an optimising sweeper minimises."""
    metrics = run_job(partial(train, reuse=in_sweep()), cfg)
    return None if metrics is None else metrics["val"]["drift"]


@hydra.main(version_base="1.3", config_path=CONF, config_name="evaluate")
def _evaluate_job(cfg: DictConfig) -> float | None:
    """Runs one job; returns its test drift, or None if it has none."""
    metrics = run_job(evaluate, cfg)
    return metrics["test"]["drift"] if metrics and "test" in metrics else None


def run_train(arguments: Sequence[str]) -> int:
    """Trains and tests; returns the exit status.

    Args:
        arguments: arguments of Hydra, such as ``model=rcnn_reg`` or ``--multirun``.
    """
    return _run(_train_job, arguments)


def run_evaluate(arguments: Sequence[str]) -> int:
    """Scores a trained run or a model without training; returns the exit status.

    Args:
        arguments: arguments of Hydra, such as ``run=outputs/latest``.
    """
    return _run(_evaluate_job, arguments)


def _run(job: Callable[[], object], arguments: Sequence[str]) -> int:
    sys.argv[1:] = arguments  # Hydra reads its arguments there.
    return run_command(job)
