"""Depth vectors against a slow loop over points, and the corners of the circle by hand."""

import math

import numpy as np
import pytest

from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor, decode, encode
from rcnn_odom.recordings.scan import Scan

PAPER = Sensor()
HALF_CIRCLE = Sensor(resolution_deg=1.0, field_of_view_deg=180.0, max_range=40.0)
NARROW = Sensor(resolution_deg=0.5, field_of_view_deg=90.0, max_range=20.0)


def encoded_slowly(angles, ranges, sensor):
    """Every point looks for the bin whose centre is nearest; then the mean of each bin."""
    first = sensor.facing_deg - sensor.field_of_view_deg / 2
    centres = [first + i * sensor.resolution_deg for i in range(sensor.bins)]
    found = [[] for _ in centres]
    for angle, depth in zip(np.degrees(angles), ranges, strict=True):
        if not (math.isfinite(angle) and math.isfinite(depth) and 0 < depth < sensor.max_range):
            continue
        away = [abs((angle - centre + 180) % 360 - 180) for centre in centres]
        if min(away) <= sensor.resolution_deg / 2:
            found[away.index(min(away))].append(depth)
    vector = [math.fsum(depths) / len(depths) if depths else 0.0 for depths in found]
    if sensor.field_of_view_deg == 360:
        everything = found[0] + found[-1]
        vector[0] = vector[-1] = math.fsum(everything) / len(everything) if everything else 0.0
    return np.array(vector)


LEFT, BEHIND = Sensor(1.0, 180.0, 40.0, facing_deg=90.0), Sensor(0.5, 90.0, 20.0, facing_deg=-180.0)


@pytest.mark.parametrize(
    "sensor", [Sensor(1.0), Sensor(0.5, 360, 30), HALF_CIRCLE, NARROW, Sensor(1, 359), LEFT, BEHIND]
)
@pytest.mark.parametrize("points", [0, 1, 60, 900])
def test_encode_equals_slow_loop(sensor, points):
    rng = np.random.default_rng(points)
    angles = rng.uniform(-3 * np.pi, 3 * np.pi, points)
    ranges = rng.uniform(-5, 1.2 * sensor.max_range, points)
    ranges[::17] = np.nan
    vector = encode(angles, ranges, sensor)
    assert vector.dtype == np.float32
    assert vector.shape == (sensor.bins,)
    np.testing.assert_allclose(vector, encoded_slowly(angles, ranges, sensor), rtol=1e-6)


def test_paper_sensor_has_3601_bins():
    assert PAPER.bins == 3601
    assert Sensor(0.25).bins == 1441
    assert HALF_CIRCLE.bins == 181
    assert NARROW.bins == 181


@pytest.mark.parametrize(
    ("degrees", "bin"),
    [
        (0, 1800),
        (90, 2700),
        (-90, 900),
        (0.04, 1800),
        (0.06, 1801),
        (-0.06, 1799),
        (179.94, 3599),
        (10.0, 1900),
    ],
)
def test_left_is_in_the_second_half(degrees, bin):
    vector = encode([np.deg2rad(degrees)], [7.0], PAPER)
    assert np.flatnonzero(vector).tolist() == [bin]
    assert vector[bin] == 7


@pytest.mark.parametrize("degrees", [180.0, -180.0, 179.96, -179.96, 540.0, -540.0, 180.04])
def test_behind_is_first_and_last_bin(degrees):
    vector = encode([np.deg2rad(degrees)], [7.0], PAPER)
    assert np.flatnonzero(vector).tolist() == [0, 3600]


def test_seam_does_not_split_the_mean():
    vector = encode(np.deg2rad([179.97, -179.97, 180, -180]), [2.0, 4.0, 6.0, 8.0], PAPER)
    assert vector[0] == vector[-1] == 5
    assert np.count_nonzero(vector) == 2


def test_closing_bin_equals_the_first_without_points_behind():
    vector = encode([0.0], [7.0], PAPER)
    assert vector[0] == vector[-1] == 0


def test_bin_centres_fill_every_bin_once():
    for sensor in (PAPER, HALF_CIRCLE, NARROW):
        centres = np.deg2rad(np.arange(sensor.bins) * sensor.resolution_deg - sensor.field_of_view_deg / 2)
        depth = 1 + np.arange(sensor.bins) * 1e-3
        depth[-1] = depth[0] if sensor.field_of_view_deg == 360 else depth[-1]
        np.testing.assert_allclose(encode(centres, depth, sensor), depth, rtol=1e-6)


def test_points_of_a_bin_are_averaged():
    vector = encode(np.deg2rad([10.0, 10.02, 9.97, 10.1]), [1.0, 2.0, 6.0, 9.0], PAPER)
    assert vector[1900] == 3
    assert vector[1901] == 9


@pytest.mark.parametrize("depth", [0.0, -1.0, 80.0, 81.9, np.inf, -np.inf, np.nan])
def test_no_return_is_empty_and_stays_out_of_the_mean(depth):
    assert not encode([0.5], [depth], PAPER).any()
    vector = encode([0.0, 0.0, 0.0], [4.0, depth, 6.0], PAPER)
    assert vector[1800] == 5


def test_angle_that_is_not_finite_is_no_return():
    assert encode([np.nan, np.inf, 0.0], [3.0, 3.0, 3.0], PAPER).sum() == 3


def test_empty_scan_is_all_zero():
    assert encode([], [], PAPER).shape == (3601,)
    assert not encode([], [], PAPER).any()


def test_half_circle_sees_nothing_behind():
    angles = np.deg2rad(np.arange(-180, 180))
    vector = encode(angles, np.full(360, 5.0), HALF_CIRCLE)
    assert (vector == 5).all()
    behind = np.deg2rad([91, 100, 180, -180, -91, -120])
    assert not encode(behind, np.full(6, 5.0), HALF_CIRCLE).any()


def test_half_circle_runs_from_right_to_left():
    vector = encode(np.deg2rad([-90.0, 0.0, 90.0]), [1.0, 2.0, 3.0], HALF_CIRCLE)
    assert (vector[0], vector[90], vector[180]) == (1, 2, 3)
    assert np.count_nonzero(vector) == 3


@pytest.mark.parametrize("turns", [-2, -1, 1, 3])
def test_whole_turns_change_nothing(turns):
    rng = np.random.default_rng(0)
    centre = np.arange(-175, 175, 0.5)
    angles = np.deg2rad(centre + rng.uniform(-0.04, 0.04, len(centre)))
    ranges = rng.uniform(1, 79, len(centre))
    np.testing.assert_array_equal(
        encode(angles + turns * 2 * np.pi, ranges, PAPER), encode(angles, ranges, PAPER)
    )


@pytest.mark.parametrize(
    "options",
    [
        {"resolution_deg": 0.0},
        {"resolution_deg": -0.1},
        {"resolution_deg": 0.7},
        {"resolution_deg": float("nan")},
        {"resolution_deg": 720.0},
        {"field_of_view_deg": 0.0},
        {"field_of_view_deg": 361.0},
        {"field_of_view_deg": float("nan")},
        {"field_of_view_deg": 180.05},
        {"max_range": 0.0},
        {"max_range": -80.0},
        {"max_range": float("nan")},
    ],
)
def test_impossible_sensor_is_refused(options):
    with pytest.raises(InputError, match=r"data\.sensor"):
        Sensor(**options)


def test_a_scan_is_encoded_by_its_bearings():
    bearings, ranges = np.deg2rad([-20.0, 0.0, 35.0]), np.array([3.0, 4.0, 5.0])
    np.testing.assert_array_equal(
        HALF_CIRCLE.encode(Scan(ranges, bearings)), encode(bearings, ranges, HALF_CIRCLE)
    )


@pytest.mark.parametrize("sensor", [HALF_CIRCLE, Sensor(1.0)])
def test_beams_without_bearings_cover_the_field_of_view_evenly(sensor):
    # The last beam of a full circle would lie on the first.
    beams = sensor.bins - (sensor.field_of_view_deg == 360)
    ranges = np.arange(1.0, beams + 1) / 20
    expected = ranges if beams == sensor.bins else np.append(ranges, ranges[0])
    np.testing.assert_allclose(sensor.encode(Scan(ranges)), expected, rtol=1e-6)


def test_sensor_survives_plain_numbers():
    assert NARROW.as_dict() == {"resolution_deg": 0.5, "field_of_view_deg": 90.0, "max_range": 20.0}
    assert Sensor(**NARROW.as_dict()) == NARROW


@pytest.mark.parametrize("sensor", [LEFT, BEHIND, HALF_CIRCLE])
def test_points_of_a_sensor_that_faces_aside_are_where_they_were(sensor):
    middle = np.deg2rad(sensor.facing_deg)
    angles = middle + np.deg2rad([-40.0, 0.0, 25.0])
    points = decode(encode(angles, [3.0, 4.0, 5.0], sensor), sensor)
    expected = np.stack([np.cos(angles), np.sin(angles)], 1) * [[3.0], [4.0], [5.0]]
    np.testing.assert_allclose(points, expected, atol=1e-6)
    even = sensor.encode(Scan(np.full(sensor.bins, 6.0)))
    np.testing.assert_array_equal(even, 6.0, err_msg="ranges alone are spread over its field of view")


def test_a_sensor_that_faces_ahead_is_described_as_ever():
    """Caches and checkpoints know it by these values."""
    assert HALF_CIRCLE.as_dict() == {"resolution_deg": 1.0, "field_of_view_deg": 180.0, "max_range": 40.0}
    assert LEFT.as_dict()["facing_deg"] == 90.0
    assert Sensor(**LEFT.as_dict()) == LEFT
    with pytest.raises(InputError, match=r"data\.sensor\.facing_deg must be -180 to 180, not 181"):
        Sensor(facing_deg=181.0)
