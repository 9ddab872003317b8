"""The torchmetrics class: equal to the functional, on one process and on two."""

import pickle
import socket

import numpy as np
import pytest
import torch

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import drift
from rcnn_odom.evaluation.drift_metric import DriftMetric

NAMES = ("05", "07", "10")
LENGTHS = (10.0, 20.0, 50.0)


def drive(seed, frames):
    """A planar truth with turns, and an estimate that is off in scale and heading; camera frame."""
    rng = np.random.default_rng(seed)
    turn, step = rng.normal(0, 0.05, frames - 1), rng.uniform(0.5, 1.5, frames - 1)

    def poses(turn, step):
        heading = np.concatenate([[0.0], np.cumsum(turn)])
        result = np.tile(np.eye(4), (frames, 1, 1))
        result[:, 0, 0] = result[:, 2, 2] = np.cos(heading)
        result[:, 0, 2], result[:, 2, 0] = np.sin(heading), -np.sin(heading)
        result[1:, 0, 3] = np.cumsum(step * np.sin(heading[1:]))
        result[1:, 2, 3] = np.cumsum(step * np.cos(heading[1:]))
        return result

    noise = rng.normal(0.001, 0.003, frames - 1)
    return poses(turn, step), poses(turn + noise, step * (1.01 + noise))


DRIVES = {
    name: drive(seed, frames) for seed, (name, frames) in enumerate(zip(NAMES, (150, 90, 300), strict=True))
}


def send(metric, *names):
    for name in names:
        metric.update(*DRIVES[name], name)
    return metric


def new_metric():
    return DriftMetric(NAMES, planar=True, lengths=LENGTHS)


def expected_values():
    """By the functional, sequence for sequence."""
    parts = {name: drift(*DRIVES[name], planar=True, lengths=LENGTHS) for name in NAMES}
    values = {f"drift/{name}": part.t_err for name, part in parts.items()}
    values |= {f"r_err_deg_per_m/{name}": part.r_err_deg_per_m for name, part in parts.items()}
    values["drift"] = np.mean([part.t_err for part in parts.values()])
    values["r_err_deg_per_m"] = np.mean([part.r_err_deg_per_m for part in parts.values()])
    return values


def as_floats(values):
    return {key: float(value) for key, value in values.items()}


def test_equals_the_functional():
    assert as_floats(send(new_metric(), *NAMES).compute()) == pytest.approx(expected_values(), rel=1e-12)


def test_takes_tensors_and_arrays_alike():
    metric = new_metric()
    for name in NAMES:
        truth, estimate = (torch.from_numpy(poses) for poses in DRIVES[name])
        metric.update(truth, estimate.requires_grad_(), name)
    assert as_floats(metric.compute()) == pytest.approx(expected_values(), rel=1e-12)


def test_passes_on_its_options():
    truth, estimate = DRIVES["10"]
    lifted = estimate.copy()
    lifted[:, 1, 3] = np.linspace(0, 30, len(lifted))
    for options in ({"planar": False, "lengths": (7.0,), "step": 3}, {"planar": True}):
        metric = DriftMetric(["10"], **options)
        metric.update(truth, lifted, "10")
        assert float(metric.compute()["drift"]) == pytest.approx(
            drift(truth, lifted, **options).t_err, rel=1e-12
        )


def test_a_sequence_sent_twice_counts_once():
    metric = send(new_metric(), *NAMES)
    before = as_floats(metric.compute())
    count = metric.count.clone()
    metric.update(DRIVES["05"][0], DRIVES["05"][0], "05")
    metric(*DRIVES["07"], "07")
    assert torch.equal(metric.count, count)
    assert as_floats(metric.compute()) == before


def test_a_sequence_without_segments_is_left_out():
    metric = send(new_metric(), "05")
    truth, estimate = DRIVES["07"]
    metric.update(truth[:5], estimate[:5], "07")
    expected = expected_values()
    values = as_floats(metric.compute())
    assert set(values) == {"drift", "drift/05", "r_err_deg_per_m", "r_err_deg_per_m/05"}
    assert values["drift"] == values["drift/05"] == pytest.approx(expected["drift/05"], rel=1e-12)


@pytest.mark.filterwarnings("ignore:The ``compute`` method")
def test_without_sequences_there_is_no_score():
    assert new_metric().compute() == {}
    metric = send(new_metric(), *NAMES)
    metric.reset()
    assert metric.compute() == {}


def test_stays_in_double_precision():
    metric = torch.nn.ModuleList([new_metric()]).to(torch.bfloat16).half()[0]
    assert metric.t_err_sum.dtype == metric.count.dtype == torch.float64
    assert as_floats(pickle.loads(pickle.dumps(send(metric, *NAMES))).compute()) == pytest.approx(
        expected_values(), rel=1e-12
    )


def test_refuses_what_it_cannot_score():
    metric = new_metric()
    with pytest.raises(ValueError, match="unknown sequence '01'"):
        metric.update(*DRIVES["05"], "01")
    with pytest.raises(ValueError, match="names must differ"):
        DriftMetric(["05", "05"])
    with pytest.raises(InputError, match="150 poses but the estimate 90"):
        metric.update(DRIVES["05"][0], DRIVES["07"][1], "05")
    bad = DRIVES["05"][1].copy()
    bad[11, 0, 3] = np.nan
    with pytest.raises(InputError, match="frame 11"):
        metric.update(DRIVES["05"][0], bad, "05")
    assert not metric.count.any()


SHARES = {
    "uneven": (["05", "10"], ["07"]),
    "one has none": (["05", "07", "10"], []),
    "padded": (["05", "10"], ["07", "05"]),
}


def on_one_rank(rank, port, folder):
    torch.distributed.init_process_group(
        "gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2
    )
    results = {
        case: as_floats(send(new_metric(), *shares[rank]).compute()) for case, shares in SHARES.items()
    }
    (folder / f"{rank}.pickle").write_bytes(pickle.dumps(results))
    torch.distributed.destroy_process_group()


@pytest.fixture(scope="module")
def two_processes(tmp_path_factory):
    """What both ranks computed, for every way of sharing the sequences."""
    folder = tmp_path_factory.mktemp("ranks")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.spawn(on_one_rank, args=(port, folder), nprocs=2)
    return [pickle.loads((folder / f"{rank}.pickle").read_bytes()) for rank in range(2)]


@pytest.mark.parametrize("case", SHARES)
@pytest.mark.slow
def test_two_processes_equal_one(two_processes, case):
    alone = as_floats(send(new_metric(), *NAMES).compute())
    for results in two_processes:
        assert results[case] == pytest.approx(alone, rel=1e-9)
