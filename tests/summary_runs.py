"""Run folders as trainings leave them, with numbers that a test chooses."""

import json

import numpy as np
import yaml

from rcnn_odom.recordings.trajectory import write_kitti, write_tum

FRAMES = {"05": 401, "07": 301}
LENGTHS = [50.0, 100.0, 150.0]


def settings_of(options):
    """A resolved configuration, nested, with some options (dotted names) set."""
    settings = {
        "seed": 0,
        "outputs": "outputs",
        "run_dir": "run",
        "data": {
            **{
                "name": "simulated",
                "world": "street",
                "scale": "small",
                "test": ["05", "07"],
                "workers": None,
            },
            **{"lengths": LENGTHS, "realism": {"tilt": True}, "sensor": {"max_range": 80.0}},
        },
        "model": {"variant": "cnn_cls", "kernel_size": 3, "pooling": "avg", "beta": 1.0},
        "trainer": {"precision": "auto"},
    }
    for name, value in options.items():
        *path, last = name.split(".")
        part = settings
        for key in path:
            part = part.setdefault(key, {})
        part[last] = value
    return settings


def method(drifts, frame=0.05, floor=0.004):
    """``test`` of a ``metrics.json``: drift (ratio) by sequence; errors of a frame grow with its name."""
    sequences = {}
    for name, drift in drifts.items():
        error = frame * int(name)
        sequences[name] = {
            "frames": FRAMES[name],
            "drift": {
                **{"t_err": drift, "r_err_deg_per_m": drift / 10, "t_rmse": 2 * drift, "segments": 40},
                "per_length": {
                    f"{length:g}": {"segments": 12, "t_err": drift, "r_err_deg_per_m": drift / 10}
                    for length in LENGTHS
                },
            },
            "floor": {"t_err": floor, "r_err_deg_per_m": 0.001, "t_rmse": floor, "segments": 40},
            "distance_mae_m": error,
            "distance_bias_m": -error / 2,
            "distance_max_m": 3 * error,
            "heading_mae_deg": 2 * error,
            "heading_bias_deg": error,
            "heading_max_deg": 6 * error,
        }
    drift = float(np.mean(list(drifts.values())))
    frames = [FRAMES[name] - 1 for name in drifts]
    mean, largest = np.average([frame * int(name) for name in drifts], weights=frames), frame * 7
    return {
        "drift": drift,
        "floor": floor,
        "lengths": LENGTHS,
        "metrics": {
            **{"drift": drift, "rotation_deg_per_m": drift / 10},
            **{"distance_mae_m": mean, "distance_bias_m": -mean / 2, "distance_max_m": 3 * largest},
            **{"heading_mae_deg": 2 * mean, "heading_bias_deg": mean, "heading_max_deg": 6 * largest},
        },
        "sequences": sequences,
    }


def older(report):
    """The same as version 0.1 wrote it."""
    return {key: value for key, value in report.items() if key != "metrics"}


def metrics_of(settings, drifts, **changes):
    metrics = {
        "fingerprint": "0123456789abcdef",
        "seed": settings["seed"],
        "variant": settings["model"]["variant"],
        "data": settings["data"]["name"],
        "val": {"drift": 0.2, "lengths": LENGTHS},
        "test": method(drifts),
        "baselines": {"held_motion": method({"05": 0.5, "07": 0.7})},
        "versions": {"torch": "2.13.0", "numpy": "2.4.6"},
        "latency": {"median_ms": 4.0, "p99_ms": 6.0, "threads": 1, "frames": 700},
        "training": {"seconds": 90.0, "epochs": 2},
    }
    metrics |= changes
    return {key: value for key, value in metrics.items() if value is not None}


def begin_run(folder, overrides, **options):
    """A run that has written its configuration and nothing else; returns its settings."""
    given = {key: yaml.safe_load(value) for key, value in (text.split("=", 1) for text in overrides)}
    named = {
        {"model": "model.variant", "data": "data.name"}.get(key, key): value for key, value in given.items()
    }
    settings = settings_of({**named, **options})
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    (folder / "config.yaml").write_text(yaml.safe_dump(settings))
    return settings


def finish_run(folder, overrides, drifts, options=None, **changes):
    """A finished run, without trajectories; ``changes`` replace what its ``metrics.json`` holds."""
    settings = begin_run(folder, overrides, **(options or {}))
    (folder / "metrics.json").write_text(json.dumps(metrics_of(settings, drifts, **changes)))


def drive(frames, pace=1.0, turn=0.0):
    """Camera poses (N, 4, 4) of a winding drive: ``pace`` times as far, by ``turn`` a frame too much."""
    time = np.arange(frames)
    steps = pace * (0.9 + 0.5 * np.sin(time[1:] / 40))
    heading = np.concatenate([[0.0], np.cumsum(0.02 * np.sin(time[1:] / 25) + turn)])
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(heading)
    poses[:, 0, 2], poses[:, 2, 0] = np.sin(heading), -np.sin(heading)
    poses[1:, 0, 3] = np.cumsum(steps * np.sin(heading[1:]))
    poses[1:, 2, 3] = np.cumsum(steps * np.cos(heading[1:]))
    return poses


def write_trajectories(folder, pace=1.05, turn=0.001):
    """Trajectories of both test sequences with their truth, ten frames a second."""
    (folder / "trajectories").mkdir()
    for name, frames in FRAMES.items():
        estimate = drive(frames, pace, turn)
        write_kitti(folder / "trajectories" / f"{name}_truth.txt", drive(frames))
        write_kitti(folder / "trajectories" / f"{name}.txt", estimate)
        write_tum(folder / "trajectories" / f"{name}.tum", 0.1 * np.arange(frames), estimate)
