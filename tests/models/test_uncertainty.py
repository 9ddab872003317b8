"""Standard deviations and covariances of single steps, fitted on validation drives."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from odometry import NAMES, build, random_scans
from rcnn_odom.geometry import FORWARD_CAMERA, compose
from rcnn_odom.models.two_numbers import TURN_FRACTION, steps_of
from rcnn_odom.models.uncertainty import Uncertainty, two_number_errors
from rcnn_odom.recordings.recording import Drive

torch.set_num_threads(1)


def drives(frames, seed):
    """Features and errors that grow with the second and third feature; their true deviations."""
    rng = np.random.default_rng(seed)
    features = np.column_stack([np.ones(frames), rng.uniform(0, 3, (frames, 2))])
    spread = np.column_stack(
        [0.1 + 0.2 * features[:, 1], 0.01 + 0.02 * features[:, 2], np.full(frames, 0.05)]
    )
    return features, spread * rng.normal(0, 1, (frames, 3)), spread


def fitted(frames=3000, seed=0):
    features, errors, _ = drives(frames, seed)
    uncertainty = Uncertainty(recurrent=False)
    uncertainty.fit(features, errors)
    return uncertainty


def within(errors, deviations, times=1):
    return (np.abs(errors) <= times * deviations).mean(0)


def deviations_of(uncertainty, features):
    return features @ uncertainty.weights.double().numpy().T


def test_deviations_cover_other_drives_of_the_same_kind():
    features, errors, spread = drives(3000, seed=1)
    deviations = deviations_of(fitted(), features)
    np.testing.assert_allclose(within(errors[:, :2], deviations), 0.683, atol=0.03)
    np.testing.assert_allclose(within(errors[:, :2], deviations, 2), 0.954, atol=0.02)
    np.testing.assert_allclose(deviations, spread[:, :2], rtol=0.35)
    hard = features[:, 1] > 2
    assert within(errors[hard, 0], deviations[hard, 0]) == pytest.approx(0.683, abs=0.05)
    assert float(fitted().lateral) == pytest.approx(0.05, rel=0.05)


def test_the_fit_covers_68_percent_of_its_own_errors_and_is_positive():
    features, errors, _ = drives(1000, seed=2)
    uncertainty = fitted(1000, seed=2)
    deviations = deviations_of(uncertainty, features)
    np.testing.assert_allclose(within(errors[:, :2], deviations), 0.6827, atol=0.002)
    assert within(errors[:, 2], float(uncertainty.lateral)) == pytest.approx(0.6827, abs=0.002)
    assert (uncertainty.weights >= 0).all()
    assert (uncertainty.weights[:, 0] > 0).all()


def test_perfect_validation_still_gives_positive_deviations():
    features, errors, _ = drives(50, seed=0)
    uncertainty = Uncertainty(recurrent=False)
    uncertainty.fit(features, 0 * errors)
    assert (deviations_of(uncertainty, features) > 0).all()
    assert uncertainty.lateral > 0


@pytest.mark.parametrize("apply", TURN_FRACTION)
def test_errors_are_told_along_and_across_the_estimated_step(apply):
    motions = np.array([[2.0, 0.4], [-1.0, 0.1]])
    direction = TURN_FRACTION[apply] * motions[:, 1]
    left = np.stack([-np.sin(direction), np.cos(direction), np.zeros(2)], 1)
    exact = two_number_errors(motions, steps_of(motions, apply) + 0.3 * left, apply)
    np.testing.assert_allclose(exact[:, 1:], [[0, -0.3], [0, -0.3]], atol=1e-12)
    if apply == "middle":  # only there the paper's distance is that along the step
        np.testing.assert_allclose(exact[:, 0], 0, atol=1e-12)
    turned = two_number_errors(motions, steps_of(motions, apply) + np.array([0, 0, 2 * np.pi]), apply)
    np.testing.assert_allclose(turned[:, 1], 0, atol=1e-9)


def test_features_are_what_the_docstring_says():
    deviation = torch.tensor([0.5, 0.1])
    motion, first = torch.tensor([[[-1.0, 0.2]]]), torch.tensor([[[-0.5, 0.1]]])
    alone = Uncertainty(recurrent=False).features(motion, deviation, None)
    torch.testing.assert_close(alone, torch.tensor([[[1.0, 2.0, 2.0]]]))
    both = Uncertainty(recurrent=True).features(motion, deviation, first)
    torch.testing.assert_close(both, torch.tensor([[[1.0, 2.0, 2.0, 1.0, 1.0]]]))


# --- covariances ---------------------------------------------------------------------------------

DRAWN = np.array([0.03, 0.02, 0.01])
"""Deviations of distance, across the step, and turn."""


def step_from(numbers, apply):
    """A step out of distance, the way to its left and turn, (..., 3), through complex numbers."""
    distance, left, turn = np.moveaxis(numbers, -1, 0)
    place = (distance + 1j * left) * np.exp(1j * TURN_FRACTION[apply] * turn)
    return np.stack([place.real, place.imag, turn], -1)


def covariance_of(apply, distance, turn, deviations=DRAWN):
    """What a model says of a step whose deviations are given."""
    model = build("cnn_reg", apply=apply)
    model.uncertainty.lateral.fill_(deviations[1])
    numbers = (
        torch.tensor([value], dtype=torch.float64) for value in (distance, TURN_FRACTION[apply] * turn)
    )
    variances = torch.from_numpy(np.square(deviations[None, [0, 2]]))
    return model._covariances(*numbers, variances)[0].double().numpy()


@pytest.mark.parametrize("apply", TURN_FRACTION)
@pytest.mark.parametrize(("distance", "turn"), [(1.5, 0.0), (1.5, 0.3), (-0.8, 0.5), (0.0, -0.4)])
def test_covariance_is_that_of_numerical_derivatives(apply, distance, turn):
    at, small = np.array([distance, 0.0, turn]), 1e-6
    jacobian = np.stack(
        [(step_from(at + h, apply) - step_from(at - h, apply)) / (2 * small) for h in small * np.eye(3)], 1
    )
    expected = jacobian @ np.diag(DRAWN**2) @ jacobian.T
    np.testing.assert_allclose(covariance_of(apply, distance, turn), expected, atol=1e-9)


@pytest.mark.parametrize("apply", TURN_FRACTION)
def test_covariance_is_that_of_drawn_steps(apply):
    numbers = np.random.default_rng(0).normal([1.5, 0.0, 0.4], DRAWN, (200_000, 3))
    expected = np.cov(step_from(numbers, apply).T)
    np.testing.assert_allclose(covariance_of(apply, 1.5, 0.4), expected, atol=1.5e-5)


def test_an_unknown_deviation_across_leaves_that_of_the_heading():
    found = covariance_of("middle", 1.5, 0.4, np.array([0.03, np.nan, 0.01]))
    assert found[2, 2] == pytest.approx(1e-4)
    assert np.isnan(found).sum() == 8


@pytest.mark.parametrize("variant", NAMES)
def test_forward_gives_the_step_and_covariance_of_its_two_numbers(variant):
    model, scans = build(variant, apply="end"), torch.from_numpy(random_scans(4))
    pairs = torch.stack([scans[:-1], scans[1:]], 1)[None]
    with torch.no_grad():
        steps, covariances, _ = model(pairs)
        estimate, _ = model.motions(pairs)
        features = model.uncertainty.features(estimate.motion, model.head.deviation, estimate.first_stage)
    motions = estimate.motion[0].double().numpy()
    np.testing.assert_allclose(steps[0], steps_of(motions, "end"), atol=1e-6)
    deviations = deviations_of(model.uncertainty, features[0].double().numpy())
    for frame, (distance, turn) in enumerate(motions):
        spread = np.insert(deviations[frame], 1, float(model.uncertainty.lateral))
        expected = covariance_of("end", distance, turn, spread)
        np.testing.assert_allclose(covariances[0, frame], expected, rtol=1e-4, atol=1e-7)
    assert torch.isnan(build(variant, fitted=False)(pairs)[1]).all()


# --- calibration ---------------------------------------------------------------------------------


def validation(model, scans, sideways=0.0, period=1.0):
    """A drive whose truth is what a model estimates, and noise."""
    frames = len(scans)
    stamps = period * np.arange(frames)
    drive = Drive("a", "k", scans, np.tile(np.eye(4), (frames, 1, 1)), stamps, FORWARD_CAMERA)
    noise = np.random.default_rng(0).normal(0, [0.1, sideways, 0.02], (frames - 1, 3))
    return replace(drive, poses=compose(model.estimate(drive).values + noise))


@pytest.mark.parametrize("variant", NAMES)
def test_calibrating_fits_the_uncertainty_alone(variant):
    model, scans = build(variant, fitted=False), random_scans(150)
    drive = validation(model, scans, sideways=0.05, period=0.2)
    before = {name: value.clone() for name, value in model.named_parameters()}
    values = model.estimate(drive).values
    assert not model.calibrated
    model.calibrate([drive])
    assert model.calibrated
    after = model.estimate(drive)
    np.testing.assert_array_equal(after.values, values)
    assert all(torch.equal(value, before[name]) for name, value in model.named_parameters())
    heading = np.sqrt(after.covariances[:, 2, 2])
    assert within(after.values[:, 2] - drive.steps[:, 2], heading) == pytest.approx(0.68, abs=0.02)
    assert float(model.uncertainty.lateral) == pytest.approx(0.05, rel=0.2)
    assert model.describe().period == pytest.approx(0.2)
    assert np.linalg.eigvalsh(after.covariances).min() > 0


@pytest.mark.parametrize("empty", [0, 1])
def test_an_empty_validation_scan_does_not_switch_off_the_note_on_few_returns(empty):
    model, scans = build("cnn_reg", fitted=False), np.ones((100, 181), np.float32)
    scans[:, 90:] = 0
    scans[50 : 50 + empty] = 0
    model.calibrate([validation(model, scans)])
    assert model.describe().least_filled == pytest.approx(0.5 * 90 / 181)


def test_stamps_that_stand_still_tell_no_period():
    model = build("cnn_reg", fitted=False)
    model.calibrate([validation(model, random_scans(30), period=0.0)])
    assert np.isnan(model.describe().period)
    assert model.calibrated
