"""Trains and scores one variant: ``python train.py model=rcnn_reg data=kitti data.root=DIR``."""

import logging
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

sys.path.insert(0, str(Path(__file__).parent / "src"))

from rcnn_odom.errors import InputError

log = logging.getLogger("rcnn_odom")
failed: list[InputError] = []


def train(cfg: DictConfig) -> dict:
    """Everything that one run does; returns what its ``metrics.json`` holds.

    Raises:
        InputError: see its message.
    """
    # Here and not above: `--help` and a mistyped option should not wait for torch.
    from rcnn_odom import experiment

    settings = experiment.plain(cfg)
    run = experiment.start_run(settings)
    trainer = experiment.build_trainer(settings, run)
    datamodule = experiment.build_datamodule(settings).load()
    module = experiment.build_module(settings, datamodule)
    if module.recurrent:
        module.load_first_stage(experiment.first_stage(settings, datamodule))
    module = experiment.fit(trainer, module, datamodule, run)
    return experiment.finish_run(settings, trainer, module, datamodule, run)


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(cfg: DictConfig) -> float | None:
    """Runs one job; the validation drift is what a sweep would minimise."""
    cfg.run_dir = HydraConfig.get().runtime.output_dir
    try:
        return train(cfg)["val"]["drift"]
    except InputError as error:
        # Remembered rather than raised: the other jobs of a sweep go on.
        log.error("error: %s", error)
        failed.append(error)
        return None


if __name__ == "__main__":
    main()
    sys.exit(1 if failed else 0)
