"""One beam out of a spinning laser's points, in whatever order they come."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from conftest import SHARED
from data.make_kitti import LEVEL_RING, make_kitti
from data.point_orders import PERMUTED, RINGED, THINNED, thin
from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.matcher import MatcherTracker
from rcnn_odom.models.tracking import Kind, Tracking
from rcnn_odom.recordings import kitti
from rcnn_odom.recordings.velodyne import (
    are_thinned,
    find_level_beam,
    level_elevation,
    points_at,
    ring_starts,
    split_rings,
)
from rcnn_odom.recordings.velodyne_files import read_points
from scans import beams

REAL = SHARED / "data" / "kitti"
SENSOR = Sensor(0.5, 360.0, 80.0)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    make_kitti(tmp_path, ["00"], frames=4)
    return tmp_path


def scan_file(root: Path, frame: int) -> Path:
    return root / "sequences" / "00" / "velodyne" / f"{frame:06d}.bin"


def reorder(root: Path, order, frames=range(4)) -> None:
    for frame in frames:
        points = np.fromfile(scan_file(root, frame), "<f4").reshape(-1, 4)
        np.ascontiguousarray(order(points), "<f4").tofile(scan_file(root, frame))


def encoded(root: Path, ring: int | None = None) -> np.ndarray:
    """Depth vectors (4, bins) of a sequence."""
    sequence = kitti.load("00", root=root, ring=ring)
    return np.array([SENSOR.encode(sequence.read_scan(frame)) for frame in range(len(sequence))])


def assert_nearly_all_equal(found: np.ndarray, expected: np.ndarray) -> None:
    """But for the few points whose noise in height, of 4 standard deviations, takes them to a neighbour."""
    assert np.mean(np.abs(found - expected) < 1e-4) > 0.998


def laser(
    elevations_deg, height: float = 0.0, jitter_deg: float = 0.01, points: int = 900, seed: int = 0
) -> np.ndarray:
    """Points (P, 3) of a laser whose beams meet at a height, one beam after the other, each in one turn."""
    rng = np.random.default_rng(seed)
    clouds = []
    for elevation in elevations_deg:
        angle = np.sort(rng.uniform(0, 2 * np.pi, points))
        distance = rng.uniform(3, 60, points)
        tilt = np.deg2rad(elevation + rng.normal(0, jitter_deg, points))
        z = height + distance * np.tan(tilt)
        clouds.append(np.stack([distance * np.cos(angle), distance * np.sin(angle), z], axis=1))
    return np.concatenate(clouds)


def shuffle(points: np.ndarray) -> np.ndarray:
    return np.random.default_rng(1).permutation(points)


# Points laser by laser


def points_with(*azimuths_deg: float) -> np.ndarray:
    angle = np.deg2rad(np.array(azimuths_deg))
    return np.stack([10 * np.cos(angle), 10 * np.sin(angle), 0 * angle], axis=1).astype(np.float32)


@pytest.mark.parametrize(
    ("azimuths", "starts"),
    [
        ((1, 90, 180, 270, 359, 1, 90, 180, 270, 359), [0, 5]),
        ((1, 90, 180, 270, 359.9, 0.1, 359.95, 0.2, 90, 180), [0, 5]),  # noise over the wrap
        ((359.9, 0.1, 359.8, 1, 90, 200, 350, 2, 90), [0, 7]),  # noise at the beginning
        ((1, 90, 179.9, 180.1, 179.95, 180.2, 300, 2), [0, 7]),  # noise straight behind
        ((1, 60, 53, 100, 270, 2), [0, 5]),  # parallax of a close object
        ((10, 170, 20, 160, 15), [0, 2, 4]),  # rings that see only the left
        ((200, 300, 190, 310), [0, 2]),  # rings that see only the right
        ((100, 320, 5, 200), [0, 2]),  # gaps of more than half a turn within a ring
        ((5, 200, 100, 330), [0, 2]),
        ((5,), [0]),
    ],
)
def test_ring_starts(azimuths: tuple[float, ...], starts: list[int]) -> None:
    assert ring_starts(points_with(*azimuths)).tolist() == starts


@pytest.mark.parametrize("order", RINGED)
def test_rings_are_told_where_points_come_laser_by_laser(order: str) -> None:
    rings = split_rings(RINGED[order](laser(np.linspace(2, -24, 64), height=0.2)))
    assert rings is not None
    assert len(rings) in (64, 65)  # one where a laser's turn is cut in two


@pytest.mark.parametrize("order", PERMUTED | THINNED)
def test_other_orders_are_told(order: str) -> None:
    points = (PERMUTED | THINNED)[order](laser(np.linspace(2, -24, 64), height=0.2))
    assert split_rings(points) is None


@pytest.mark.parametrize("lasers", [2, 16, 32, 40, 128])
def test_columns_of_as_many_lasers_as_a_sample_skips(lasers: int) -> None:
    columns = laser(np.linspace(15, -15, lasers), points=60_000 // lasers)
    columns = columns.reshape(lasers, -1, 3).swapaxes(0, 1).reshape(-1, 3)
    assert split_rings(columns) is None


def tilted_laser() -> np.ndarray:
    angle = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    x, y = 10 * np.cos(angle), 10 * np.sin(angle)
    return np.stack([x, y, 0.1 * x], axis=1)


@pytest.mark.parametrize(
    "points",
    [
        pytest.param(laser([0.0], jitter_deg=0.0), id="flat"),
        pytest.param(shuffle(laser([0.0], jitter_deg=0.0)), id="flat, shuffled"),
        pytest.param(laser([-0.4], height=0.2), id="a ring"),
        pytest.param(laser([-0.4], height=0.2)[::-1], id="a ring, reversed"),
        pytest.param(shuffle(laser([-0.4], height=0.2)), id="a ring, shuffled"),
        pytest.param(np.roll(laser([0.0], jitter_deg=0.0), 300, axis=0), id="beginning aside"),
        pytest.param(tilted_laser(), id="tilted, beginning behind"),
        pytest.param(tilted_laser()[::-1], id="tilted, clockwise"),
    ],
)
def test_a_laser_of_one_beam_is_taken_whole(points: np.ndarray) -> None:
    rings = split_rings(points)
    assert rings is not None
    assert sum(map(len, rings)) == len(rings[0]) == len(points)


# Points in any order


@pytest.mark.parametrize(
    ("elevations", "height", "expected"),
    [
        (np.arange(-15, 16, 2), 0.0, 1.0),  # VLP-16
        (np.linspace(-30.67, 10.67, 32), 0.0, 0.0),  # HDL-32
        (np.linspace(-22.5, 22.5, 64), 0.0, 0.357),  # OS1-64
        ([2.0], 0.0, 2.0),
        ([0.58, 0.18, -0.09, -0.45, -0.81, -1.2, -1.5], 0.207, -0.09),  # KITTI's; at +0.29 from the origin
    ],
)
def test_level_beam(elevations, height: float, expected: float) -> None:
    clouds = [shuffle(laser(elevations, height, seed=seed)) for seed in range(2)]
    beam = find_level_beam(clouds)
    assert np.rad2deg(beam.elevation) == pytest.approx(expected, abs=0.03)
    assert beam.height == pytest.approx(height, abs=0.011)
    assert np.rad2deg(level_elevation(clouds, height)) == pytest.approx(expected, abs=0.02)
    found = points_at(clouds[0], *beam)
    assert len(found) == 900
    cone = found[:, 2] - height - np.hypot(found[:, 0], found[:, 1]) * np.tan(np.deg2rad(expected))
    assert np.abs(cone).max() < 60 * np.deg2rad(0.05)


@pytest.mark.parametrize("elevations", [[-5, -8, -12], [4.0, 9.0]])
def test_no_beam_near_level(elevations) -> None:
    with pytest.raises(ValueError, match="no beam of the laser is within 2 degrees of level"):
        find_level_beam([shuffle(laser(elevations))])


def test_no_points_have_no_beam() -> None:
    with pytest.raises(ValueError, match="no beam"):
        level_elevation([np.zeros((0, 3))])


@pytest.mark.parametrize(("leaf", "thinned"), [(0.0, False), (0.1, True), (0.3, True)])
def test_a_thinned_beam_is_told(leaf: float, thinned: bool) -> None:
    angle = np.linspace(-np.pi, np.pi, 2000, endpoint=False)
    distance = np.where(angle > 0, 6.0, 40.0)  # two walls, half a circle each
    beam = np.stack([distance * np.cos(angle), distance * np.sin(angle), 0 * angle], axis=1)
    assert are_thinned([thin(shuffle(beam), leaf) if leaf else shuffle(beam)]) == thinned
    assert not are_thinned([shuffle(beam)[::10]])
    assert not are_thinned([beam[:0], beam[:1]])


# Recordings in other orders


@pytest.mark.parametrize("order", PERMUTED)
def test_a_permuted_recording_gives_the_same_scans(root: Path, order: str) -> None:
    expected = encoded(root)
    reorder(root, PERMUTED[order])
    assert_nearly_all_equal(encoded(root), expected)
    note = kitti.load("00", root=root).notes[1]
    assert note == "points are not laser by laser; the beam at +0.10 degrees is found by elevation"
    assert note in kitti.stream(root / "sequences" / "00").notes


@pytest.mark.parametrize("order", THINNED)
def test_a_thinned_recording_gives_nearly_the_same_scans(root: Path, order: str) -> None:
    expected = encoded(root)
    reorder(root, THINNED[order])
    found = encoded(root)
    both = (found > 0) & (expected > 0)
    assert both.sum() > 0.5 * (expected > 0).sum()
    assert np.median(np.abs(found - expected)[both]) < 0.1
    assert "points are not laser by laser" in kitti.load("00", root=root).notes[1]


@pytest.mark.parametrize("order", ["every third", "from another laser on"])
def test_rings_that_are_still_rings(root: Path, order: str) -> None:
    expected = encoded(root)
    reorder(root, RINGED[order])
    found = encoded(root)
    both = (found > 0) & (expected > 0)
    assert both.sum() > 0.3 * (expected > 0).sum()
    np.testing.assert_allclose(found[both], expected[both], atol=0.2)
    assert kitti.load("00", root=root).notes[1].startswith("ring ")


def test_one_frame_in_another_order_is_taken_by_elevation(root: Path) -> None:
    expected = encoded(root), encoded(root, ring=3)
    reorder(root, PERMUTED["shuffled"], frames=[2])
    for found, wanted in zip((encoded(root), encoded(root, ring=3)), expected, strict=True):
        assert_nearly_all_equal(found, wanted)
    sequence = kitti.load("00", root=root)
    assert f"ring {LEVEL_RING} " in sequence.notes[1]
    assert sequence.notes[2].startswith("points of 1 in 4 frames are not laser by laser")


def test_a_frame_of_rubbish_is_no_scan(root: Path) -> None:
    sequence = kitti.load("00", root=root)
    sky = shuffle(laser([10, 25, 40]))
    np.column_stack([sky, np.zeros(len(sky))]).astype("<f4").tofile(scan_file(root, 2))
    with pytest.raises(InputError, match=r"000002\.bin: its points do not come laser by laser, and none is"):
        sequence.read_scan(2)


def test_a_ring_of_points_in_another_order_is_refused(root: Path) -> None:
    reorder(root, PERMUTED["shuffled"])
    with pytest.raises(InputError, match=r"so there is no ring 2; leave out data\.ring .*--ring") as raised:
        kitti.load("00", root=root, ring=2)
    assert "\n" not in str(raised.value)


def test_points_all_far_from_level_are_refused(root: Path) -> None:
    ground = laser([-5, -8, -12]).astype("<f4")
    ground = np.column_stack([ground, np.zeros(len(ground), "<f4")])
    reorder(root, lambda _: ground)
    with pytest.raises(
        InputError, match=r"of its 3 rings lies at -5\.0 degrees.*; if it is right, set data\.ring=0"
    ):
        kitti.load("00", root=root)
    assert (encoded(root, ring=0) > 0).any()
    reorder(root, shuffle)
    with pytest.raises(
        InputError, match="not come laser by laser, and no beam of the laser is within 2 deg"
    ) as raised:
        kitti.load("00", root=root)
    assert "\n" not in str(raised.value)


def test_a_laser_of_one_beam_whose_turn_begins_aside(root: Path) -> None:
    flat = np.column_stack([laser([0.0], jitter_deg=0.0), np.zeros(900)]).astype("<f4")
    for order in (lambda points: points, lambda points: np.roll(points, 300, axis=0), shuffle):
        reorder(root, lambda _, order=order: order(flat))
        bearings, ranges = beams(kitti.load("00", root=root).read_scan(0))
        assert len(bearings) == 900
        np.testing.assert_allclose(np.sort(ranges), np.sort(np.hypot(flat[:, 0], flat[:, 1])), rtol=1e-6)


# Missing returns, other points, other frames


def with_origins(points: np.ndarray) -> np.ndarray:
    points = points.copy()
    points[np.random.default_rng(3).random(len(points)) < 0.3] = 0
    return points


@pytest.mark.parametrize("order", [lambda points: points, shuffle])
def test_points_at_the_origin_are_missing_returns(root: Path, order) -> None:
    originals = [np.fromfile(scan_file(root, frame), "<f4").reshape(-1, 4) for frame in range(4)]
    for frame, points in enumerate(map(with_origins, originals)):
        points[points.any(axis=1)].tofile(scan_file(root, frame))
    expected = encoded(root)
    for frame, points in enumerate(map(with_origins, originals)):
        order(points).tofile(scan_file(root, frame))
    assert_nearly_all_equal(encoded(root), expected)


def test_read_points_leaves_out_the_origin_only(tmp_path: Path) -> None:
    points = np.array([[1, 2, 3, 0], [0, 0, 0, 0.5], [0, 0, 1, 0], [0, 2, 0, 0]], "<f4")
    points.tofile(tmp_path / "a.bin")
    np.savetxt(tmp_path / "a.txt", points)
    for name in ("a.bin", "a.txt"):
        np.testing.assert_array_equal(read_points(tmp_path / name), points[[0, 2, 3]])


@pytest.mark.parametrize("floats", [3, 5, 6])
def test_other_than_four_floats_a_point_are_refused(root: Path, floats: int) -> None:
    def pack(points: np.ndarray) -> np.ndarray:
        extra = np.tile(np.arange(len(points), dtype="<f4")[:, None] % 30, (1, 3))
        packed = np.concatenate([points[:, :3], extra], axis=1)[: len(points) // 4 * 4, :floats]
        return packed.reshape(-1, 4)

    reorder(root, pack)
    with pytest.raises(
        InputError, match=r"000000\.bin: not four 32-bit floats a point \(x y z reflectance\): "
    ):
        kitti.load("00", root=root)


@pytest.mark.parametrize(("floats", "says"), [(3, "has 3 32-bit"), (5, "has 5 32-bit")])
def test_a_size_of_other_points_says_so(root: Path, floats: int, says: str) -> None:
    scan_file(root, 1).write_bytes(bytes(4 * floats * 7))
    with pytest.raises(
        InputError, match=rf"{28 * floats} bytes are no whole number of .* cut off, or {says}"
    ):
        kitti.load("00", root=root)


@pytest.mark.parametrize("height", [-1.0, 0.9, 1.73, 3.0])
def test_a_raised_cloud_is_read_by_its_rings(tmp_path: Path, height: float) -> None:
    made = laser_sequence(tmp_path / "laser", lambda points: points)
    raised = laser_sequence(tmp_path / "raised", lambda points: points + np.array([0, 0, height]))
    found, wanted = (kitti.load("00", root=path) for path in (raised, made))
    assert found.read_scan.ring == wanted.read_scan.ring
    assert found.read_scan.rise == pytest.approx(height, abs=0.01)
    assert f"beams meet at {found.read_scan.rise:+.2f} m" in found.notes[2]
    np.testing.assert_array_equal(found.read_scan(1).ranges, wanted.read_scan(1).ranges)
    laser_sequence(tmp_path / "raised", lambda points: shuffle(points + np.array([0, 0, height])))
    with pytest.raises(
        InputError, match="they do not cluster at beams as seen from the laser, so they are not in"
    ):
        kitti.load("00", root=raised)


def laser_sequence(root: Path, change) -> Path:
    """A sequence of a laser that has KITTI's beams, its points (P, 3) changed."""
    if not root.exists():
        make_kitti(root, ["00"], frames=2)
    beams_deg = [*np.arange(2.0, -8.0, -0.35), *np.arange(-8.0, -24.0, -0.5)]
    for frame in range(2):
        points = change(laser(beams_deg, points=600, seed=frame))
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(scan_file(root, frame))
    return root


def turned(points: np.ndarray, angle: float = 0.05) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (turned, r"the points of ring \d+ lie [23]\.\d degrees from their cone"),
        (lambda points: shuffle(turned(points)), "they do not cluster at beams as seen from the laser"),
        (lambda points: turned(points, 0.35), "not in the laser's frame|not in its frame|too far from level"),
        (
            lambda points: np.stack([-points[:, 1], -points[:, 2], points[:, 0]], axis=1),
            r"[45]\d % of the points are steeper than 45 degrees, as in a camera's frame; give them",
        ),
    ],
)
def test_points_in_another_frame_are_refused(tmp_path: Path, change, says: str) -> None:
    root = laser_sequence(tmp_path / "made", change)
    with pytest.raises(InputError, match=says) as raised:
        kitti.load("00", root=root)
    assert "\n" not in str(raised.value)


def test_a_given_ring_of_another_frame_stands(tmp_path: Path) -> None:
    root = laser_sequence(tmp_path / "made", turned)
    assert len(kitti.load("00", root=root, ring=6).read_scan(0).ranges) == 600


def test_a_slight_tilt_is_read(tmp_path: Path) -> None:
    root = laser_sequence(tmp_path / "made", lambda points: turned(points, 0.005))
    assert len(kitti.load("00", root=root).read_scan(0).ranges) == 600


BLANK = {
    "nan": np.full((900, 4), np.nan),
    "zero": np.zeros((900, 4)),
    "one point": np.array([[5.0, 1.0, 4.0, 0.0]]),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("blank", BLANK)
@pytest.mark.parametrize("ring", [None, 3])
@pytest.mark.parametrize("order", [lambda points: points, shuffle])
def test_a_blank_frame_is_a_scan_without_returns(root: Path, blank: str, ring: int | None, order) -> None:
    reorder(root, order)
    if order is shuffle:
        ring = None
    wanted = kitti.load("00", root=root, ring=ring)
    BLANK[blank].astype("<f4").tofile(scan_file(root, 1))
    found = kitti.load("00", root=root, ring=ring)
    assert found.notes == wanted.notes
    assert len(found.read_scan(1).ranges) == 0
    np.testing.assert_array_equal(found.read_scan(2).ranges, wanted.read_scan(2).ranges)


@pytest.mark.filterwarnings("error")
def test_nothing_but_blank_frames_is_refused(root: Path) -> None:
    for frame in range(4):
        BLANK["nan"].astype("<f4").tofile(scan_file(root, frame))
    with pytest.raises(InputError, match=r"000000\.bin: neither this nor the other frames have a point; "):
        kitti.load("00", root=root)


# A real drive


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no real KITTI recordings at {REAL}")
@pytest.mark.parametrize("order", PERMUTED | THINNED | RINGED)
def test_the_path_of_a_real_drive_in_any_order(tmp_path: Path, order: str) -> None:
    shutil.copytree(REAL / "sequences" / "90", tmp_path / "sequences" / "00")
    shutil.copytree(REAL / "poses", tmp_path / "poses")
    shutil.copy(REAL / "poses" / "90.txt", tmp_path / "poses" / "00.txt")
    reorder(tmp_path, (PERMUTED | THINNED | RINGED)[order], frames=range(40))
    recording = kitti.load("00", root=tmp_path)
    if order in PERMUTED:
        original = kitti.load("90", root=REAL)
        for frame in (0, 20, 39):
            found, wanted = (beams(one.read_scan(frame)) for one in (recording, original))
            for values, expected in zip(found, wanted, strict=True):
                np.testing.assert_array_equal(np.sort(values), np.sort(expected))
    tracking = Tracking(MatcherTracker(deskew=False))
    tracked = [tracking.step(recording.read_scan(frame)) for frame in range(len(recording))][1:]
    length = sum(np.hypot(each.step.x, each.step.y) for each in tracked)
    print(f"{order}: {length:.2f} m, {recording.notes[1:]}")
    assert any("thinned to a grid" in note for note in recording.notes) == (order in THINNED)
    assert {each.kind for each in tracked} == {Kind.ESTIMATED}
    assert 47 < length < 48.5
