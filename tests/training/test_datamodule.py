"""Windows, their sampler, the parts of recordings, and augmentation against a room that is drawn exactly."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, advance, planar_to_poses
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.parts import cut, parse_part
from rcnn_odom.recordings.recording import Drive, Recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.training.augmentation import Augmentation
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.training.windows import Windows, WindowSampler, turn_scan

torch.set_num_threads(1)
FULL, HALF = Sensor(1.0, 360.0, 40.0), Sensor(1.0, 180.0, 40.0)

WALLS = np.array([[1, 0.2, 7], [-0.3, 1, 4], [-1, -0.1, 9], [0.1, -1, 5], [0.8, 0.7, 6.5]])
"""Rows a, b, c: the room is where a x + b y < c. It has no symmetry."""
MIRRORED_WALLS = WALLS * [1, -1, 1]


def look(pose, sensor, walls=WALLS):
    """The exact depth vector at the middle of every bin, from x, y and heading."""
    x, y, heading = pose
    bearing = np.deg2rad(np.arange(sensor.bins) * sensor.resolution_deg - sensor.field_of_view_deg / 2)
    speed = walls[:, :2] @ [np.cos(heading + bearing), np.sin(heading + bearing)]
    room = walls[:, 2] - walls[:, :2] @ [x, y]
    with np.errstate(divide="ignore"):
        depth = np.where(speed > 1e-9, room[:, None] / speed, np.inf)
    return depth.min(0).astype(np.float32)


def random_planar(frames, seed=0):
    rng = np.random.default_rng(seed)
    return np.stack([*rng.uniform(-2, 2, (2, frames)), rng.uniform(-3, 3, frames)], axis=1)


def encoded(planar, name="room", sensor=FULL, scans=None):
    scans = np.stack([look(pose, sensor) for pose in planar]) if scans is None else scans
    stamps = np.arange(len(planar), dtype=np.float64)
    return Drive(name, f"key-{name}", scans, planar_to_poses(planar), stamps, FORWARD_CAMERA)


def numbered(frames, first=0, name="numbered"):
    """A drive whose scans hold their own number and whose distances are it too."""
    numbers = np.arange(first, first + frames)
    planar = np.stack([np.concatenate([[0], np.cumsum(numbers[:-1])]), *np.zeros((2, frames))], axis=1)
    scans = np.repeat(numbers[:, None], FULL.bins, axis=1).astype(np.float32)
    return encoded(planar, name, scans=scans)


def turned_left(pose, degrees):
    return pose[0], pose[1], pose[2] + np.deg2rad(degrees)


def wrap(angle):
    return np.angle(np.exp(1j * np.asarray(angle)))


# --- windows -------------------------------------------------------------------------------------


def test_window_holds_consecutive_pairs_and_their_steps():
    drives = [numbered(6), numbered(5, first=100)]
    windows = Windows(drives, FULL, length=3)
    batch = windows.__getitems__([(2, 0, False), (6, 0, False), (7, 0, False)])
    assert batch["pairs"].shape == (3, 3, 2, 361)
    assert batch["steps"].shape == (3, 3, 3)
    assert batch["pairs"].dtype == batch["steps"].dtype == torch.float32
    first_frames = [[2, 3, 4], [100, 101, 102], [101, 102, 103]]
    assert batch["pairs"][:, :, 0, 0].tolist() == first_frames
    assert batch["pairs"][:, :, 1, 0].tolist() == [[n + 1 for n in row] for row in first_frames]
    np.testing.assert_allclose(batch["steps"][..., 0], first_frames)
    np.testing.assert_allclose(batch["steps"][..., 1:], 0, atol=1e-7)


def test_augmentation_leaves_the_recording_alone():
    drive = encoded(random_planar(5))
    scans, steps = drive.scans.copy(), drive.steps.copy()
    Windows([drive], FULL, 3, Augmentation(FULL, max_turn_deg=20)).__getitems__([(0, 1, True), (1, 2, False)])
    np.testing.assert_array_equal(drive.scans, scans)
    np.testing.assert_array_equal(drive.steps, steps)


def drawn(lengths, window, seed=0, epoch=0, mirror=False, stride=None):
    sampler = WindowSampler(lengths, window, mirror, seed, stride)
    sampler.set_epoch(epoch)
    draws = list(sampler)
    assert len(draws) == len(sampler)
    return draws


@pytest.mark.parametrize("window", [1, 2, 5, 16])
def test_window_stays_within_its_drive(window):
    lengths = [17, 40, 33, 18, 50]
    borders = np.cumsum([0, *lengths])
    for epoch in range(40):
        pairs = np.array([frame + np.arange(window) for frame, _, _ in drawn(lengths, window, epoch=epoch)])
        drive = np.searchsorted(borders, pairs[:, 0], side="right") - 1
        assert (pairs[:, -1] + 1 < borders[drive + 1]).all()
        # Nothing twice in an epoch, and every drive at least once.
        assert len(np.unique(pairs)) == pairs.size
        assert set(drive) == set(range(5))


@pytest.mark.parametrize("window", [1, 2, 5, 16])
@pytest.mark.parametrize("frames", [17, 31, 32, 33, 40, 47, 63])
def test_every_pair_is_trained_on_in_some_epoch(window, frames):
    seen = set()
    for epoch in range(400):
        for frame, _, _ in drawn([frames], window, epoch=epoch):
            seen |= set(range(frame, frame + window))
    assert seen == set(range(frames - 1))


@pytest.mark.parametrize(("window", "stride"), [(16, 4), (5, 1), (3, 7), (1, 3), (16, 40)])
def test_windows_begin_a_stride_apart(window, stride):
    lengths = [17, 40, 33]
    borders, seen = np.cumsum([0, *lengths]), set()
    for epoch in range(400):
        frames = np.array(sorted(frame for frame, _, _ in drawn(lengths, window, 0, epoch, stride=stride)))
        drive = np.searchsorted(borders, frames, side="right") - 1
        assert set(drive) == {0, 1, 2}
        assert (frames + window < borders[drive + 1]).all()
        assert (np.diff(frames)[np.diff(drive) == 0] == stride).all()
        seen |= {int(frame) + pair for frame in frames for pair in range(window)}
    assert seen == {frame for low, high in pairwise(borders) for frame in range(low, high - 1)}


def test_a_stride_of_the_window_is_the_default():
    for window in (1, 2, 16):
        assert drawn([40, 33], window, 3, 2) == drawn([40, 33], window, 3, 2, stride=window)
    # 160 frames: 9 windows of 16 pairs as ever, 36 where each begins 4 frames after the one before.
    assert [len(drawn([160], 16, stride=stride)) for stride in (None, 4, 1)] == [9, 36, 144]


def test_single_pairs_are_all_drawn_in_every_epoch():
    frames = sorted(frame for frame, _, _ in drawn([4, 3], 1))
    assert frames == [0, 1, 2, 4, 5]


def test_epoch_is_the_same_however_it_was_reached():
    sampler = WindowSampler([50, 60], 4, True, seed=3)
    list(sampler)
    sampler.set_epoch(1)
    list(sampler)
    sampler.set_epoch(2)
    assert list(sampler) == drawn([50, 60], 4, seed=3, epoch=2, mirror=True)


def test_epochs_and_seeds_differ():
    lengths = [50, 60]
    orders = [drawn(lengths, 4, seed, epoch) for seed, epoch in ((0, 0), (0, 1), (1, 0), (0, 2))]
    frames = [tuple(frame for frame, _, _ in order) for order in orders]
    assert len(set(frames)) == 4
    assert len({tuple(sorted(order)) for order in frames}) > 1
    assert list(frames[0]) != sorted(frames[0])


def test_half_of_the_windows_are_mirrored_if_asked_for():
    assert not any(mirror for _, _, mirror in drawn([2000], 1))
    assert 0.4 < np.mean([mirror for _, _, mirror in drawn([2000], 1, mirror=True)]) < 0.6


# --- augmentation --------------------------------------------------------------------------------


@pytest.mark.parametrize("bins", [0, 1, -1, 7, -30, 90, 180, -180])
def test_turned_scan_is_what_a_turned_laser_sees(bins):
    pose = np.array([0.5, -1.2, 0.3])
    turned = turn_scan(look(pose, FULL), bins, FULL)
    np.testing.assert_allclose(turned, look(turned_left(pose, bins), FULL), rtol=1e-5)
    assert turned[0] == turned[-1]


@pytest.mark.parametrize("bins", [0, 1, -1, 7, -30, 90, -90, 180, -180, 181, -181, 200, -200])
def test_turned_half_circle_is_empty_where_nothing_was_seen(bins):
    pose = np.array([0.5, -1.2, 0.3])
    turned = turn_scan(look(pose, HALF), bins, HALF)
    bearing = np.arange(181) - 90 + bins
    expected = np.where(np.abs(bearing) <= 90, look(turned_left(pose, bins), HALF), 0)
    np.testing.assert_allclose(turned, expected, rtol=1e-5)


def test_turned_window_has_exact_labels():
    planar = random_planar(9)
    drive = encoded(planar)
    batch = Windows([drive], FULL, 8, Augmentation(FULL, max_turn_deg=25)).__getitems__([(0, 5, False)])
    pairs, steps = batch["pairs"][0].numpy(), batch["steps"][0].numpy().astype(np.float64)
    for number, (pair, step) in enumerate(zip(pairs, steps, strict=True)):
        np.testing.assert_allclose(pair[0], look(planar[number], FULL), rtol=1e-5)
        np.testing.assert_allclose(pair[1], look(advance(planar[number], step), FULL), rtol=1e-4)
    turns = np.rad2deg(wrap(steps[:, 2] - drive.steps[:, 2]))
    np.testing.assert_allclose(turns, turns.round(), atol=1e-4)
    assert len(set(turns.round())) > 3
    assert np.abs(turns).max() < 25.5
    np.testing.assert_allclose(steps[:, :2], drive.steps[:, :2], rtol=1e-6)


@pytest.mark.parametrize("sensor", [FULL, HALF])
def test_mirrored_window_is_a_drive_through_the_mirrored_room(sensor):
    planar = random_planar(6)
    mirrored = planar * [1, -1, -1]
    batch = Windows([encoded(planar, sensor=sensor)], sensor, 5).__getitems__([(0, 0, True)])
    pairs, steps = batch["pairs"][0].numpy(), batch["steps"][0].numpy().astype(np.float64)
    for number, (pair, step) in enumerate(zip(pairs, steps, strict=True)):
        before, after = mirrored[number : number + 2]
        np.testing.assert_allclose(pair[0], look(before, sensor, MIRRORED_WALLS), rtol=1e-4)
        np.testing.assert_allclose(pair[1], look(after, sensor, MIRRORED_WALLS), rtol=1e-4)
        reached = advance(before, step)
        np.testing.assert_allclose(reached[:2], after[:2], atol=1e-5)
        np.testing.assert_allclose(wrap(reached[2] - after[2]), 0, atol=1e-5)


def test_turned_and_mirrored_window_has_exact_labels():
    planar = random_planar(4)
    windows = Windows([encoded(planar)], FULL, 3, Augmentation(FULL, max_turn_deg=25))
    batch = windows.__getitems__([(0, 5, True)])
    mirrored = planar * [1, -1, -1]
    for number in range(3):
        step = batch["steps"][0, number].numpy().astype(np.float64)
        expected = look(advance(mirrored[number], step), FULL, MIRRORED_WALLS)
        np.testing.assert_allclose(batch["pairs"][0, number, 1], expected, rtol=1e-4)


# --- parts and the unknown truth -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("05", ("05", 0.0, 1.0, 1)),
        ("mit-killian[:0.85]", ("mit-killian", 0.0, 0.85, 1)),
        ("mit-killian[0.85:]", ("mit-killian", 0.85, 1.0, 1)),
        ("a b[0.25:0.5]", ("a b", 0.25, 0.5, 1)),
        ("x[:]", ("x", 0.0, 1.0, 1)),
        ("x[::3]", ("x", 0.0, 1.0, 3)),
        ("x[0.2:0.8:12]", ("x", 0.2, 0.8, 12)),
        ("x[0.5::1]", ("x", 0.5, 1.0, 1)),
        ("x[::]", ("x", 0.0, 1.0, 1)),
    ],
)
def test_part_is_named_by_fractions(text, expected):
    assert parse_part(text) == expected


@pytest.mark.parametrize(
    "text", ["x[0.5]", "x[1:2]", "x[0.5:0.5]", "x[0.6:0.5]", "x[a:b]", "x[-0.1:1]", "x[.:1]", "x[:0]"]
)
def test_wrong_part_is_refused(text):
    with pytest.raises(InputError, match="sequence"):
        parse_part(text)


@pytest.mark.parametrize("every", ["0", "-1", "1.5", "x", " 3", "1e2", "٣", "3" * 20])
def test_a_stride_that_is_none_is_refused(every):
    with pytest.raises(InputError, match="after the second colon comes a whole number from 1 on") as refusal:
        parse_part(f"x[0.2:0.8:{every}]")
    assert "\n" not in str(refusal.value)
    with pytest.raises(InputError, match="a part is written"):
        parse_part("x[::3:4]")


def test_every_third_scan_is_a_drive_of_its_own():
    whole = replace(numbered(41), wheel_odometry=numbered(41).poses)
    whole = replace(whole, read_scan=lambda frame: Scan(np.full(3, float(frame)), stamp=frame))
    for name, frames in (("x[::3]", range(0, 41, 3)), ("x[0.25:0.75:4]", range(10, 31, 4))):
        part = cut({"x": whole}, name)
        assert (part.name, len(part), part.frames) == (name, len(frames), frames)
        np.testing.assert_array_equal(part.scans[:, 0], frames)
        assert part.scans.base is whole.scans, "nothing is copied"
        np.testing.assert_array_equal(part.stamps, frames)
        np.testing.assert_array_equal(part.poses, whole.poses[list(frames)])
        np.testing.assert_array_equal(part.wheel_odometry, part.poses)
        assert [scan.ranges[0] for scan in part.raw_scans()] == list(frames)
        np.testing.assert_allclose(part.steps[:, 0], [sum(range(f, f + frames.step)) for f in frames[:-1]])
    again = cut({"x": whole}, "x[0.25:0.75:4]").part(1, 4)
    assert [scan.stamp for scan in again.raw_scans()] == [14, 18, 22]


def test_unknown_truth_of_every_third_scan():
    part = cut({"x": with_unknown(numbered(20), 0, 1, 2, 4, 19)}, "x[::3]")
    assert part.scans[:, 0].tolist() == [3, 6, 9, 12, 15, 18]
    with pytest.raises(InputError, match="frame 9 is unknown, between"):
        cut({"x": with_unknown(numbered(20), 9)}, "x[::3]")
    with pytest.raises(InputError, match="1 frames with known poses"):
        cut({"x": numbered(20)}, "x[::20]")


def test_windows_of_every_third_scan():
    drive = cut({"x": numbered(40)}, "x[0.25::3]")
    batch = Windows([drive], FULL, 4).__getitems__([(2, 0, False)])
    assert batch["pairs"][0, :, 0, 0].tolist() == [16, 19, 22, 25]
    assert batch["pairs"][0, :, 1, 0].tolist() == [19, 22, 25, 28]
    np.testing.assert_allclose(
        batch["steps"][0, :, 0], [16 + 17 + 18, 19 + 20 + 21, 22 + 23 + 24, 25 + 26 + 27]
    )


def test_parts_do_not_overlap_and_leave_nothing_out():
    whole = numbered(41)
    head, tail = (cut({"x": whole}, name) for name in ("x[:0.85]", "x[0.85:]"))
    assert (head.name, tail.name) == ("x[:0.85]", "x[0.85:]")
    np.testing.assert_array_equal(np.concatenate([head.scans, tail.scans]), whole.scans)
    assert len(head) == round(0.85 * 41)


def with_unknown(drive, *frames):
    drive.poses[list(frames)] = np.nan
    return drive


def test_unknown_truth_at_the_ends_is_cut():
    part = cut({"x": with_unknown(numbered(10), 0, 1, 9)}, "x")
    assert part.scans[:, 0].tolist() == [2, 3, 4, 5, 6, 7, 8]
    assert np.isfinite(part.steps).all()


def test_unknown_truth_inside_is_refused_and_named():
    with pytest.raises(InputError, match="frame 4"):
        cut({"x": with_unknown(numbered(10), 0, 4, 5)}, "x")
    assert len(cut({"x": with_unknown(numbered(10), 4)}, "x[0.5:]")) == 5


@pytest.mark.parametrize("known", [0, 1])
def test_fewer_than_two_known_poses_are_refused(known):
    with pytest.raises(InputError, match="two are needed"):
        cut({"x": with_unknown(numbered(5), *range(known, 5))}, "x")


# --- the module ----------------------------------------------------------------------------------


def open_room(name):
    """A drive that looks at the room from the middle of every bin."""
    frames = {"long": 40, "short": 5}[name]
    planar = random_planar(frames, seed=frames)
    angles = np.deg2rad(np.arange(-180.0, 180.0))
    # A method of a list: the workers that encode need not import this file, and with it torch.
    read_scan = [Scan(look(pose, FULL)[:-1].astype(np.float64), angles) for pose in planar].__getitem__
    stamps = np.arange(frames, dtype=np.float64)
    return Recording(name, planar_to_poses(planar), stamps, read_scan, fingerprint=name)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def room_module(cache, train=("long",), val=("short",), test=("long[0.5:]", "short"), **options):
    options = {"workers": 1, **options}
    return OdometryDataModule(open_room, list(train), list(val), list(test), FULL, cache, **options)


def test_module_reads_encodes_and_cuts(cache):
    module = room_module(cache).load()
    assert [len(s) for split in ("train", "val", "test") for s in module.drives[split]] == [40, 5, 20, 5]
    planar = random_planar(40, seed=40)
    expected = np.stack([look(pose, FULL) for pose in planar])
    np.testing.assert_allclose(module.drives["train"][0].scans, expected, rtol=1e-5)
    np.testing.assert_allclose(module.drives["test"][0].scans, expected[20:], rtol=1e-5)


def test_module_thins_what_it_encoded_once(cache):
    module = room_module(cache, train=("long[::3]",), val=("long[0.5::2]",), test=("long",)).load()
    whole = module.drives["test"][0].scans
    np.testing.assert_array_equal(module.drives["train"][0].scans, whole[::3])
    np.testing.assert_array_equal(module.drives["val"][0].scans, whole[20::2])
    [item] = list(module.val_dataloader())
    np.testing.assert_array_equal(item["scans"], whole[20::2])
    with pytest.raises(InputError, match=r"data.train=long\[::3\]: new worlds come as whole drives"):
        room_module(cache, train=("long[::3]",), fresh_epochs=2).load()


def test_module_without_depth_vectors(tmp_path):
    def open_other(name):
        """A laser of which the sensor knows nothing, with nothing in sight at first."""
        scans = [Scan(np.full(5, float(number)), np.full(5, 0.1), stamp=number) for number in range(9)]
        return replace(open_room("long"), **parts(scans), has_clock=False, is_compensated=True)

    def parts(scans):
        poses, stamps = planar_to_poses(random_planar(9)), np.arange(9.0)
        return {"poses": poses, "stamps": stamps, "read_scan": scans.__getitem__}

    names = (["a"], ["a[0.5:]"], ["a", "a[::3]"])
    module = OdometryDataModule(open_other, *names, FULL, tmp_path / "none", workers=1)
    module.load(("test",), encode=False)
    whole, third = module.drives["test"]
    assert (whole.scans.shape, third.scans.shape, len(third)) == ((9, 0), (3, 0), 3)
    assert (third.has_clock, third.is_compensated, third.name) == (False, True, "a[::3]")
    assert [(scan.ranges[0], scan.stamp) for scan in third.raw_scans()] == [(0, None), (3, None), (6, None)]
    assert third.steps.shape == (2, 3)
    assert not (tmp_path / "none").exists(), "nothing is encoded"


def test_a_recording_without_a_return_is_refused(tmp_path):
    def open_dark(name):
        nothing = Scan(np.full(360, 400.0), np.deg2rad(np.arange(-180.0, 180.0)))
        return replace(open_room("short"), read_scan=([nothing] * 5).__getitem__, fingerprint="dark")

    module = OdometryDataModule(open_dark, ["short"], ["short"], ["short"], FULL, tmp_path, workers=1)
    with pytest.raises(
        InputError, match=r"short: none of its 5 scans has a return: of their readings 1800 are at"
    ):
        module.load()


def test_scans_without_a_return_are_told(tmp_path, caplog):
    def open_flickering(name):
        drive = open_room("short")
        scans = [drive.read_scan(0), Scan(np.zeros(360), drive.read_scan(0).bearings)] * 2 + [
            drive.read_scan(4)
        ]
        return replace(drive, read_scan=scans.__getitem__, fingerprint="flickering")

    OdometryDataModule(open_flickering, ["a"], ["a"], ["a"], FULL, tmp_path, workers=1).load()
    assert "short: 2 of 5 scans have no return that the sensor has a bin for" in caplog.text


def test_a_laser_that_faces_aside_has_no_mirror_image(cache):
    aside = Sensor(1.0, 180.0, 40.0, facing_deg=90.0)
    with pytest.raises(
        InputError, match="the mirror image of a laser that faces 90 degrees is another laser"
    ):
        OdometryDataModule(open_room, [], [], [], aside, cache, mirror=True)
    behind = Sensor(1.0, 180.0, 40.0, facing_deg=180.0)
    assert OdometryDataModule(open_room, [], [], [], behind, cache, mirror=True).augmentation.mirror


def test_validation_and_test_are_whole_drives_in_order(cache):
    module = room_module(cache, val=("short", "long[:0.5]")).load()
    for split, loader in (("val", module.val_dataloader()), ("test", module.test_dataloader())):
        items = list(loader)
        assert [item["name"] for item in items] == module.names[split]
        for item, drive in zip(items, module.drives[split], strict=True):
            np.testing.assert_array_equal(item["scans"], drive.scans)


def test_training_batches_have_the_asked_shape(cache):
    module = room_module(cache, window=4, batch_size=3).load()
    batches = list(module.train_dataloader())
    assert len(batches) == (40 // 4 - 1) // 3
    assert all(batch["pairs"].shape == (3, 4, 2, 361) for batch in batches)
    assert len(list(room_module(cache, batch_size=1000).load().train_dataloader())) == 1


def test_stride_makes_more_batches_of_overlapping_windows(cache):
    module = room_module(cache, window=4, batch_size=3, stride=1).load()
    assert module.batches_per_epoch == len(module.train_dataloader()) == (40 - 4) // 3


def test_turn_is_asked_for_in_degrees(cache):
    sensor = Sensor(0.5, 360.0, 40.0)
    module = OdometryDataModule(open_room, [], [], [], sensor, cache, max_turn_deg=3.0)
    assert module.augmentation.max_turn_bins == 6


def test_training_steps_are_those_of_the_training_drives(cache):
    module = room_module(cache, train=("short", "long[:0.25]")).load()
    steps = np.concatenate(module.training_steps())
    drives = random_planar(5, seed=5), random_planar(40, seed=40)[:10]
    befores, afters = (
        np.concatenate([planar[part] for planar in drives]) for part in (slice(-1), slice(1, None))
    )
    assert steps.shape == (4 + 9, 3)
    reached = np.stack([advance(*both) for both in zip(befores, steps, strict=True)])
    np.testing.assert_allclose(reached[:, :2], afters[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrap(reached[:, 2] - afters[:, 2]), 0, atol=1e-9)


def test_window_longer_than_a_training_drive_is_refused(cache):
    with pytest.raises(InputError, match="short has 5 frames, a window needs 6"):
        room_module(cache, train=("long", "short"), window=5).load()
    assert len(room_module(cache, train=("short",), window=4).load().train_dataloader()) == 1


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_empty_split_is_refused(cache, split):
    with pytest.raises(InputError, match=rf"data\.{split}"):
        room_module(cache, **{split: ()}).load()


def test_other_splits_need_not_be_given(cache):
    module = room_module(cache, train=(), val=()).load(("test",))
    assert list(module.drives) == ["test"]
