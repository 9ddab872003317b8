"""Drift against KITTI's own devkit, against a slow loop written like it, and by hand."""

import math
from cProfile import Profile

import numpy as np
import pytest

from conftest import SHARED
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import (
    KITTI_LENGTHS,
    drift,
    fitting_lengths,
    segment_errors,
    summarise,
    travelled,
)
from rcnn_odom.recordings.trajectory import flatten, read_kitti

EXAMPLES = SHARED / "data" / "kitti_eval_examples"
needs_examples = pytest.mark.skipif(
    not EXAMPLES.is_dir(), reason="KITTI's evaluation examples are not in ../shared/data/kitti_eval_examples"
)


def turned(roll, pitch, yaw):
    """Rotation about z, then x, then y of the camera frame."""
    (a, b, c), (d, e, f) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_z = np.array([[a, -d, 0], [d, a, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, b, -e], [0, e, b]])
    about_y = np.array([[c, 0, f], [0, 1, 0], [-f, 0, c]])
    return about_y @ about_x @ about_z


def random_drive(seed, frames=700):
    """A wandering 3D truth of about a metre a frame and an estimate with noise in every step."""
    rng = np.random.default_rng(seed)
    truth, estimate = np.tile(np.eye(4), (2, frames, 1, 1))
    for frame in range(1, frames):
        angles = rng.normal(0, [0.005, 0.005, 0.03])
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = turned(*angles), rng.normal([0, 0, 1], [0.02, 0.02, 0.4])
        truth[frame] = truth[frame - 1] @ step
        step[:3, :3] = turned(*(angles + rng.normal(0.0005, 0.002, 3)))
        step[:3, 3] += rng.normal(0.005, 0.02, 3)
        estimate[frame] = estimate[frame - 1] @ step
    return truth, estimate


def straight(frames, step=1.0):
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = step * np.arange(frames)
    return poses


def devkit_angle(pose):
    """`rotationError` of evaluate_odometry.cpp: matrices in double, the angle in single precision."""
    a, b, c = (np.float32(pose[i, i]) for i in range(3))
    return float(
        np.arccos(max(min(np.float32(0.5 * (float(a + b + c) - 1.0)), np.float32(1)), np.float32(-1)))
    )


def devkit_loop(truth, estimate, lengths, step=10):
    """`calcSequenceErrors` of evaluate_odometry.cpp, statement by statement."""
    dist = [0.0]
    for i in range(1, len(truth)):
        dist.append(dist[-1] + math.dist(truth[i - 1][:3, 3], truth[i][:3, 3]))
    rows = []
    for first in range(0, len(truth), step):
        for length in lengths:
            last = next((i for i in range(first, len(dist)) if dist[i] > dist[first] + length), -1)
            if last == -1:
                continue
            delta_gt = np.linalg.inv(truth[first]) @ truth[last]
            delta_result = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(delta_result) @ delta_gt
            t_err = math.hypot(*error[:3, 3]) / length
            rows.append((first, last, length, t_err, devkit_angle(error) / length))
    return np.array(rows)


def read_devkit(path):
    """(n, t_err, r_err) overall and for each length."""
    first, *rest = path.read_text().split("\n")
    overall = [float(field.split("=")[1]) for field in first.split()]
    lines = [line.replace("n=", "").split() for line in rest if line.strip()]
    return overall, {float(line[0]): [float(field) for field in line[1:]] for line in lines}


@needs_examples
@pytest.mark.parametrize("name", ["full3d-09", "planar-07"])
def test_agrees_with_the_devkit(name):
    truth, estimate = (read_kitti(EXAMPLES / f"{name}-{part}.txt") for part in ("gt", "est"))
    overall, per_length = read_devkit(EXAMPLES / f"{name}-devkit.txt")
    result = drift(truth, estimate, planar=False)
    assert list(result.per_length) == list(per_length)
    pairs = [(result, overall)] + [(result.per_length[length], per_length[length]) for length in per_length]
    for ours, (segments, t_err, r_err) in pairs:
        assert ours.segments == segments
        assert ours.t_err == pytest.approx(t_err, rel=1e-4)
        assert ours.r_err_deg_per_m == pytest.approx(r_err, rel=1e-4)


@needs_examples
@pytest.mark.parametrize("name", ["full3d-09", "planar-07"])
def test_the_slow_loop_is_the_devkit(name):
    truth, estimate = (read_kitti(EXAMPLES / f"{name}-{part}.txt") for part in ("gt", "est"))
    (segments, t_err, r_err), per_length = read_devkit(EXAMPLES / f"{name}-devkit.txt")
    rows = devkit_loop(truth, estimate, KITTI_LENGTHS)
    assert len(rows) == segments
    assert rows[:, 3].mean() == pytest.approx(t_err, rel=1e-5)
    assert np.degrees(rows[:, 4].mean()) == pytest.approx(r_err, rel=1e-5)
    for length, (_, _, r_err) in per_length.items():
        assert np.degrees(rows[rows[:, 2] == length, 4].mean()) == pytest.approx(r_err, rel=1e-5)
    ours = segment_errors(truth, estimate)
    np.testing.assert_array_equal(np.stack([ours.start, ours.end, ours.length], axis=1), rows[:, :3])


@needs_examples
def test_planar_of_a_planar_drive_is_the_same():
    truth, estimate = (read_kitti(EXAMPLES / f"planar-07-{part}.txt") for part in ("gt", "est"))
    flat, full = drift(truth, estimate, planar=True), drift(truth, estimate, planar=False)
    assert flat.segments == full.segments
    assert flat.t_err == pytest.approx(full.t_err, rel=1e-7)
    assert flat.r_err_deg_per_m == pytest.approx(full.r_err_deg_per_m, rel=1e-3)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("lengths", "step"), [(KITTI_LENGTHS, 10), ((3.0, 17.5), 7), ((0.3,), 1)])
def test_agrees_with_the_slow_loop(seed, lengths, step):
    truth, estimate = random_drive(seed)
    expected = devkit_loop(truth, estimate, lengths, step)
    errors = segment_errors(truth, estimate, lengths, step)
    ours = np.stack([errors.start, errors.end, errors.length, errors.t_err, errors.r_err], axis=1)
    np.testing.assert_array_equal(ours[:, :3], expected[:, :3])
    np.testing.assert_allclose(ours[:, 3], expected[:, 3], rtol=1e-8)
    np.testing.assert_allclose(ours[:, 4], expected[:, 4], atol=1e-7)
    result = summarise(errors)
    assert result.t_err == pytest.approx(expected[:, 3].mean(), rel=1e-9)
    assert result.r_err_deg_per_m == pytest.approx(np.degrees(expected[:, 4].mean()), rel=1e-6)
    assert result.t_rmse == pytest.approx(math.sqrt(np.mean(expected[:, 3] ** 2)), rel=1e-9)
    assert sum(part.segments for part in result.per_length.values()) == result.segments == len(expected)


def test_planar_drops_height_pitch_and_roll_and_measures_in_2d():
    truth, estimate = random_drive(3)
    expected = devkit_loop(flatten(truth), flatten(estimate), KITTI_LENGTHS)
    result = drift(truth, estimate, planar=True)
    assert result.segments == len(expected)
    assert result.t_err == pytest.approx(expected[:, 3].mean(), rel=1e-9)
    lifted = estimate.copy()
    lifted[:, 1, 3] += np.linspace(0, 100, len(lifted))
    assert drift(truth, lifted, planar=True) == result


def test_scale_error_of_a_straight_line():
    # Steps of exactly 1 m: "greater than 100 m" is first true 101 m on.
    result = drift(straight(500), straight(500, 1.02), planar=False, lengths=(100.0,))
    assert result.segments == len(range(0, 500 - 101, 10))
    assert result.t_err == pytest.approx(0.02 * 101 / 100, rel=1e-9)
    assert result.t_rmse == pytest.approx(result.t_err, rel=1e-9)
    assert result.r_err_deg_per_m == 0


@pytest.mark.parametrize(("turn", "tolerance"), [(1e-2, 1e-6), (1e-4, 1e-3)])
def test_constant_yaw_drift(turn, tolerance):
    estimate = straight(300)
    estimate[:, :3, :3] = [turned(0, 0, turn * frame) for frame in range(300)]
    result = drift(straight(300), estimate, planar=True, lengths=(100.0,))
    assert result.r_err_deg_per_m == pytest.approx(np.degrees(turn) * 101 / 100, rel=tolerance)


def test_half_turn_error():
    estimate = straight(120)
    estimate[60:, :3, :3] = turned(0, 0, np.pi)
    errors = segment_errors(straight(120), estimate, (100.0,))
    np.testing.assert_allclose(errors.r_err * 100, np.pi, rtol=1e-6)


def test_the_start_of_the_estimate_does_not_matter():
    truth, estimate = random_drive(4)
    elsewhere = np.eye(4)
    elsewhere[:3, :3], elsewhere[:3, 3] = turned(0.3, -0.2, 2.0), [5, -7, 11]
    moved = drift(truth, elsewhere @ estimate, planar=False)
    assert moved.t_err == pytest.approx(drift(truth, estimate, planar=False).t_err, rel=1e-9)


def test_too_short_for_a_segment_is_not_a_score():
    # 100 m exactly is not more than 100 m.
    result = drift(straight(101), straight(101, 2.0), planar=True)
    assert (result.t_err, result.r_err_deg_per_m, result.t_rmse) == (None, None, None)
    assert result.to_dict() == {
        "t_err": None,
        "r_err_deg_per_m": None,
        "t_rmse": None,
        "segments": 0,
        "per_length": {},
    }
    assert drift(straight(102), straight(102), planar=True).segments == 1
    assert drift(straight(1), straight(1), planar=True).segments == 0


def test_to_dict_has_readable_lengths():
    result = drift(straight(150), straight(150, 1.1), planar=True, lengths=(100, 0.5, 100))
    assert list(result.to_dict()["per_length"]) == ["0.5", "100"]
    assert result.to_dict()["per_length"]["100"]["segments"] == 5
    assert set(result.to_dict()["per_length"]["100"]) == {"segments", "t_err", "r_err_deg_per_m"}


def broken(value, frame=7):
    poses = straight(30)
    poses[frame, :3, :3] = value
    return poses


@pytest.mark.parametrize(
    ("truth", "estimate", "options", "message"),
    [
        (straight(30), straight(29), {}, "30 poses but the estimate 29"),
        (straight(30), broken(np.nan), {}, "estimate is not finite .* frame 7"),
        (broken(np.inf, 3), straight(30), {}, "ground truth is not finite .* frame 3"),
        (straight(30), broken(0.0), {}, "estimate holds no rotation matrix at frame 7"),
        (straight(30), -straight(30), {}, "no rotation matrix at frame 0"),
        (straight(30)[:, :3], straight(30), {}, r"shape \(N, 4, 4\), not \(30, 3, 4\)"),
        (straight(30)[:0], straight(30)[:0], {}, r"not \(0, 4, 4\)"),
        (straight(30), straight(30), {"lengths": (10, 0)}, "lengths must be positive"),
        (straight(30), straight(30), {"lengths": ()}, "lengths must be positive"),
        (straight(30), straight(30), {"step": 0}, "step must be at least 1"),
    ],
)
@pytest.mark.parametrize("planar", [False, True])
def test_bad_input_is_named(truth, estimate, options, message, planar):
    with pytest.raises(InputError, match=message):
        drift(truth, estimate, planar=planar, **options)


def test_fitting_lengths():
    assert fitting_lengths([straight(50), straight(102)]) == KITTI_LENGTHS
    assert fitting_lengths([straight(101)]) == (10, 20, 50)
    assert fitting_lengths([straight(13), straight(4)]) == (2, 5, 10)
    assert fitting_lengths([straight(3, 0.1)]) == (0.1,)
    assert fitting_lengths([straight(13)], (20, 5)) == (20, 5)
    assert fitting_lengths([straight(700)], (800,)) == (100, 200, 500)
    for lengths in (fitting_lengths([straight(13)]), fitting_lengths([straight(3, 0.1)])):
        poses = straight(13) if len(lengths) == 3 else straight(3, 0.1)
        assert list(drift(poses, poses, planar=True, lengths=lengths).per_length) == list(lengths)


@pytest.mark.parametrize("truths", [[], [straight(50, 0.0)], [straight(1)]])
def test_nothing_fits_a_recording_that_stands_still(truths):
    with pytest.raises(InputError, match="give recordings that move"):
        fitting_lengths(truths)


def test_travelled():
    np.testing.assert_allclose(travelled(straight(4, -2.0)), [0, 2, 4, 6])


def test_steps_of_python_do_not_grow_with_the_drive():
    """Whatever is done for each frame is done by numpy: a loop would make a long drive slow."""

    def calls(frames):
        truth, estimate = random_drive(5, frames)
        with Profile() as profile:
            drift(truth, estimate, planar=True, lengths=(100.0,))
        return sum(entry.callcount for entry in profile.getstats())

    assert calls(4500) < 1.2 * calls(1500)
