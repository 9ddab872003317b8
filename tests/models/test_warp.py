"""Networks that measure residual motions, and how they are used in a stream."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import (
    FORWARD_CAMERA,
    AccumulatedCovariance,
    Step,
    Steps,
    advance,
    compose,
    poses_to_planar,
    relative_step,
)
from rcnn_odom.models.cnn_warp import (
    LINEAR_BELOW,
    CNNWarp,
    LocalConstraints,
    compare,
    invert,
    log_determinant,
)
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.motion_filter import MotionFilter
from rcnn_odom.models.pairs import PairTracker, estimate_encoded, wrap_for_stream
from rcnn_odom.models.rcnn_warp import RCNNWarp
from rcnn_odom.models.reprojection import render
from rcnn_odom.models.streaming import Description, Warping
from rcnn_odom.models.tracking import Kind, Tracking
from rcnn_odom.models.warping import LEAST_RESPONSE, WarpingStepper
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.scan import Scan

SENSOR = Sensor(resolution_deg=1.0)
RESIDUAL = {"x": 0.2, "y": 0.1, "heading_deg": 2.0, "smallest": -2.0, "largest": 0.3}
OPTIONS = {
    "kernel_size": 3,
    "pooling": "avg",
    "resolution_deg": 0.5,
    "passes": 3,
    "settled": 0.1,
    "radians_a_metre": 0.05,
    "key_distance": 1.0,
    "key_turn_deg": 20.0,
    "residual": RESIDUAL,
    "floor": 0.05,
    "learning_rate": 1e-3,
}
RECURRENT = {"hidden_size": 16, "layers": 2, "projection": 8, "dropout": 0.0, "freeze": True}


def room_scan(pose, sensor=SENSOR):
    """What a laser sees in a room of 12 x 8 m without a corner that looks like another, (bins,)."""
    x, y, heading = pose
    angles = np.deg2rad(sensor.first_bin_deg + sensor.resolution_deg * np.arange(sensor.bins)) + heading
    cos, sin = np.cos(angles), np.sin(angles)
    with np.errstate(divide="ignore"):
        walls = [
            np.where(cos > 0, (7.0 - x) / cos, np.inf),
            np.where(cos < 0, (-5.0 - x) / cos, np.inf),
            np.where(sin > 0, (5.0 - y) / sin, np.inf),
            np.where(sin < 0, (-3.0 - y) / sin, np.inf),
        ]
    return np.min(walls, axis=0).astype(np.float32)


def drive(count=20, seed=0):
    """Scans (N, bins) of a walk through the room, and its steps (N-1, 3)."""
    rng = np.random.default_rng(seed)
    pose, poses = np.zeros(3), [np.zeros(3)]
    for _ in range(count - 1):
        pose = advance(pose, np.array([0.1, 0.02, 0.05]) * rng.normal(1, 0.3, 3))
        poses.append(pose)
    steps = [relative_step(one, other) for one, other in itertools.pairwise(poses)]
    return np.stack([room_scan(each) for each in poses]), np.array(steps)


def windows(scans, steps, length):
    """A batch of all windows of consecutive pairs."""
    starts = range(len(steps) - length + 1)
    pairs = [[scans[t : t + 2] for t in range(start, start + length)] for start in starts]
    return {
        "pairs": torch.from_numpy(np.array(pairs)),
        "steps": torch.tensor(np.array([steps[start : start + length] for start in starts])).float(),
    }


class Perfect:
    """A network that knows where each scan was taken: a search of the pose would find no better."""

    def __init__(self, scans, steps, warping, covariance=None):
        self.description = Description(SENSOR, warping=warping)
        self.scans, self.warping, self.calls, self.forgotten = scans, warping, 0, 0
        self.covariance = np.diag([1e-9, 1e-9, 1e-11]) if covariance is None else covariance
        self.poses = [np.zeros(3)]
        for step in steps:
            self.poses.append(advance(self.poses[-1], step))
        drawn = self.description.input_sensor
        self.drawn = [render(scan, SENSOR, np.zeros(3), drawn) for scan in scans]
        self.guess = None

    def reset(self):
        self.forgotten = 0

    def forget_last(self):
        self.forgotten += 1

    def __call__(self, pair):
        self.calls += 1
        later = next(n for n, each in enumerate(self.drawn) if np.array_equal(each, pair[1]))
        # Which viewpoint the earlier scan is seen from: the one that the stepper has drawn last.
        key, viewpoint = self.seen
        x, y, heading = relative_step(viewpoint, relative_step(self.poses[key], self.poses[later])).tolist()
        return Step(x, y, heading, self.covariance)


@pytest.fixture
def spied(monkeypatch):
    """Makes a stepper around a network of this page, which is told what the stepper draws."""

    def make(network):
        def spy(depth, sensor, viewpoint, out):
            found = [n for n, scan in enumerate(network.scans) if np.array_equal(scan, depth)]
            network.seen = found[0], np.array(viewpoint, float)
            return render(depth, sensor, viewpoint, out)

        monkeypatch.setattr("rcnn_odom.models.warping.render", spy)
        return WarpingStepper(network)

    return make


@pytest.fixture
def perfect(spied):
    """Makes a stepper around a perfect network."""

    def make(scans, steps, **options):
        given = {
            "resolution_deg": 0.5,
            "passes": 3,
            "settled": 0.1,
            "radians_a_metre": 0.05,
            "key_distance": 0.3,
            "key_turn_deg": 20.0,
        } | options
        covariance = given.pop("covariance", None)
        return spied(Perfect(scans, steps, Warping(**given), covariance))

    return make


@pytest.mark.parametrize("key_distance", [0.0, 0.3, 100.0])
def test_a_perfect_network_gives_the_true_steps_whatever_the_key(perfect, key_distance):
    scans, steps = drive()
    stepper = perfect(scans, steps, key_distance=key_distance)
    got = [stepper(scans[n : n + 2]).array() for n in range(len(steps))]
    assert np.allclose(got, steps, atol=1e-6)


@pytest.mark.parametrize(
    ("settled", "passes", "expected"), [(5.0, 6, 1), (1e-6, 6, 2), (0.0, 6, 6), (0.0, 2, 2)]
)
def test_a_scan_is_compared_until_a_correction_is_small(perfect, settled, passes, expected):
    """A perfect network corrects once what its second look finds right."""
    scans, steps = drive()
    stepper = perfect(scans, steps, settled=settled, passes=passes)
    for n in range(4):
        before = stepper.network.calls
        stepper(scans[n : n + 2])
        # The first motion is far from the guess, so that a second comparison has to confirm it.
        assert stepper.network.calls - before == expected + (n == 0)
    assert stepper.network.forgotten == 4 * (expected - 1) + 1


def test_scans_that_were_left_out_begin_a_new_key(perfect):
    scans, steps = drive()
    stepper = perfect(scans, steps, key_distance=100.0)
    for n in (0, 1, 2, 7, 8):
        assert np.allclose(stepper(scans[n : n + 2]).array(), steps[n], atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_of_the_network_is_no_step_and_it_begins_again(perfect, bad):
    scans, steps = drive()
    stepper = perfect(scans, steps)
    stepper(scans[:2])
    poses = stepper.network.poses
    stepper.network.poses = [*poses[:2], np.full(3, bad), *poses[3:]]
    assert np.isnan(stepper(scans[1:3]).array()).all()
    assert np.allclose(stepper(scans[3:5]).array(), steps[3], atol=1e-6)


def test_several_looks_along_a_bare_wall_do_not_add_up(spied):
    """A network that hardly knows, but says 10 cm ahead wherever it looks from, moves little by that."""

    class Wandering(Perfect):
        def __call__(self, pair):
            _, y, heading = super().__call__(pair).array()
            return Step(0.1, y, heading, np.diag([0.04, 1e-9, 1e-11]))

    def first_step(passes):
        network = Wandering(scans, steps, Warping(0.5, passes, 0.0, 0.05, 100.0, 20.0))
        network.description = replace(
            network.description, typical_step=(0.05, 0.05, 0.05), typical_change=(0.01, 0.01, 0.01)
        )
        return spied(network)(scans[:2]).array()

    scans, steps = drive()
    once, often = first_step(1), first_step(6)
    # It says the same from elsewhere, so that it tells as good as nothing: what it says and its deviation are
    # divided by the least response, and the former counts as an error as well.
    share = 0.0101 / (0.0101 + (0.04 + 0.1**2) / LEAST_RESPONSE**2)
    assert once[0] == pytest.approx(share * 0.1 / LEAST_RESPONSE, rel=0.02)
    assert 0 < often[0] < 1.02 * once[0]
    assert often[2] == pytest.approx(steps[0][2], abs=1e-4)


@pytest.mark.parametrize("confirms", [True, False])
def test_a_network_that_jumps_about_is_not_believed(confirms):
    """It says 3 m ahead wherever it looks from; or that and nothing by turns, as if it had been right."""

    class Jumping(Perfect):
        def __call__(self, pair):
            self.calls += 1
            return Step(
                0.0 if confirms and self.calls % 2 == 0 else 3.0, 0.0, 0.0, np.diag([1e-4, 1e-4, 1e-6])
            )

    scans, steps = drive()
    network = Jumping(scans, steps, Warping(0.5, 4, 0.1, 0.05, 0.3, 20.0))
    step = WarpingStepper(network)(scans[:2])
    if confirms:  # corrections that never become small
        assert np.isnan(step.array()).all()
    else:  # the motion is still as unknown as at the beginning: its deviation is 2 m
        assert abs(step.x) < 0.1
        assert np.sqrt(step.covariance[0, 0]) > 1.9


@pytest.mark.parametrize("passes", [5, 6, 7])
def test_a_sudden_stop_is_found_whatever_the_number_of_comparisons(spied, passes):
    """The motion was known to a centimetre and is another one."""
    poses = [(-3.5 + 1.2 * min(n, 5), 0.0, 0.0) for n in range(9)]
    steps = np.diff(np.array(poses), axis=0)
    scans = np.stack([room_scan(pose) for pose in poses])
    network = Perfect(scans, steps, Warping(0.5, passes, 0.1, 0.05, 100.0, 20.0), np.diag([1e-4, 1e-4, 1e-6]))
    network.description = replace(
        network.description, typical_step=(1.2, 0.1, 0.02), typical_change=(0.01, 0.01, 0.001)
    )
    found = estimate_encoded(spied(network), scans)
    assert np.isfinite(found.covariances).all()
    assert np.allclose(found.values[:5], steps[:5], atol=1e-2)
    assert found.values.sum(0) == pytest.approx(steps.sum(0), abs=0.1)


@pytest.mark.parametrize("response", [1.0, 0.5, 0.2])
def test_a_measurement_that_follows_the_motion_by_a_fraction_is_stretched(spied, response):
    """As along a corridor, where a network gives a fraction of the residual and too small a deviation."""

    class Shrunken(Perfect):
        def __call__(self, pair):
            step = super().__call__(pair)
            return Step(response * step.x, step.y, step.heading, np.diag([0.04**2, 1e-6, 1e-8]))

    scans, steps = np.stack([room_scan((x, 0.0, 0.0)) for x in (0.0, 0.4)]), np.array([[0.4, 0.0, 0.0]])
    network = Shrunken(scans, steps, Warping(0.5, 3, 0.1, 0.05, 100.0, 20.0))
    network.description = replace(network.description, typical_step=(1.0, 0.1, 0.1))
    step = spied(network)(scans)
    assert step.x == pytest.approx(0.4, rel=0.03)
    assert np.sqrt(step.covariance[0, 0]) == pytest.approx(0.04 / response, rel=0.03)


def walk_along_x(length, deviations, answer):
    """Two scans, ``length`` metres apart, and a network whose residuals are changed by ``answer``."""

    class Changed(Perfect):
        def __call__(self, pair):
            x, y, heading = answer(self, super().__call__(pair).array()).tolist()
            return Step(x, y, heading, np.diag(np.square(deviations)))

    scans, steps = np.stack([room_scan((x, 0.0, 0.0)) for x in (0.0, length)]), np.array([[length, 0.0, 0.0]])
    network = Changed(scans, steps, Warping(0.5, 1, 0.1, 0.05, 100.0, 20.0))
    network.description = replace(
        network.description, typical_step=(0.1, 0.1, 0.1), typical_change=(0.02, 0.02, 0.02)
    )
    return network, scans


def test_a_comparison_that_fails_from_another_viewpoint_is_no_step(spied):
    """It says 0.4 m to 4 cm, and nan from farther on. Of a recurrent network, the state is nan too."""

    def answer(network, residual):
        return residual if network.calls == 1 else np.full(3, np.nan)

    network, scans = walk_along_x(0.4, (0.04, 0.001, 1e-4), answer)
    assert np.isnan(spied(network)(scans).array()).all()


@pytest.mark.parametrize("later", [(-0.6, 0.0, 0.0), (0.6, 0.0, 0.0), (9.0, 0.0, 0.0)])
def test_what_another_viewpoint_contradicts_is_not_believed(spied, later):
    """It says 0.6 m to a millimetre, and from there something else; the motion is known to 0.2 m: none."""

    def answer(network, residual):
        return np.array([0.6, 0.0, 0.0] if network.calls == 1 else later)

    network, scans = walk_along_x(0.0, (0.001, 0.001, 1e-4), answer)
    step = spied(network)(scans)
    assert abs(step.x) < 0.01
    assert np.sqrt(step.covariance[0, 0]) == pytest.approx(np.hypot(0.2, 0.02), rel=0.02)


def test_a_turn_that_another_viewpoint_contradicts_is_not_believed(spied):
    """It says 0.2 rad, which is as much as 4 m here, and from there -0.2."""

    def answer(network, residual):
        return np.array([0.0, 0.0, 0.2 if network.calls == 1 else -0.2])

    network, scans = walk_along_x(0.0, (0.001, 0.001, 1e-4), answer)
    assert abs(spied(network)(scans).heading) < 0.01


def test_both_directions_are_checked(spied):
    """On open ground the network sees a fifth of the way ahead and of that to the side."""

    class Shrunken(Perfect):
        def __call__(self, pair):
            x, y, heading = super().__call__(pair).array().tolist()
            return Step(0.2 * x, 0.2 * y, heading, np.diag([0.041**2, 0.04**2, 1e-8]))

    scans, steps = np.stack([room_scan((x, x, 0.0)) for x in (0.0, 0.3)]), np.array([[0.3, 0.3, 0.0]])
    network = Shrunken(scans, steps, Warping(0.5, 3, 0.1, 0.05, 100.0, 20.0))
    network.description = replace(network.description, typical_step=(1.0, 1.0, 0.1))
    step = spied(network)(scans)
    assert (step.x, step.y) == (pytest.approx(0.3, rel=0.03), pytest.approx(0.3, rel=0.03))
    deviations = np.sqrt(np.diag(step.covariance))[:2]
    assert deviations == pytest.approx([0.205, 0.2], rel=0.03)


def test_after_scans_that_were_not_used_the_motion_is_uncertain(spied):
    """Before a wall that tells nothing, the deviation says that the motion may have changed meanwhile."""
    scans, steps = drive(12)
    network = Perfect(scans, steps, Warping(0.5, 3, 0.1, 0.05, 100.0, 20.0))
    network.description = replace(
        network.description, typical_step=(1.0, 0.1, 0.02), typical_change=(0.01, 0.01, 0.001)
    )
    stepper = spied(network)
    for number in range(5):
        stepper(scans[number : number + 2])
    network.covariance, place = np.diag([25.0, 1e-4, 1e-6]), stepper(scans[5:7])
    assert place.covariance[0, 0] < 1e-3
    after = stepper(scans[[8, 9]])
    assert after.covariance[0, 0] > 3.0


def track(network, scans, stamps):
    """The steps of a network to scans (bins,) of the room, by a tracker."""
    bearings = np.deg2rad(SENSOR.first_bin_deg + np.arange(float(SENSOR.bins)))
    tracking = Tracking(PairTracker(network))
    return [
        tracking.step(Scan(scan.astype(float), bearings, stamp=stamp))
        for scan, stamp in zip(scans, stamps, strict=True)
    ]


@pytest.mark.parametrize("key_distance", [0.0, 0.3, 100.0])
def test_scans_are_compared_across_a_gap(perfect, key_distance):
    """Scans that were dropped, and scans without returns, cost a network that predicts nothing."""
    scans, steps = drive(30)
    stepper = perfect(scans, steps, key_distance=key_distance)
    poses = stepper.network.poses
    seen = [n for n in range(30) if n not in (8, 9, 15)]
    scans[20:22] = 0.0
    tracked = track(stepper, scans[seen], [0.1 * n for n in seen])
    got = poses_to_planar(compose([each.step.array() for each in tracked[1:]]))
    visible = [n not in (20, 21) for n in seen]
    assert np.allclose(got[visible], np.array(poses)[seen][visible], atol=1e-5)
    across = tracked[seen.index(10)]
    assert across.kind is Kind.ESTIMATED
    assert across.notes == ("gap: 3 periods after the last scan, compared across it",)
    assert [tracked[seen.index(n)].kind for n in (20, 21, 22)] == [Kind.HELD, Kind.HELD, Kind.ESTIMATED]


@pytest.mark.parametrize("blind", [(1, 2, 3, 4, 5, 7, 8), (1, 3, 5, 6, 9, 10), (12, 13, 15, 16, 18)])
def test_scans_without_returns_change_no_speed(perfect, blind):
    """At the start and several times in a row; the steps before the next seen scan go on as the last one."""
    scans, _ = drive(30)
    steps = np.tile([0.1, 0.0, 0.0], (29, 1))
    scans = np.stack([room_scan((0.1 * n, 0.0, 0.0)) for n in range(30)])
    network = perfect(scans, steps)
    scans = scans.copy()
    scans[list(blind)] = 0.0
    got = np.array([each.step.array() for each in track(network, scans, 0.1 * np.arange(30))])
    places = np.cumsum(got[:, 0])
    seen = [n for n in range(30) if n not in blind]
    assert np.allclose(places[seen], 0.1 * np.array(seen), atol=1e-3)
    known = [n for n in range(3, 30) if n > seen[2]]  # when two scans were compared
    assert np.allclose(got[known, 0], 0.1, atol=5e-3)


def test_after_a_failure_and_scans_without_returns_the_last_motion_goes_on(perfect):
    steps = np.tile([0.1, 0.0, 0.0], (29, 1))
    scans = np.stack([room_scan((0.1 * n, 0.0, 0.0)) for n in range(30)])
    stepper = perfect(scans, steps)
    stepper.network.poses[10] = np.full(3, np.nan)
    blind = scans.copy()
    blind[11:14] = 0.0
    tracked = track(stepper, blind, 0.1 * np.arange(30))
    got = np.array([each.step.array() for each in tracked])
    assert [each.kind for each in tracked[9:16]] == [
        Kind.ESTIMATED, *[Kind.HELD] * 5, Kind.ESTIMATED
    ]  # fmt: skip
    assert np.allclose(got[1:, 0], 0.1, atol=5e-3)


def test_a_step_that_corrects_predictions_is_marked(perfect):
    """Such a step is of no use to others, who have predicted something else."""
    scans, steps = drive(12)
    network = perfect(scans, steps)
    scans = scans.copy()
    scans[[5, 6]] = 0.0
    bearings = np.deg2rad(SENSOR.first_bin_deg + np.arange(float(SENSOR.bins)))
    tracker, marked = PairTracker(network), []
    for number, ranges in enumerate(scans):
        scan = Scan(ranges.astype(float), bearings)
        tracker.register(scan) if number else tracker.begin(scan)
        marked.append(tracker.corrects_prediction)
    assert [number for number, each in enumerate(marked) if each] == [7]


def test_over_a_longer_gap_the_motion_goes_on(perfect):
    scans, steps = drive(30)
    seen = [*range(8), *range(19, 30)]
    tracked = track(perfect(scans, steps), scans[seen], [0.1 * n for n in seen])
    assert tracked[8].kind is Kind.HELD
    assert tracked[8].notes == ("gap: 12 periods after the last scan, the last motion goes on",)
    assert np.allclose([each.step.array() for each in tracked[9:]], steps[19:], atol=1e-5)


def test_the_variance_of_a_pose_grows_over_scans_without_returns_and_comes_back():
    own, change = np.diag([1e-6, 4e-6, 1e-8]), np.array([3e-3, 1e-3, 5e-4])

    class Constant(Perfect):
        def __call__(self, pair):
            return Step(0.0, 0.0, 0.0, own)

    network = Constant(*drive(5), Warping(0.5, 1, 0.1, 0.05, 100.0, 20.0))
    network.description = replace(network.description, typical_step=(0, 0, 0), typical_change=tuple(change))
    scans = [np.full(SENSOR.bins, 0.0 if n in (30, 31) else 5.0) for n in range(33)]
    added, variances = AccumulatedCovariance(), []
    for tracked in track(network, scans, 0.1 * np.arange(33)):
        added.add(np.zeros(3), tracked.step)
        variances.append(np.diag(added.value))
    # One period later it is moved by the error of the motion, which the change alone adds up to less than.
    assert np.all(variances[30] > variances[29] + change**2)
    assert np.all(variances[31] > variances[30] + 3 * change**2)
    assert np.allclose(variances[32], np.diag(own), rtol=0.2)


def test_covariances_are_those_of_two_poses_and_what_comes_back(perfect):
    scans, steps = drive()
    own = np.diag([1e-6, 4e-6, 1e-8])
    stepper = perfect(scans, steps, key_distance=100.0, settled=0.0, covariance=own)
    first, second = stepper(scans[:2]), stepper(scans[1:3])
    # From a key the error is that of one pose, later of two, of which the next step takes one back.
    turn = np.array(
        [
            [math.cos(first.heading), -math.sin(first.heading)],
            [math.sin(first.heading), math.cos(first.heading)],
        ]
    )
    assert np.allclose(first.covariance[:2, :2], turn @ own[:2, :2] @ turn.T, rtol=1e-3, atol=1e-11)
    assert np.trace(second.covariance) > 1.9 * np.trace(own)
    assert np.allclose(second.taken_back, own, rtol=1e-3, atol=1e-11)
    every = perfect(scans, steps, key_distance=0.0, settled=0.0, covariance=own)
    assert not every(scans[:2]).taken_back.any()


def test_what_is_used_once_is_not_wrapped_again():
    network = CNNWarp(OPTIONS, SENSOR)
    stepper = network.stepper()
    assert wrap_for_stream(stepper) is stepper
    assert PairTracker(stepper).description.sensor == SENSOR


def test_the_channels_of_an_image():
    sensor = Sensor(resolution_deg=90.0)
    before, now = torch.tensor([2.0, 0.0, 4.0, 8.0, 2.0]), torch.tensor([2.0, 3.0, 4.05, 0.0, 2.0])
    image = compare(torch.stack([before, now])[None], sensor)
    assert image.shape == (1, 5, 1, 5)
    difference, depth, slope, sees, both = image[0, :, 0]
    assert torch.allclose(
        difference, torch.tensor([0, 0, math.asinh(0.05 / LINEAR_BELOW) / 2, 0, 0]), atol=1e-6
    )
    assert torch.allclose(depth[:3], torch.log(now[:3] / 10))
    assert sees.tolist() == [1, 1, 1, 0, 1]
    assert both.tolist() == [1, 0, 1, 0, 1]
    across = 2 * math.pi / 2 * 3.0
    assert slope[1] == pytest.approx(math.asinh((4.05 - 2.0) / across) / 2)
    assert slope[2] == 0  # beside a bin in which nothing is seen


def test_the_inverse_by_cholesky_equals_torchs():
    torch.manual_seed(0)
    root = torch.randn(50, 3, 3, dtype=torch.float64)
    matrices = root @ root.transpose(1, 2) + 0.1 * torch.eye(3)
    assert torch.allclose(invert(matrices), torch.linalg.inv(matrices), rtol=1e-6)


def test_places_look_where_their_features_come_from():
    """What moves a place's features most lies in the middle of what it sees."""
    network = CNNWarp(OPTIONS | {"resolution_deg": 0.2}, Sensor())
    for weight in network.encoder.parameters():
        torch.nn.init.constant_(weight, 0.1 if weight.ndim > 1 else 1.0)
    image = torch.ones(1, 5, 1, 1801, requires_grad=True)
    features = network.encoder.convolve(image)
    assert features.shape[-1] == len(network.encoder.places)
    for place in (5, 30):
        (sensitivity,) = torch.autograd.grad(features[..., place].sum(), image, retain_graph=True)
        weights = sensitivity.sum((0, 1, 2)).numpy()
        middle = (weights * np.arange(1801)).sum() / weights.sum()
        assert network.encoder.places[place] == pytest.approx(middle, abs=0.01)


def test_constraints_turn_with_what_is_seen():
    torch.manual_seed(0)
    head = LocalConstraints(8, 30.0 * np.arange(12), Sensor(resolution_deg=1.0), 0.05)
    torch.nn.init.normal_(head.constraint.weight)
    features, scans = torch.randn(1, 8, 1, 12), torch.full((1, 2, 361), 5.0)
    motion, matrix = head(features, scans)
    # The same things, seen a quarter of a turn further to the left.
    turned, turned_matrix = head(torch.roll(features, 3, -1), scans)
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert torch.allclose(turned[0], quarter @ motion[0], atol=1e-5)
    assert torch.allclose(turned_matrix[0], quarter @ matrix[0] @ quarter.T, rtol=1e-4, atol=1e-4)


def test_constraints_of_points_give_the_motion_that_moves_them():
    """Lever arms and signs, against points that are seen from another pose."""
    rng = np.random.default_rng(0)
    sensor, places = Sensor(resolution_deg=1.0), 10.0 * np.arange(36) + 4.5
    motion = np.array([0.02, -0.01, 0.003])  # ahead, to the left, counter-clockwise
    bearings, ranges = np.deg2rad(-180 + places), rng.uniform(2, 20, 36)
    points = ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], 1)
    seen = (points - motion[:2]) @ rotation(motion[2])  # a row times the matrix: turned back
    normals = rng.standard_normal((36, 2))
    radial = (normals * points).sum(1) / ranges
    tangential = (normals[:, 1] * points[:, 0] - normals[:, 0] * points[:, 1]) / ranges
    offsets = -(normals * (seen - points)).sum(1)
    head = LocalConstraints(4, places, sensor, 0.05)
    head.constraint.weight.data.copy_(torch.eye(4)[:, :, None, None])
    head.constraint.bias.data.zero_()
    weights = np.full(36, 8.0)  # so large that the prior does not matter
    features = torch.from_numpy(np.stack([radial, tangential, offsets, weights])).float()[None, :, None]
    scan = np.zeros(sensor.bins, np.float32)
    scan[:360] = np.repeat(ranges, 10)
    scan[:360:3] = 0  # the mean is that of the returns alone
    found, _ = head(features, torch.from_numpy(np.stack([scan, scan]))[None])
    assert np.allclose(found[0].detach() * torch.tensor([1, 1, 0.05]), motion, atol=2e-4)
    scan[:] = 0
    nothing, without = head(features, torch.from_numpy(np.stack([scan, scan]))[None])
    assert not nothing.any()
    assert torch.equal(without, torch.eye(3)[None])


def test_the_only_position_looks_at_the_whole_scan():
    head = LocalConstraints(4, np.array([3.0]), Sensor(resolution_deg=45.0), 0.05)
    pairs = torch.full((1, 2, 9), 4.0)
    pairs[:, 0, 5:] = 0
    ranges, share = head.find_ranges_and_shares(pairs)
    assert ranges.tolist() == [[[4.0]]]
    assert 0.4 < share.item() < 0.9


def test_the_first_position_of_a_circle_looks_across_the_seam():
    """At four of 20 bins on either side of bin 0; bin 20 is the same as bin 0."""
    head = LocalConstraints(4, np.array([0.0, 8.0]), Sensor(resolution_deg=18.0), 0.05)
    pairs = torch.zeros(1, 2, 21)
    pairs[..., :5], pairs[..., 16:] = 3.0, 5.0
    ranges, share = head.find_ranges_and_shares(pairs)
    assert 3.5 < ranges[0, 0, 0] < 4.5
    assert share[0, 0, 0] == 1


def test_the_change_of_the_motion_is_that_within_drives():
    """Two drives at speeds of their own, in which nothing changes."""
    model = CNNWarp(OPTIONS, SENSOR)
    model.set_units([np.tile([speed, 0.0, 0.0], (20, 1)) for speed in (0.2, 1.5)])
    assert model.describe().typical_change == (0, 0, 0)


def rotation(heading):
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([[cos, -sin], [sin, cos]])


def test_constraints_are_solved_by_least_squares():
    """Against numpy's solution of the same rows, with the prior as rows of their own."""
    torch.manual_seed(1)
    head = LocalConstraints(4, 18.0 * np.arange(20), SENSOR, 0.05)
    torch.nn.init.normal_(head.constraint.weight)
    features = torch.randn(1, 4, 1, 20)
    radial, tangential, residual, log_weight = head.constraint(features)[0, :, 0].detach().double()
    bearings = np.deg2rad(-180 + 18 * np.arange(20))
    cos, sin = np.cos(bearings), np.sin(bearings)
    rows = np.stack(
        [
            cos * radial.numpy() - sin * tangential.numpy(),
            sin * radial.numpy() + cos * tangential.numpy(),
            0.05 * 7.0 * tangential.numpy(),
        ],
        1,
    )
    root = np.exp(log_weight.numpy() / 2)
    left, right = (
        np.vstack([rows * root[:, None], np.eye(3)]),
        np.append(residual.numpy() * root, np.zeros(3)),
    )
    expected = np.linalg.lstsq(left, right, rcond=None)[0]
    motion, matrix = head(features, torch.full((1, 2, SENSOR.bins), 7.0))
    assert np.allclose(motion[0].detach(), expected, atol=1e-4)
    assert np.allclose(matrix[0].detach(), left.T @ left, rtol=1e-4, atol=1e-4)


def test_what_is_left_of_a_guess_is_exact():
    """The earlier scan, seen from the guess and then from the residual, is the later one."""
    scans, steps = drive()
    network = CNNWarp(OPTIONS | {"resolution_deg": None}, SENSOR)
    batch = windows(scans, steps, 4)
    torch.manual_seed(3)
    pairs, residuals = network.draw(batch)
    assert pairs.shape == (len(batch["steps"]), 2, SENSOR.bins)
    for (before, now), residual in zip(pairs.numpy(), residuals.numpy(), strict=True):
        again = render(before, SENSOR, residual, SENSOR)
        seen = (again > 0) & (now > 0)
        assert seen.mean() > 0.9
        assert np.median(np.abs(again - now)[seen]) < 0.01
    assert (np.abs(residuals.numpy()).max(0) > 0).all()


def test_what_is_drawn_follows_from_torchs_seed():
    batch = windows(*drive(), 4)
    network = CNNWarp(OPTIONS, SENSOR)
    drawn = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        drawn.append(network.draw(batch)[1])
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])


def train(network, batch, steps):
    """Fits a network to a batch, drawn anew at every step."""
    torch.manual_seed(0)
    optimizer = torch.optim.Adam([p for p in network.parameters() if p.requires_grad])
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, total_steps=steps)
    for _ in range(steps):
        optimizer.zero_grad()
        network.loss(batch)["loss"].backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()


@pytest.mark.slow
def test_it_learns_to_measure_in_a_room_and_knows_how_well():
    """From standing still, steps of 10 cm and 3 degrees that vary by a third."""
    torch.manual_seed(0)
    network = CNNWarp(OPTIONS, SENSOR)
    train(network, windows(*drive(60), 4), 300)
    scans, steps = drive(60, seed=5)
    estimate = network.estimate_scans(torch.from_numpy(scans))
    errors = np.abs(estimate.values - steps)[3:]
    assert errors.mean(0) == pytest.approx([0, 0, 0], abs=0.02)
    deviations = np.sqrt(np.diagonal(estimate.covariances, axis1=1, axis2=2))[3:]
    assert np.isfinite(deviations).all()
    assert (deviations < 0.2).all()


def test_nothing_seen_keeps_the_guess_and_says_so():
    network = CNNWarp(OPTIONS, SENSOR)
    with torch.no_grad():
        empty = torch.zeros(1, 1, 2, network.drawn.bins)
        room = torch.from_numpy(room_scan((0, 0, 0), network.drawn)).expand(1, 1, 2, -1)
        for _ in range(2):
            steps, blind, _ = network(empty)
            _, seeing, _ = network(room)
    assert torch.isfinite(steps).all()
    assert (blind.diagonal(dim1=-2, dim2=-1) >= seeing.diagonal(dim1=-2, dim2=-1)).all()


def test_recurrent_at_first_says_what_its_first_stage_says():
    first = CNNWarp(OPTIONS, SENSOR)
    network = RCNNWarp(OPTIONS | RECURRENT, SENSOR)
    network.take_first_stage(first)
    pairs = torch.rand(2, 3, 2, first.drawn.bins) * 10
    with torch.no_grad():
        expected, got = first(pairs), network(pairs)
    assert torch.allclose(got[0], expected[0], atol=1e-6)
    assert torch.allclose(got[1], expected[1], rtol=1e-4)
    assert [each.shape for each in got[2]] == [(2, 2, 16)] * 2


def test_recurrent_windows_are_those_of_a_stream():
    """Each guess is where the estimates before lead: their residuals are small after the first."""
    network = RCNNWarp(OPTIONS | RECURRENT | {"resolution_deg": None}, SENSOR)
    batch = windows(*drive(), 8)
    torch.manual_seed(0)
    pairs, residuals = network.draw(batch)
    assert pairs.shape == (len(batch["steps"]), 8, 2, SENSOR.bins)
    assert residuals[:, 2:, 0].abs().median() < 0.1
    for (before, now), residual in zip(pairs[0].numpy(), residuals[0].numpy(), strict=True):
        again = render(before, SENSOR, residual, SENSOR)
        seen = (again > 0) & (now > 0)
        assert np.median(np.abs(again - now)[seen]) < 0.02


def test_recurrent_streams_as_it_estimates_windows():
    network = RCNNWarp(OPTIONS | RECURRENT, SENSOR).eval()
    torch.nn.init.normal_(network.correction.weight, 0, 0.1)
    pairs = torch.rand(1, 5, 2, network.drawn.bins) * 10
    with torch.no_grad():
        whole, _, _ = network(pairs)
        state = ()
        for t in range(5):
            step, _, state = network(pairs[:, t : t + 1], state)
            assert torch.allclose(step[:, 0], whole[:, t], atol=1e-5)


def test_another_first_stage_is_refused():
    network = RCNNWarp(OPTIONS | RECURRENT, SENSOR)
    with pytest.raises(InputError, match=r"kernel_size=5, but model\.kernel_size is 3"):
        network.take_first_stage(CNNWarp(OPTIONS | {"kernel_size": 5}, SENSOR))


@pytest.mark.parametrize("empty", [(), (0, 1, 2), (12, 13, 20), tuple(range(8, 20))])
def test_a_drive_is_estimated_as_in_a_stream(perfect, empty):
    """Over scans without returns, at its beginning as well, and where the network fails."""
    scans, steps = drive(30)
    stepper = perfect(scans, steps)
    stepper.network.poses[5] = stepper.network.poses[25] = np.full(3, np.nan)
    scans = scans.copy()
    scans[list(empty)] = 0.0
    streamed = [each.step for each in track(stepper, scans, 0.1 * np.arange(30))][1:]
    stepper.reset()
    found = estimate_encoded(stepper, scans)
    assert np.allclose(found.values, [step.array() for step in streamed])
    if 0 not in empty:  # before the first returns, a stream takes the pose for certain
        assert np.allclose(found.covariances, [step.covariance for step in streamed], equal_nan=True)


def test_predicted_and_held_steps_of_a_drive(perfect):
    """The motion goes on to scans without returns; where the network fails, with the typical deviation."""
    scans, steps = (
        np.stack([room_scan((0.2 * n, 0.0, 0.0)) for n in range(12)]),
        np.tile([0.2, 0, 0], (11, 1)),
    )
    stepper = perfect(scans, steps)
    stepper.description = replace(stepper.description, typical_step=(0.3, 0.2, 0.1))
    stepper.network.poses[10] = np.full(3, np.nan)
    scans = scans.copy()
    scans[[5, 6]] = 0.0
    found = estimate_encoded(stepper, scans)
    assert np.allclose(found.values, np.tile([0.2, 0, 0], (11, 1)), atol=1e-4)
    deviations = np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2))
    assert (deviations[:4] < 1e-3).all()
    assert deviations[4, 0] > 0.9  # of the change of the motion, which is not known: a metre
    assert deviations[9] == pytest.approx([0.3, 0.2, 0.1], rel=1e-3)


def test_calibration_scales_the_deviations_and_keeps_no_period(monkeypatch):
    rng = np.random.default_rng(0)
    true = np.array([0.02, 0.01, 0.003])
    scans, steps = np.ones((501, SENSOR.bins), np.float32), rng.normal(0, 0.1, (500, 3))
    told = steps + true * rng.standard_normal((500, 3))
    network = CNNWarp(OPTIONS, SENSOR)

    def estimate(drive):
        return Steps(told, np.tile(np.diag(np.square(0.01 * network.scale.double().numpy())), (500, 1, 1)))

    monkeypatch.setattr(network, "estimate", estimate)
    network.calibrate([Drive("a", "k", scans, compose(steps), np.arange(501.0), FORWARD_CAMERA)])
    assert network.scale.numpy() == pytest.approx(true / 0.01, rel=0.1)
    assert math.isnan(network.describe().period)


CHANGE, NOISE = np.array([0.03, 0.01, 0.003]), np.array([0.05, 0.02, 0.005])
"""Standard deviations of the change of the motion that a filter assumes, and of the measurements."""


def a_filtered_drive(change, claimed, seed=4, count=2000):
    """A drive whose motion changes by ``change``, and a function that estimates its steps with a scale.

    The measurements say that their deviation is that of ``NOISE`` times ``claimed`` / 0.05 and the scale.
    """
    rng = np.random.default_rng(3)
    steps = np.cumsum(change * rng.standard_normal((count, 3)), 0) * [1, 1, 0.1]
    scans = np.ones((count + 1, 2), np.float32)
    drive_of = Drive("a", "k", scans, compose(steps), np.arange(count + 1.0), FORWARD_CAMERA)

    def estimate(scale, seed=seed):
        motion_filter, values, covariances = MotionFilter(CHANGE, np.ones(3)), [], []
        draws = np.random.default_rng(seed)
        for step in steps:
            expected = motion_filter.displacement()
            residual = relative_step(expected, step) + NOISE * draws.standard_normal(3)
            weighed = motion_filter.weigh(residual, np.diag(np.square(claimed / 0.05 * NOISE * scale)))
            covariances.append(motion_filter.correct(weighed)[0])
            values.append(advance(expected, weighed.correction))
            motion_filter.take_key()
        return Steps(np.array(values), np.array(covariances))

    return drive_of, estimate


@pytest.mark.parametrize("claimed", [0.2, 0.05, 0.0125])
def test_calibration_holds_for_the_steps_that_it_leads_to(monkeypatch, claimed):
    """The filter follows measurements of a smaller deviation more closely: one factor is not enough."""
    drive_of, estimate = a_filtered_drive(CHANGE, claimed)
    network = CNNWarp(OPTIONS, SENSOR)
    monkeypatch.setattr(network, "estimate", lambda _: estimate(network.scale.double().numpy()))
    network.calibrate([drive_of])
    found = estimate(network.scale.double().numpy(), seed=5)  # of another noise
    ratios = np.abs(found.values - drive_of.steps) / np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2))
    assert (ratios < 1).mean(0) == pytest.approx(0.6827, abs=0.05)


@pytest.mark.parametrize("times", [2.0, 4.0])
def test_calibration_does_not_run_away_where_the_motion_is_another(monkeypatch, times):
    """It changes more than in training, so that the steps become worse with a larger deviation."""
    drive_of, estimate = a_filtered_drive(times * CHANGE, 0.05)
    network = CNNWarp(OPTIONS, SENSOR)
    monkeypatch.setattr(network, "estimate", lambda _: estimate(network.scale.double().numpy()))
    network.calibrate([drive_of])
    calibrated, not_calibrated = (
        np.sqrt(np.mean((estimate(scale).values - drive_of.steps)[:, 0] ** 2))
        for scale in (network.scale.double().numpy(), np.ones(3))
    )
    assert calibrated < 2 * not_calibrated


def test_calibration_does_not_count_scans_without_returns(monkeypatch):
    """Half of the steps are predicted, ten times more accurately than they say."""
    rng = np.random.default_rng(0)
    scans, steps = np.ones((1001, SENSOR.bins), np.float32), rng.normal(0, 0.1, (1000, 3))
    scans[2::2] = 0.0
    errors = 0.02 * rng.standard_normal((1000, 3))
    errors[1::2] /= 10
    network = CNNWarp(OPTIONS, SENSOR)

    def estimate(drive):
        scale = network.scale.double().numpy()
        return Steps(steps + errors, np.tile(np.diag(np.square(0.01 * scale)), (1000, 1, 1)))

    monkeypatch.setattr(network, "estimate", estimate)
    network.calibrate([Drive("a", "k", scans, compose(steps), np.arange(1001.0), FORWARD_CAMERA)])
    assert network.scale.numpy() == pytest.approx(np.full(3, 2.0), rel=0.1)


def test_pairs_that_do_not_share_their_scans_are_refused():
    batch = windows(*drive(), 3)
    batch["pairs"][:, 0, 1] += 0.1
    with pytest.raises(InputError, match="max_turn_deg"):
        CNNWarp(OPTIONS, SENSOR).loss(batch)


def test_the_factor_of_a_sharply_seen_corridor_is_finite():
    rows = torch.tensor([0.6, 0.8, 0.3]).expand(64, 113, 3) + 1e-4 * torch.randn(64, 113, 3)
    matrices = 3e3 * rows.transpose(1, 2) @ rows + 0.02 * torch.eye(3)
    assert torch.isfinite(log_determinant(matrices)).all()
    variances = invert(matrices).diagonal(dim1=-2, dim2=-1)
    assert ((variances > 0) & (variances < 100)).all()


def test_the_loss_counts_errors_by_the_size_of_the_motion():
    network = CNNWarp(OPTIONS, SENSOR)
    truth = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.0, 0.05]])
    motion = truth / network.units + torch.tensor([[0.015, 0, 0], [0.0, 0, 0.105]])
    outputs = network.compare_residuals(motion, torch.eye(3).expand(2, 3, 3), truth)
    assert outputs["loss_relative"].item() == pytest.approx((0.015 / 0.15 + 0.105 / 1.05) / 2)
    assert outputs["loss_likelihood"].item() == pytest.approx((0.015**2 + 0.105**2) / 4)
