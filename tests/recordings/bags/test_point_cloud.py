"""Point clouds of bags, cut to what a planar laser sees."""

import numpy as np
import pytest

from conftest import SHARED
from data.make_bag import FORMATS, START, make_cloud_bag, point_cloud, store_of
from rcnn_odom.errors import InputError
from rcnn_odom.recordings import kitti
from rcnn_odom.recordings.bags.point_cloud import read_cloud
from rcnn_odom.recordings.formats import open_stream
from rcnn_odom.recordings.velodyne import ring_starts

ELEVATIONS = np.arange(-15.0, 16.0, 2.0)
"""Degrees of the 16 rings; 1 is nearest to a hair above level."""
LEVEL_RING = 8
AZIMUTHS = np.arange(-180.0, 180.0, 0.4)


def make_cloud(number=0, azimuths=AZIMUTHS, elevations=ELEVATIONS):
    """The fields of a cloud, ring by ring; the horizontal range tells ring, azimuth and cloud."""
    rings = np.repeat(np.arange(len(elevations)), len(azimuths))
    azimuth = np.tile(np.deg2rad(azimuths), len(elevations))
    ranges = expected(number, rings, azimuth)
    z = ranges * np.tan(np.deg2rad(elevations))[rings]
    x, y = ranges * np.cos(azimuth), ranges * np.sin(azimuth)
    return {"x": x.astype("f4"), "y": y.astype("f4"), "z": z.astype("f4"), "ring": rings.astype("u2")}


def expected(number, ring, azimuth):
    return 5 + np.asarray(ring) + 0.5 * np.sin(3 * azimuth) + 0.1 * number


def without(cloud, *names):
    return {name: values for name, values in cloud.items() if name not in names}


def read(path, **options):
    stream = open_stream(path, options)
    return stream, list(stream.scans)


def check_ring(scan, number, ring, azimuths=AZIMUTHS):
    order = np.argsort(scan.bearings)
    azimuth = np.deg2rad(azimuths)
    np.testing.assert_allclose(np.sin(scan.bearings[order]), np.sin(azimuth), atol=1e-5)
    np.testing.assert_allclose(scan.ranges[order], expected(number, ring, azimuth), rtol=1e-5)
    assert not scan.has_all_beams


@pytest.mark.parametrize("kind", FORMATS)
def test_the_most_level_ring_of_a_bag(tmp_path, kind):
    stream, scans = read(make_cloud_bag(tmp_path, kind, [make_cloud(number) for number in range(25)]))
    assert (len(scans), stream.total) == (25, 25)
    for number, scan in enumerate(scans):
        check_ring(scan, number, LEVEL_RING)
        assert (scan.stamp, scan.frame_id) == (pytest.approx(START + 0.1 * number, abs=1e-6), "laser")
    assert stream.notes == (
        "25 point clouds of /points",
        f"ring {LEVEL_RING}, median elevation +1.00 degrees",
    )
    assert stream.beams.covered == 360
    assert stream.beams.spacing == pytest.approx(0.4, abs=0.01)


@pytest.mark.parametrize(
    "layout",
    [{"big_endian": True}, {"gap": 3}, {"columns": len(AZIMUTHS), "row_gap": 13}, {"row_step": 0}],
    ids=str,
)
@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize(("field", "ring_type"), [("ring", "u1"), ("ring", "i4"), ("channel", "u2")])
def test_all_layouts_give_the_same(tmp_path, layout, dtype, field, ring_type):
    fields = make_cloud()
    cloud = {"intensity": np.full(len(fields["x"]), 7, "u1")}
    cloud |= {name: fields[name].astype(dtype) for name in "zyx"}
    cloud[field] = fields["ring"].astype(ring_type)
    stream, [scan] = read(make_cloud_bag(tmp_path, "mcap", [cloud], **layout))
    check_ring(scan, 0, LEVEL_RING)
    assert not stream.skipped


def test_another_ring(tmp_path):
    bag = make_cloud_bag(tmp_path, "mcap", [make_cloud()])
    check_ring(read(bag, ring=3)[1][0], 0, 3)
    with pytest.raises(InputError, match="there is no ring 16, they are 0 to 15; choose"):
        read(bag, ring=16)
    with pytest.raises(InputError, match="a ring and a height are two ways to cut it; give one of them"):
        read(bag, ring=3, height=(0.0, 1.0))


def test_points_that_are_none_are_left_out(tmp_path):
    cloud = make_cloud()
    for name, value in (("x", np.nan), ("z", np.inf), ("y", 1e9)):
        at = np.flatnonzero(cloud["ring"] == LEVEL_RING)[:3]
        part = {key: values[at] for key, values in cloud.items()}
        part[name][:] = value
        cloud = {key: np.concatenate([values, part[key]]) for key, values in cloud.items()}
    zeros = {key: np.zeros(20_000, values.dtype) for key, values in cloud.items()}
    zeros["ring"][:] = 2  # where some drivers write what did not come back
    cloud = {key: np.concatenate([values, zeros[key]]) for key, values in cloud.items()}
    check_ring(read(make_cloud_bag(tmp_path, "mcap", [cloud]))[1][0], 0, LEVEL_RING)


@pytest.mark.parametrize("by_row", [True, False])
def test_a_grid_has_its_rings_in_its_rows_or_columns(tmp_path, by_row):
    shape = len(ELEVATIONS), len(AZIMUTHS)
    cloud = without(make_cloud(), "ring")
    cloud["x"][5 * shape[1] : 5 * shape[1] + 100] = np.nan
    if not by_row:
        cloud = {name: values.reshape(shape).T.ravel() for name, values in cloud.items()}
    bag = make_cloud_bag(tmp_path, "sqlite3", [cloud], columns=shape[1] if by_row else shape[0])
    stream, [scan] = read(bag)
    check_ring(scan, 0, LEVEL_RING)
    assert stream.notes[1].startswith(f"{'row' if by_row else 'column'} {LEVEL_RING}, ")
    check_ring(read(bag, ring=2)[1][0], 0, 2)


@pytest.mark.parametrize("ring_of_all", [None, 0])
def test_without_rings_points_are_cut_by_elevation(tmp_path, ring_of_all):
    clouds = [make_cloud(number) for number in range(3)]
    order = np.random.default_rng(0).permutation(len(clouds[0]["x"]))
    clouds = [{name: values[order] for name, values in cloud.items()} for cloud in clouds]
    for cloud in clouds:
        if ring_of_all is None:
            del cloud["ring"]
        else:
            cloud["ring"][:] = ring_of_all
    bag = make_cloud_bag(tmp_path, "mcap", clouds)
    stream, scans = read(bag)
    for number, scan in enumerate(scans):
        check_ring(scan, number, LEVEL_RING)
    assert "the beam at +1.00 degrees" in stream.notes[1]
    with pytest.raises(
        InputError, match="its points have no rings; leave the ring out, or cut at a height with --height"
    ):
        read(bag, ring=3)


def moved(cloud, matrix=None, up=0.0):
    points = np.stack([cloud[name] for name in "xyz"]).astype(float)
    points = (np.eye(3) if matrix is None else np.array(matrix)) @ points + np.array([[0], [0], [up]])
    return cloud | {name: values.astype("f4") for name, values in zip("xyz", points, strict=True)}


@pytest.mark.parametrize("columns", [None, len(AZIMUTHS)])
def test_rings_of_a_raised_cloud_are_told_from_where_they_meet(tmp_path, columns):
    cloud = moved(make_cloud(), up=1.7)
    layout = {} if columns is None else {"columns": columns}
    cloud = cloud if columns is None else without(cloud, "ring")
    stream, [scan] = read(make_cloud_bag(tmp_path, "mcap", [cloud], **layout))
    check_ring(scan, 0, LEVEL_RING)
    assert stream.notes[1].endswith("median elevation +1.00 degrees from +1.70 m, where the beams meet")


@pytest.mark.parametrize(
    ("matrix", "says"),
    [
        ([[0, -1, 0], [0, 0, -1], [1, 0, 0]], r"\d\d % of the points are steeper than 45 degrees, as in a"),
        (
            [[0.94, 0, 0.342], [0, 1, 0], [-0.342, 0, 0.94]],
            r"the points of ring \d+ lie 1\d\.\d degrees from th",
        ),
    ],
    ids=["optical frame", "tilted by 20 degrees"],
)
def test_a_cloud_in_another_frame_is_refused(tmp_path, matrix, says):
    bag = make_cloud_bag(tmp_path, "mcap", [moved(make_cloud(), matrix)])
    with pytest.raises(
        InputError, match=says + r".*; publish it in its laser's frame, or choose --ring N or"
    ):
        read(bag)
    assert len(read(bag, ring=5)[1][0].ranges) == len(AZIMUTHS)
    assert len(read(bag, height=(-0.5, 0.5))[1][0].ranges) > 0


@pytest.mark.parametrize("up", [0.0, 1.7])
def test_the_ring_of_a_real_laser_on_a_robot(tmp_path, up):
    root = SHARED / "data" / "kitti"
    if not root.is_dir():
        pytest.skip(f"no real recordings at {root}")
    clouds = []
    for frame in sorted((root / "sequences" / "90" / "velodyne").glob("*.bin"))[:3]:
        points = np.fromfile(frame, "<f4").reshape(-1, 4)
        rings = np.zeros(len(points), "u2")
        rings[ring_starts(points)[1:]] = 1
        cloud = dict(zip("xyz", points.T[:3], strict=True)) | {"ring": np.cumsum(rings).astype("u2")}
        clouds.append(moved(cloud, up=up))
    stream, _ = read(make_cloud_bag(tmp_path, "mcap", clouds))
    assert stream.notes[1].split(",")[0] == ("ring 6" if up else "ring 7")


@pytest.mark.parametrize("rings", [True, False])
def test_a_laser_without_a_level_beam(tmp_path, rings):
    cloud = make_cloud(elevations=np.array([-12.0, -9.0, 7.0, 10.0]))
    bag = make_cloud_bag(tmp_path, "mcap", [cloud if rings else without(cloud, "ring")])
    says = (
        "no ring is within 2 degrees .* nearest is 2 at [+]7.0; "
        if rings
        else "no beam of the laser is within"
    )
    with pytest.raises(InputError, match=f"/points cannot be cut to a planar scan: {says}.*with --height"):
        read(bag)


def test_a_slice_between_heights(tmp_path):
    cloud = make_cloud()
    stream, [scan] = read(make_cloud_bag(tmp_path, "mcap", [without(cloud, "ring")]), height=(-0.2, 0.3))
    within = (cloud["z"] >= -0.2) & (cloud["z"] <= 0.3)
    x, y = (cloud[name][within].astype(np.float64) for name in "xy")
    np.testing.assert_allclose(scan.ranges, np.hypot(x, y))
    np.testing.assert_allclose(scan.bearings, np.arctan2(y, x))
    assert 0 < len(scan.ranges) < len(cloud["x"])
    assert stream.notes[1] == "points at heights of -0.2 to 0.3 m"
    assert stream.beams is None


@pytest.mark.parametrize("z", [0.0, 0.25])
def test_a_planar_cloud_is_taken_whole(tmp_path, z):
    cloud = make_cloud() | {"z": np.full(len(AZIMUTHS) * len(ELEVATIONS), z, "f4")}
    stream, [scan] = read(make_cloud_bag(tmp_path, "mcap", [without(cloud, "ring")]))
    np.testing.assert_allclose(scan.ranges, np.hypot(cloud["x"], cloud["y"]), rtol=1e-6)
    assert stream.notes[1] == "all points, which lie in one plane"
    assert stream.beams is None, "parts of the circle may be without a return"


def test_what_a_laser_covers_is_told_by_all_its_rings(tmp_path):
    ahead = np.arange(-60.0, 60.0, 0.25)
    cloud = make_cloud(azimuths=ahead)
    seen = (cloud["ring"] != LEVEL_RING) | (np.abs(cloud["y"]) < cloud["x"])
    cloud = {name: values[seen] for name, values in cloud.items()}
    beams = open_stream(make_cloud_bag(tmp_path, "mcap", [cloud])).beams
    assert beams.middle == pytest.approx(0.0, abs=1.0)
    assert beams.covered == pytest.approx(120.0, abs=2.0)
    assert beams.spacing == pytest.approx(0.25, abs=0.01)


def test_clouds_that_cannot_be_read(tmp_path):
    bags = [tmp_path / name for name in "abc"]
    for folder in bags:
        folder.mkdir()
    without_y = [without(make_cloud(), "y")] * 3
    why = r"none of its 3 messages of /points can be read \(it has no field y, only x, z, ring\); "
    with pytest.raises(InputError, match=why):
        read(make_cloud_bag(bags[0], "mcap", without_y))
    short = make_cloud_bag(bags[1], "mcap", [make_cloud()] * 3, data=np.zeros(50, np.uint8))
    with pytest.raises(
        InputError, match=r"none of its 3 .*1 x 14400 points of 14 bytes do not fit into its 50 b"
    ):
        read(short)
    one = {name: values[:1] for name, values in make_cloud().items()}
    nothing = [one | {"x": np.full(1, np.nan, "f4")}] * 3
    with pytest.raises(InputError, match="none of the point clouds of /points has a point; "):
        read(make_cloud_bag(bags[2], "mcap", nothing))


def test_clouds_without_points_at_the_start(tmp_path):
    nothing = {name: values[:0] for name, values in make_cloud().items()}
    clouds = [nothing, nothing, make_cloud(), without(make_cloud(), "y")]
    stream, scans = read(make_cloud_bag(tmp_path, "mcap", clouds))
    assert [len(scan.ranges) for scan in scans] == [0, 0, len(AZIMUTHS)]
    assert stream.skipped == {"messages that cannot be read": 1}


def test_the_ring_of_a_real_laser(tmp_path):
    root = SHARED / "data" / "kitti"
    if not root.is_dir():
        pytest.skip(f"no real recordings at {root}")
    frames = sorted((root / "sequences" / "90" / "velodyne").glob("*.bin"))[:5]
    clouds = [dict(zip("xyz", np.fromfile(frame, "<f4").reshape(-1, 4).T, strict=False)) for frame in frames]
    stream, scans = read(make_cloud_bag(tmp_path, "mcap", clouds))
    ring = list(kitti.stream(root / "sequences" / "90").scans)[:5]
    for scan, reference in zip(scans, ring, strict=True):
        same = np.isin(scan.ranges, reference.ranges)
        assert same.mean() > 0.9
        assert same.sum() > 0.9 * len(reference.ranges)
    assert stream.beams.covered == 360
    assert stream.beams.spacing == pytest.approx(0.18, abs=0.03)


# --- when each point was seen --------------------------------------------------------------------

SWEEP = 0.1 * np.tile(np.linspace(0, 1, len(AZIMUTHS), endpoint=False), len(ELEVATIONS))
"""Seconds of the points of a cloud after the first."""


@pytest.mark.parametrize(
    ("field", "values", "first"),
    [
        ("time", (SWEEP - 0.1).astype("f4"), -0.1),  # Velodyne: before the stamp
        ("time", SWEEP.astype("f4"), 0),
        ("t", np.round(1e9 * SWEEP).astype("u4"), 0),  # Ouster
        ("offset_time", np.round(1e9 * SWEEP).astype("u4"), 0),  # Livox
        ("timestamp", START + SWEEP, 0),  # Hesai, RoboSense
        ("timestamp", START + SWEEP - 0.1, -0.1),
        ("timestamp", 1e9 * (START + SWEEP), 0),  # Livox
    ],
)
@pytest.mark.parametrize("kind", FORMATS)
def test_times_of_points(tmp_path, kind, field, values, first):
    plain = read(make_cloud_bag(tmp_path, kind, [make_cloud()]))[1][0]
    (tmp_path / "timed").mkdir()
    timed = read(make_cloud_bag(tmp_path / "timed", kind, [make_cloud() | {field: values}]))[1][0]
    np.testing.assert_allclose(timed.times, first + SWEEP[: len(AZIMUTHS)], atol=1e-6)
    assert plain.times is None
    np.testing.assert_array_equal(timed.ranges, plain.ranges)
    np.testing.assert_array_equal(timed.bearings, plain.bearings)


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("time", (1e3 * SWEEP).astype("f4")),  # milliseconds: up to 100 "seconds"
        ("time", np.where(SWEEP > 0.05, np.nan, SWEEP).astype("f4")),
        ("time", np.full(len(SWEEP), np.inf, "f4")),
        ("time", np.zeros(len(SWEEP), "f4")),
        ("timestamp", START + 100 + SWEEP),
        ("t", np.round(1e9 * SWEEP * 105).astype("u8").astype("f8")),
    ],
)
def test_times_of_points_that_cannot_be_are_unknown(tmp_path, field, values):
    scan = read(make_cloud_bag(tmp_path, "mcap", [make_cloud() | {field: values}]))[1][0]
    assert scan.times is None
    check_ring(scan, 0, LEVEL_RING)


@pytest.mark.parametrize("change", [{"datatype": 9}, {"offset": 1000}])
def test_a_time_that_cannot_be_read_costs_no_points(change):
    store = store_of("mcap")
    cloud = point_cloud(store, make_cloud() | {"time": SWEEP.astype("f4")}, START, False)
    assert read_cloud(cloud).times is not None
    for name, value in change.items():
        setattr(cloud.fields[-1], name, value)
    assert read_cloud(cloud).times is None
    assert len(read_cloud(cloud).points) == len(SWEEP)


@pytest.mark.parametrize("layout", [{"height": (4.9, 5.1)}, {}])
def test_times_follow_their_points(tmp_path, layout):
    """Each point's time is its azimuth, whichever way the cloud is cut."""
    cloud = make_cloud()
    cloud["time"] = (0.1 * np.arctan2(cloud["y"], cloud["x"])).astype("f4")
    cloud["x"][::7] = np.nan
    if layout:
        cloud["z"] = np.linspace(0, 10, len(cloud["z"])).astype("f4")
    scan = read(make_cloud_bag(tmp_path, "sqlite3", [without(cloud, "ring")]), **layout)[1][0]
    assert len(scan.ranges) > 100
    np.testing.assert_allclose(scan.times, 0.1 * scan.bearings, atol=1e-6)
