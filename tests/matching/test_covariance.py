"""Covariances against a Monte Carlo of the errors that they are of."""

import numpy as np
import pytest

from rcnn_odom.matching.covariance import (
    CORRELATED,
    DRIFTS,
    Aligned,
    Uncertainty,
    hold_undetermined,
    weakest_direction,
)


def spread(rng, size):
    """A covariance (3, 3) with errors that go together."""
    half = rng.standard_normal((3, 3)) * size
    return half @ half.T + 0.01 * np.diag(np.square(size))


@pytest.mark.parametrize("seed", range(3))
def test_the_filter_tells_the_spread_of_drawn_errors(seed):
    """Errors are drawn, and carried along by the equations of the linear model, with gains found by numpy."""
    rng, draws = np.random.default_rng(seed), 40_000
    uncertainty, errors, poses = Uncertainty(), np.zeros((draws, 3)), [np.zeros(3)]
    told = np.zeros((3, 3))
    for _ in range(4):
        before, after = poses[-1], poses[-1] + rng.uniform(-0.5, 0.5, 3)
        guess, match = spread(rng, np.array([0.05, 0.05, 0.02])), spread(rng, np.array([0.02, 0.03, 0.01]))
        moved = np.eye(3)
        moved[:2, 2] = [-(after - before)[1], (after - before)[0]]
        carried = errors @ moved.T
        prior = moved @ told @ moved.T + guess
        gain = prior @ np.linalg.inv(prior + match)
        noise = rng.multivariate_normal(np.zeros(3), match, draws)
        guessed = carried + rng.multivariate_normal(np.zeros(3), guess, draws)
        later = guessed + (noise - guessed) @ gain.T
        step, back = later - carried, noise @ gain.T
        far, turn = np.hypot(*(after - before)[:2]), abs((after - before)[2])
        drift = np.sqrt(DRIFTS[0] * far + DRIFTS[1] * turn)
        step = step + drift * rng.multivariate_normal(np.zeros(3), gain @ match @ gain.T, draws)
        found = uncertainty.update(before, after, guess, np.linalg.inv(match))
        told = (np.eye(3) - gain) @ prior
        for drawn, covariance, heading in ((step, found[0], before[2]), (back, found[1], after[2])):
            cos, sin = np.cos(heading), np.sin(heading)
            seen = drawn @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
            want, scale = np.cov(seen.T), np.sqrt(np.diag(covariance))
            np.testing.assert_allclose(
                covariance / np.outer(scale, scale), want / np.outer(scale, scale), atol=0.05
            )
        scale = np.sqrt(np.diag(told))
        np.testing.assert_allclose(
            uncertainty.pose / np.outer(scale, scale), told / np.outer(scale, scale), atol=1e-6
        )
        errors = later
        poses.append(after)


def test_without_a_match_the_step_is_as_wrong_as_its_guess():
    uncertainty, guess = Uncertainty(), np.diag([0.04, 0.01, 0.002])
    for n in range(1, 4):
        step, back = uncertainty.update(np.zeros(3), np.zeros(3), guess, np.zeros((3, 3)))
        np.testing.assert_allclose(step, guess)
        np.testing.assert_allclose(back, 0.0)
        np.testing.assert_allclose(uncertainty.pose, n * guess)


def match_with(information, pose=(0.3, 0.2, 0.1)):
    return Aligned(np.array(pose), 0.9, 0.9, np.asarray(information, dtype=float), 200.0, 1e-4, 1.0)


def test_in_a_corridor_the_guess_stands_along_it():
    along = np.array([np.cos(0.5), np.sin(0.5)])
    across = np.array([-along[1], along[0]])
    information = np.zeros((3, 3))
    information[:2, :2] = 0.8 * np.outer(across, across) + 1e-5 * np.outer(along, along)
    information[2, 2] = 4.0
    aligned = match_with(information)
    guess = np.array([1.0, 0.7, 0.05])
    pose, held, told = hold_undetermined(aligned, guess, np.eye(3))
    assert held.shape == (3, 1)
    assert abs(held[:2, 0] @ along) == pytest.approx(1.0, abs=1e-6)
    off = aligned.pose - guess
    assert (pose - guess)[:2] @ along == pytest.approx(0.0, abs=1e-3)
    assert (pose - guess)[:2] @ across == pytest.approx(off[:2] @ across, rel=1e-3)
    assert pose[2] == pytest.approx(0.1, rel=1e-3)
    assert told[:2, :2] @ along == pytest.approx(np.zeros(2), abs=1e-2 * told[2, 2])
    weak = weakest_direction(aligned)
    assert abs(weak[:2] @ along) == pytest.approx(1.0)


def test_what_is_determined_stands_as_it_was_found():
    aligned = match_with(np.diag([0.5, 0.5, 4.0]), pose=(0.3, 0.2, 0.1 + 2 * np.pi))
    pose, held, told = hold_undetermined(aligned, np.zeros(3), np.eye(3))
    assert held.shape == (3, 0)
    np.testing.assert_allclose(pose, aligned.pose, atol=1e-3)
    # About n / variance, but less for what is weak: half of it where WEAK_INFORMATION is all there is.
    np.testing.assert_allclose(np.diag(told), 200 / CORRELATED / 1e-4 * np.array([0.5, 0.5, 4.0]), rtol=0.07)
    assert weakest_direction(aligned) is None


def test_in_a_round_room_the_heading_is_held():
    aligned = match_with(np.diag([0.5, 0.5, 0.0]))
    pose, held, _ = hold_undetermined(aligned, np.zeros(3), np.eye(3))
    np.testing.assert_allclose(np.abs(held[:, 0]), [0, 0, 1])
    np.testing.assert_allclose(pose, [0.3, 0.2, 0.0], atol=1e-3)
    assert weakest_direction(aligned) is None
