"""Standard deviations of single steps, fitted on validation drives."""

import numpy as np
import pytest
import torch

from odometry import SENSOR, build, random_scans
from rcnn_odom.evaluation.scores import coverage, coverage_table
from rcnn_odom.geometry import FORWARD_CAMERA, compose
from rcnn_odom.models.networks import Estimate, MotionHead
from rcnn_odom.models.uncertainty import Uncertainty
from rcnn_odom.recordings.cache import EncodedSequence
from rcnn_odom.training.checkpoint import calibrate, load_module


def drives(frames, seed):
    """Features, estimates and truth whose errors grow with the second feature."""
    rng = np.random.default_rng(seed)
    features = np.column_stack([np.ones(frames), rng.uniform(0, 3, (frames, 2))])
    truth = rng.normal(0, 1, (frames, 2))
    spread = np.column_stack([0.1 + 0.2 * features[:, 1], 0.01 + 0.02 * features[:, 2]])
    return features, truth + spread * rng.normal(0, 1, (frames, 2)), truth, spread


def fitted(seed=0):
    features, motions, truth, _ = drives(3000, seed)
    uncertainty = Uncertainty(recurrent=False)
    uncertainty.fit(features, motions, truth, np.array([0.5, 0.4]), np.full(5, 0.1))
    return uncertainty


def test_deviations_cover_other_drives_of_the_same_kind():
    features, motions, truth, spread = drives(3000, seed=1)
    deviations = features @ fitted().weights.double().numpy().T
    report = coverage(motions, truth, deviations)
    for output in ("distance", "heading"):
        assert report[output]["1"] == pytest.approx(0.683, abs=0.03)
        assert report[output]["2"] == pytest.approx(0.954, abs=0.02)
    np.testing.assert_allclose(deviations, spread, rtol=0.35)
    hard = features[:, 1] > 2
    assert coverage(motions[hard], truth[hard], deviations[hard])["distance"]["1"] == pytest.approx(
        0.683, abs=0.05
    )


def test_the_fit_covers_68_percent_of_its_own_errors_and_is_positive():
    features, motions, truth, _ = drives(1000, seed=2)
    uncertainty = Uncertainty(recurrent=False)
    uncertainty.fit(features, motions, truth, np.array([0.5, 0.4, 0.6]), np.array([0.1, 5.0, 0.1]))
    deviations = features @ uncertainty.weights.double().numpy().T
    assert coverage(motions, truth, deviations)["distance"]["1"] == pytest.approx(0.6827, abs=0.002)
    assert (uncertainty.weights >= 0).all()
    assert (uncertainty.weights[:, 0] > 0).all()
    assert float(uncertainty.least_filled) == pytest.approx(0.2)
    assert float(uncertainty.period) == pytest.approx(0.1)


def test_perfect_validation_still_gives_positive_deviations():
    features, _, truth, _ = drives(50, seed=0)
    uncertainty = Uncertainty(recurrent=False)
    uncertainty.fit(features, truth.copy(), truth, np.array([0.5]), np.zeros(3))
    assert (features @ uncertainty.weights.double().numpy().T > 0).all()
    assert torch.isnan(uncertainty.period), "stamps that stand still"


def test_heading_errors_go_the_short_way_round():
    features, motions, truth, _ = drives(500, seed=3)
    turned = truth.copy()
    turned[:, 1] += 2 * np.pi
    plain, wrapped = Uncertainty(recurrent=False), Uncertainty(recurrent=False)
    plain.fit(features, motions, truth, np.array([0.5]), np.ones(1))
    wrapped.fit(features, motions, turned, np.array([0.5]), np.ones(1))
    torch.testing.assert_close(plain.weights, wrapped.weights, rtol=1e-4, atol=1e-6)


def test_features_are_what_the_docstring_says():
    head = MotionHead(4, None, "expectation")
    head.deviation.copy_(torch.tensor([0.5, 0.1]))
    motion, first = torch.tensor([[[-1.0, 0.2]]]), torch.tensor([[[-0.5, 0.1]]])
    alone = Uncertainty(recurrent=False).features(Estimate(motion, None), head)
    torch.testing.assert_close(alone, torch.tensor([[[1.0, 2.0, 2.0]]]))
    both = Uncertainty(recurrent=True).features(Estimate(motion, None, first), head)
    torch.testing.assert_close(both, torch.tensor([[[1.0, 2.0, 2.0, 1.0, 1.0]]]))


def test_calibrating_changes_the_uncertainty_of_a_checkpoint_alone(tmp_path):
    module = build(fitted=False)
    path = tmp_path / "best.ckpt"
    torch.save({"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams)}, path)
    scans = random_scans(80)
    estimate = module.estimate(torch.from_numpy(scans))
    truth = compose(estimate.motions + np.random.default_rng(0).normal(0, [0.1, 0.02], (79, 2)))
    sequence = EncodedSequence("a", "k", scans, truth, np.arange(80.0), FORWARD_CAMERA)
    calibrated = calibrate(path, [sequence])
    loaded = load_module(path, sensor=SENSOR)
    assert calibrated.uncertainty.fitted
    assert loaded.uncertainty.fitted
    again = loaded.estimate(torch.from_numpy(scans))
    np.testing.assert_array_equal(again.motions, estimate.motions)
    report = coverage(again.motions, sequence.motions, again.deviations)
    assert report["distance"]["1"] == pytest.approx(0.68, abs=0.02)
    assert [file.name for file in tmp_path.iterdir()] == ["best.ckpt"]
    assert f" {100 * report['distance']['1']:.1f} " in coverage_table({"a": report})
