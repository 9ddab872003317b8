"""Scores a finished run again, also on other data: ``python evaluate.py run=outputs/latest``.

Or a model that does not train and so has no run: ``python evaluate.py model=matcher data=simulated``.
Or many methods beside each other: ``python evaluate.py -m +sweeps=peers``.
"""

import sys

import hydra
from omegaconf import DictConfig

from rcnn_odom.training.job import run_command, run_job


def evaluate(cfg: DictConfig) -> dict:
    """Scores a run or a model, or measures a method on many sets of recordings: see the functions called."""
    # Here and not above: `--help` and a mistyped option should not wait for torch.
    from rcnn_odom.training import scoring

    if cfg.get("benchmark"):
        from rcnn_odom.training.benchmark.job import run_benchmark

        return run_benchmark(cfg)

    return scoring.evaluate(cfg)


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(cfg: DictConfig) -> float | None:
    """Runs one job; its test drift, if it has one."""
    metrics = run_job(evaluate, cfg)
    return metrics["test"]["drift"] if metrics and "test" in metrics else None


if __name__ == "__main__":
    sys.exit(run_command(main))
