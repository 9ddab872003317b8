"""Augmented windows against rooms that are drawn exactly and against the simulator: scans and steps agree."""

import time
from itertools import pairwise

import numpy as np
import pytest
import torch

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import advance, planar_to_poses, poses_to_planar, relative_step
from rcnn_odom.models.encoding import Sensor, decode, encode
from rcnn_odom.simulation import worlds
from rcnn_odom.simulation.laser import Laser
from rcnn_odom.training.augmentation import MIN_VISIBLE_SHARE, Augmentation, moved_steps
from rcnn_odom.training.windows import Windows, WindowSampler, turn_scan
from training.test_datamodule import FULL, HALF, MIRRORED_WALLS, WALLS, encoded, look, random_planar, wrap

torch.set_num_threads(1)
FINE = Sensor(0.25, 360.0, 40.0)
WIDE = Sensor(0.25, 270.0, 40.0)
EVERYTHING = {
    "move": [0.3, 0.1, 3.0],
    "max_range_scale": 1.3,
    "lost_beams": 0.2,
    "lost_sector_deg": 40.0,
    "noise": 0.02,
    "beam_pattern": [0.2, 1.0],
}


def window_of(drive, sensor, length, seed=5, frame=0, mirror=False, **options):
    """Pairs (T, 2, bins) and steps (T, 3) of one augmented window."""
    windows = Windows([drive], sensor, length, Augmentation(sensor, **options))
    batch = windows.__getitems__([(frame, seed, mirror)])
    return batch["pairs"][0].numpy(), batch["steps"][0].numpy().astype(np.float64)


def scans_of(pairs):
    """The scans (T + 1, bins) of a window, which has each of them but the ends twice, and alike."""
    np.testing.assert_array_equal(pairs[1:, 0], pairs[:-1, 1])
    return np.concatenate([pairs[:1, 0], pairs[:, 1]])


def along(start, steps):
    """Poses (T + 1, 3) after each of the steps (T, 3)."""
    poses = [np.asarray(start)]
    for step in steps:
        poses.append(advance(poses[-1], step))
    return np.stack(poses)


def assert_sees(scan, expected, most=0.03, share=0.98):
    """Where a scan has returns they are those expected, but for the corners of a room."""
    seen = scan > 0
    close = np.abs(scan - expected)[seen] < most * np.maximum(1, expected[seen])
    assert close.mean() > share, (close.mean(), np.abs(scan - expected)[seen].max())


# --- nothing asked for ---------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", [FULL, HALF])
@pytest.mark.parametrize("options", [{}, {"max_turn_deg": 25.0}])
def test_without_options_batches_are_as_ever(sensor, options):
    """As version 0.1 wrote them, bit for bit: scans of the drive, whole bins of turns, mirror images."""
    drive = encoded(random_planar(12), sensor=sensor)
    for frame, seed, mirror in ((0, 1, False), (3, 2, True), (8, 2**32 - 1, True)):
        pairs, steps = window_of(drive, sensor, 3, seed, frame, mirror, **options)
        expected = np.stack([drive.scans[frame : frame + 3], drive.scans[frame + 1 : frame + 4]], axis=1)
        truth = drive.steps[frame : frame + 3].astype(np.float32)
        if options:
            turns = np.random.default_rng(seed).integers(-25, 25, 3, endpoint=True)
            for pair, turn in zip(expected, turns, strict=True):
                pair[1] = turn_scan(pair[1], int(turn), sensor)
            truth[:, 2] += turns * np.deg2rad(1.0)
        if mirror:
            expected, truth = expected[..., ::-1], truth * np.float32([1, -1, -1])
        np.testing.assert_array_equal(pairs, expected)
        np.testing.assert_array_equal(steps.astype(np.float32), truth)


def test_the_recording_stays_as_it_is():
    drive = encoded(random_planar(8), sensor=FINE)
    scans, steps = drive.scans.copy(), drive.steps.copy()
    window_of(drive, FINE, 5, mirror=True, max_turn_deg=5.0, **EVERYTHING)
    np.testing.assert_array_equal(drive.scans, scans)
    np.testing.assert_array_equal(drive.steps, steps)


def test_a_window_is_the_same_whenever_and_with_whatever_others_it_is_drawn():
    """So that a training that goes on in the middle of an epoch has the same batches."""
    drive = encoded(random_planar(40), sensor=FINE)
    windows = Windows([drive], FINE, 4, Augmentation(FINE, mirror=True, max_turn_deg=5.0, **EVERYTHING))
    draws = list(WindowSampler([40], 4, True, seed=3, stride=2))
    whole = windows.__getitems__(draws)
    for number in (0, 7, 3):
        alone = windows.__getitems__([draws[number]])
        assert torch.equal(alone["pairs"][0], whole["pairs"][number])
        assert torch.equal(alone["steps"][0], whole["steps"][number])
    assert len({windows.__getitems__([draw])["steps"].sum().item() for draw in draws}) == len(draws)


def test_turns_are_the_same_with_and_without_the_rest():
    drive = encoded(random_planar(8))
    _, turned = window_of(drive, FULL, 5, max_turn_deg=25.0)
    _, both = window_of(drive, FULL, 5, max_turn_deg=25.0, noise=0.1, lost_beams=0.5)
    np.testing.assert_array_equal(turned, both)


# --- moves ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", [FULL, HALF, FINE])
@pytest.mark.parametrize("length", [1, 6])
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_moved_scans_are_what_is_seen_along_the_new_steps(sensor, length, seed):
    planar = random_planar(length + 1, seed)
    pairs, steps = window_of(encoded(planar, sensor=sensor), sensor, length, seed, move=[0.3, 0.2, 5.0])
    poses = along(planar[0], steps)
    for scan, pose in zip(scans_of(pairs), poses, strict=True):
        assert_sees(scan, look(pose, sensor), most=0.06)
        assert np.count_nonzero(scan) > 0.3 * sensor.bins
    np.testing.assert_array_equal(pairs[0, 0], look(planar[0], sensor))
    assert np.abs(poses[1:] - planar[1:]).max(0).min() > 1e-4


@pytest.mark.parametrize("sensor", [FULL, HALF])
def test_moves_are_mirrored_and_turned_too(sensor):
    planar = random_planar(4)
    options = {"move": [0.3, 0.2, 5.0], "max_turn_deg": 25.0}
    pairs, steps = window_of(encoded(planar, sensor=sensor), sensor, 3, mirror=True, **options)
    _, untouched = window_of(encoded(planar, sensor=sensor), sensor, 3, mirror=True, move=[0.3, 0.2, 5.0])
    mirrored = along(planar[0] * [1, -1, -1], untouched)
    for number in range(3):
        expected = look(advance(mirrored[number], steps[number]), sensor, MIRRORED_WALLS)
        assert_sees(pairs[number, 1], expected, most=0.06)


def test_steps_are_those_between_the_places():
    rng = np.random.default_rng(0)
    planar, moves = random_planar(9), rng.normal(0, 0.3, (9, 3))
    steps = moved_steps(np.stack([relative_step(*pair) for pair in pairwise(planar)]), moves)
    places = np.stack([advance(pose, move) for pose, move in zip(planar, moves, strict=True)])
    reached = along(places[0], steps)
    np.testing.assert_allclose(reached[:, :2], places[:, :2], atol=1e-12)
    np.testing.assert_allclose(wrap(reached[:, 2] - places[:, 2]), 0, atol=1e-12)


def test_moves_are_as_large_as_asked_for_and_most_of_them_small():
    drive = encoded(random_planar(2))
    moves = []
    for seed in range(400):
        _, steps = window_of(drive, FULL, 1, seed, move=[0.4, 0.1, 4.0])
        moves.append(relative_step(drive.steps[0], steps[0]))
    size = np.abs(moves)
    # 10**U(-1.5, 0.35): from 0.03 to 2.2 deviations, a quarter of one in the middle.
    np.testing.assert_allclose(np.median(size, 0), 0.17 * np.array([0.4, 0.1, np.deg2rad(4)]), rtol=0.4)
    assert (size.max(0) > [0.8, 0.2, np.deg2rad(8)]).all()
    assert (np.abs(np.mean(moves, 0)) < 0.15 * np.array([0.4, 0.1, np.deg2rad(4)])).all()


def test_a_move_of_which_too_little_is_left_is_made_smaller():
    pose = np.array([0.5, -0.2, 0.3])
    drive = encoded(np.stack([pose, pose]), sensor=HALF)
    before = np.count_nonzero(drive.scans[1])
    turned = []
    for seed in range(60):
        pairs, steps = window_of(drive, HALF, 1, seed, move=[0.0, 0.0, 90.0])
        assert np.count_nonzero(pairs[0, 1]) >= MIN_VISIBLE_SHARE * before
        assert_sees(pairs[0, 1], look(advance(pose, steps[0]), HALF))
        turned.append(abs(np.rad2deg(steps[0, 2])))
    assert 100 < max(turned) < 150


def test_an_empty_scan_can_be_moved():
    drive = encoded(random_planar(3), scans=np.zeros((3, FULL.bins), np.float32))
    pairs, steps = window_of(drive, FULL, 2, **{**EVERYTHING, "beam_pattern": [0.5, 2.0]})
    assert not pairs.any()
    assert np.isfinite(steps).all()


# --- against the simulator -----------------------------------------------------------------------


class NoNoise:
    """In place of a generator: a laser without noise that loses no shot."""

    def standard_normal(self, count):
        return np.zeros(count)

    def random(self, count):
        return np.zeros(count)


def simulated_building(name, frames=40):
    """A function: pose (3,), sensor -> what is seen in a building, and the robot's poses (frames, 3)."""
    recipe = worlds.Recipe(name, 0, "indoor", frames, movers=False, tilt=False, other_paces=False)
    laser = Laser(0.1, max_range=40.0, noise=0.0)

    def see(pose, sensor):
        scene = worlds.scene_near(recipe, 0, 60.0)
        bearings = np.deg2rad(np.arange(sensor.bins) * sensor.resolution_deg + sensor.first_bin_deg)
        at = planar_to_poses([pose])[0]
        at[2, 3] = worlds.poses_of(recipe)[0, 2, 3]
        ranges = laser.shoot(scene, 0, at, bearings[: sensor.bins - 1], NoNoise(), missing=False)
        return encode(bearings[: sensor.bins - 1], ranges, sensor)

    return see, poses_to_planar(worlds.poses_of(recipe))


def is_near(scan, expected, sensor):
    """Of the returns of a scan, in order: which lie within 5 cm of one that is expected, (P,)."""
    points, there = decode(scan, sensor), decode(expected, sensor)
    return np.hypot(*(points[:, None] - there).transpose(2, 0, 1)).min(1) < 0.05


@pytest.mark.parametrize("sensor", [FINE, WIDE])
@pytest.mark.parametrize("options", [{}, {"beam_pattern": [0.2, 0.8]}])
@pytest.mark.parametrize("length", [1, 4])
def test_moved_scans_are_those_of_the_simulator(sensor, options, length):
    """Of the points that are moved, all but some hidden ones lie where something is seen; bins agree."""
    see, planar = simulated_building("moved")
    shares, errors = [], []
    for frame in range(0, 32, 8):
        poses = planar[frame : frame + length + 1]
        drive = encoded(poses, sensor=sensor, scans=np.stack([see(pose, sensor) for pose in poses]))
        pairs, steps = window_of(drive, sensor, length, frame, move=[0.2, 0.1, 5.0], **options)
        new = along(poses[0], steps)
        for scan, pose in zip(scans_of(pairs)[1:], new[1:], strict=True):
            expected = see(pose, sensor)
            distinct = scan[:-1] if sensor.field_of_view_deg == 360 else scan
            bins = np.flatnonzero(distinct)
            both = is_near(scan, expected, sensor)
            shares.append(both.mean())
            errors.append(np.abs(scan - expected)[bins][both & (expected[bins] > 0)])
    assert np.mean(shares) > 0.93, np.mean(shares)
    assert np.median(np.concatenate(errors)) < 0.01
    assert np.quantile(np.concatenate(errors), 0.95) < 0.06


# --- scale, losses, noise ------------------------------------------------------------------------


def test_scaled_window_is_the_scaled_room():
    planar, factors = random_planar(4), []
    for seed in range(12):
        pairs, steps = window_of(encoded(planar), FULL, 3, seed, max_range_scale=8.0)
        factor = np.hypot(*steps[0, :2]) / np.hypot(*encoded(planar).steps[0, :2])
        room = WALLS * [1, 1, factor]
        poses = along(planar[0] * [factor, factor, 1], steps)
        for scan, pose in zip(scans_of(pairs), poses, strict=True):
            expected = look(pose, FULL, room)
            np.testing.assert_allclose(scan, np.where(expected < 40, expected, 0), rtol=1e-4, atol=1e-4)
        factors.append(factor)
    assert 1 / 8 < min(factors) < 0.5
    assert 2 < max(factors) < 8


def test_lost_returns_and_a_lost_sector():
    drive, full = encoded(random_planar(5)), []
    for seed in range(30):
        pairs, steps = window_of(drive, FULL, 4, seed, lost_beams=0.4)
        scans = scans_of(pairs)
        kept = scans > 0
        np.testing.assert_array_equal(scans[kept], drive.scans[kept])
        np.testing.assert_array_equal(scans[:, 0], scans[:, -1])
        np.testing.assert_allclose(steps, drive.steps, atol=1e-6)
        full.append(kept.mean())
    assert 0.58 < min(full) < 0.7
    assert max(full) > 0.9
    for sensor in (FULL, HALF):
        drive, widths, firsts = encoded(random_planar(5), sensor=sensor), [], []
        for seed in range(40):
            lost = scans_of(window_of(drive, sensor, 4, seed, lost_sector_deg=60.0)[0]) == 0
            assert (lost == lost[0]).all(), "of the laser, so the same in all scans"
            distinct = lost[0, :-1] if sensor is FULL else lost[0]
            assert np.count_nonzero(distinct != np.roll(distinct, 1)) <= 2, "one sector"
            widths.append(distinct.sum())
            firsts.append(int(np.argmax(distinct & ~np.roll(distinct, 1))))
        assert max(widths) <= 60
        assert max(widths) > 50
        assert min(widths) < 10
        assert len(set(firsts)) > 20


def test_noise_is_of_returns_alone_and_never_brings_one():
    scans = encoded(random_planar(5)).scans.copy()
    scans[:, 40:50] = 0
    scans[:, 60:70] = 0.01
    scans[:, 80:90] = 39.99
    drive, deviations = encoded(random_planar(5), scans=scans), []
    for seed in range(30):
        noisy = scans_of(window_of(drive, FULL, 4, seed, noise=0.1)[0])
        assert not noisy[:, 40:50].any()
        assert (noisy >= 0).all()
        assert (noisy < 40).all()
        np.testing.assert_array_equal(noisy[:, 0], noisy[:, -1])
        errors = (noisy - scans)[:, 100:-1]
        assert abs(errors.mean()) < 0.02
        deviations.append(errors.std())
    assert min(deviations) < 0.02
    assert 0.085 < max(deviations) < 0.104


# --- beams of another laser ----------------------------------------------------------------------


@pytest.mark.parametrize("sensor", [FINE, WIDE])
def test_a_beam_pattern_shows_the_same_walls(sensor):
    planar, filled = random_planar(3), set()
    drive = encoded(planar, sensor=sensor)
    for seed in range(20):
        pairs, steps = window_of(drive, sensor, 2, seed, beam_pattern=[0.2, 2.0])
        np.testing.assert_allclose(steps, drive.steps, atol=1e-6)
        scans = scans_of(pairs)
        for scan, pose in zip(scans, planar, strict=True):
            assert_sees(scan, look(pose, sensor), most=0.02)
        assert ((scans > 0) == (scans[0] > 0)).all(), "all scans of a window are alike"
        filled.add(round((scans[0] > 0).mean(), 2))
    assert min(filled) < 0.2
    assert max(filled) > 0.97


def test_beams_are_as_far_apart_as_asked_for():
    """Every bin has a return where beams are closer than bins, every n-th where n bins lie between them."""
    drive = encoded(random_planar(2), sensor=WIDE)
    for spacing, gaps in ((0.25, {1}), (0.125, {1}), (0.5, {2}), (1.0, {4}), (0.375, {1, 2}), (0.6, {2, 3})):
        pairs, _ = window_of(drive, WIDE, 1, 2, beam_pattern=[spacing, spacing])
        assert set(np.diff(np.flatnonzero(pairs[0, 0])).tolist()) == gaps
    # One in two half steps of 0.09 degrees, and now and then the next: a Velodyne's.
    ring = Sensor(0.1, 360.0, 80.0)
    drive = encoded(random_planar(2), sensor=ring)
    shares = [(window_of(drive, ring, 1, s, beam_pattern=[0.18, 0.18])[0] > 0).mean() for s in range(40)]
    assert min(shares) == pytest.approx(0.1 / 0.18, abs=0.01)
    assert max(shares) == pytest.approx(0.1 / 0.167, abs=0.02)
    assert 2 <= np.sum(np.array(shares) > 0.57) <= 16


def test_beams_lie_anywhere_between_the_bins():
    drive = encoded(random_planar(2), sensor=FULL)
    firsts = {
        int(np.argmax(window_of(drive, FULL, 1, seed, beam_pattern=[5.0, 5.0])[0][0, 0] > 0))
        for seed in range(60)
    }
    assert firsts == {0, 1, 2, 3, 4}


# --- all at once ---------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", [FINE, WIDE])
def test_everything_at_once_is_exact(sensor):
    for seed in range(10):
        planar = random_planar(4, seed)
        options = EVERYTHING | {"noise": 0.0, "lost_sector_deg": 20.0}
        pairs, steps = window_of(encoded(planar, sensor=sensor), sensor, 3, seed, mirror=True, **options)
        rng = np.random.default_rng([seed, 1])
        factor = 1.3 ** rng.uniform(-1, 1)
        poses = along(planar[0] * [factor, -factor, -1], steps)
        for scan, pose in zip(scans_of(pairs), poses, strict=True):
            assert_sees(scan, look(pose, sensor, MIRRORED_WALLS * [1, 1, factor]), most=0.03, share=0.95)
            assert np.count_nonzero(scan) > 0.1 * sensor.bins


def test_what_it_costs_is_printed():
    """No bound: other work on the machine would break it. It should be some 0.3 ms."""
    sensor = Sensor()
    scans = np.stack([look(pose, sensor) for pose in random_planar(3)])
    scans[:, 1::2] = 0
    augmentation = Augmentation(sensor, **EVERYTHING | {"beam_pattern": [0.05, 0.3]})
    steps = np.array([[1.0, 0.0, 0.1]])
    times = []
    for seed in range(100):
        start = time.perf_counter()
        augmentation.change(scans[:2], steps, seed)
        times.append(time.perf_counter() - start)
    print(f"all augmentation of a pair: {1e3 * min(times):.2f} ms, median {1e3 * np.median(times):.2f} ms")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"move": [1000, 0, 0]}, "at most 10 m, a quarter of data.sensor.max_range, and 90 degrees"),
        ({"move": [0, 0, 91]}, "two scans would have nothing in common"),
        ({"lost_sector_deg": 180.0}, "is all that the sensor sees"),
        ({"beam_pattern": [0.2, 1.0]}, "from 0.5 degrees, half a bin, to 18"),
        ({"beam_pattern": [1.0, 20.0]}, "10 beams in its field of view"),
    ],
)
def test_what_cannot_be_is_refused(options, says):
    with pytest.raises(InputError, match=says) as refusal:
        Augmentation(HALF, **options)
    assert "\n" not in str(refusal.value)
    assert f"data.augment.{next(iter(options))}=" in str(refusal.value)
