"""Whether a laser's beams lie where a sensor's description says: everywhere the same check."""

import re

import numpy as np
import pytest

from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.beams import PATIENCE, BeamCheck, Beams, compare_beams, find_beams
from rcnn_odom.recordings.scan import Scan

HALF, ROUND, WIDE = Sensor(1.0, 180.0, 40.0), Sensor(), Sensor(0.25, 270.0, 30.0)


def even(first, spacing, count):
    """Bearings in radians of even beams, in degrees given."""
    return np.deg2rad(first + spacing * np.arange(count))


def scan(bearings, distance=5.0, **options):
    return Scan(np.full(len(bearings), distance), bearings, **options)


@pytest.mark.parametrize(
    ("bearings", "expected"),
    [
        (even(-90, 1, 181), (-90, 180, 1)),
        (even(-90, 1, 180), (-90, 179, 1)),
        (even(0, 1, 180), (0, 179, 1)),
        (even(90, -1, 181), (-90, 180, 1)),  # clockwise
        (even(270, 1, 181), (-90, 180, 1)),  # a turn of the circle further
        (even(-135, 0.25, 1081), (-135, 270, 0.25)),
        (even(90, 1, 181), (90, 180, 1)),  # behind
        (even(-180, 0.2, 1800), (-180, 360, 0.2)),
        (even(0, 1, 360), (-180, 360, 1)),
        (even(180, -1, 360), (-180, 360, 1)),
        (even(0, 1, 361), (-180, 360, 1)),  # the last beam is the first again
        (even(-175, 1, 351), (-175, 350, 1)),
        (np.concatenate([even(-90, 1, 181), even(-89.5, 1, 180)]), (-90, 180, 0.5)),  # interlaced
        (np.random.default_rng(0).permutation(even(-90, 1, 181)), (-90, 180, 1)),
        (even(-60, 120, 2), (-60, 120, 120)),
    ],
)
def test_where_beams_lie(bearings, expected):
    found = find_beams(bearings)
    first = (found.first + 180) % 360 - 180
    np.testing.assert_allclose([first, found.covered, found.spacing], expected, atol=1e-6)
    single = find_beams(bearings.astype(np.float32).astype(np.float64))
    np.testing.assert_allclose(single[1:], expected[1:], rtol=1e-4)


@pytest.mark.parametrize(
    ("bearings", "says"),
    [
        (
            np.arange(-90.0, 91.0),
            "its beams span 10313 degrees, more than a circle, as if its angles were not in",
        ),
        (np.arange(0.0, 360.0), "more than a circle"),
        (even(0, 1, 500), "its beams span 499 degrees"),
        (np.full(181, 0.3), "its beams all point the same way"),
        (np.full(181, np.nan), "not finite, or too large to be angles"),
        (np.append(even(-90, 1, 180), np.inf), "not finite, or too large to be angles"),
        (np.linspace(-1e300, 1e300, 181), "not finite, or too large to be angles"),
    ],
)
def test_bearings_that_are_none(bearings, says):
    with pytest.raises(ValueError, match=says):
        find_beams(bearings)


@pytest.mark.parametrize(
    ("sensor", "bearings"),
    [
        (HALF, even(-90, 1, 181)),
        (HALF, even(-90, 1, 180)),
        (HALF, even(90, -1, 180)),
        (HALF, even(-90, 0.5, 361)),
        (HALF, even(-85, 1, 171)),  # nearly all of it
        (WIDE, even(-135, 0.25, 1081)),
        (WIDE, even(-135, 0.5, 541)),
        (ROUND, even(0, 0.2, 1800)),
        (ROUND, even(-170, 0.1, 3400)),
        (Sensor(1.0, 180.0, 40.0, facing_deg=90), even(0, 1, 180)),
        (Sensor(1.0, 180.0, 40.0, facing_deg=180), even(90, 1, 181)),
        (Sensor(1.0, 180.0, 40.0, facing_deg=-90), even(180, 1, 181)),
    ],
)
def test_beams_that_fit(sensor, bearings):
    assert BeamCheck(sensor)(scan(bearings)) == ""


@pytest.mark.parametrize(
    ("sensor", "bearings", "advice"),
    [
        (
            HALF,
            even(0, 1, 180),
            "field_of_view_deg=180 data.sensor.resolution_deg=1 data.sensor.facing_deg=90",
        ),
        (
            HALF,
            even(-90, 1, 91),
            "field_of_view_deg=90 data.sensor.resolution_deg=1 data.sensor.facing_deg=-45",
        ),
        (
            HALF,
            even(-95, 1, 191),
            "field_of_view_deg=190 data.sensor.resolution_deg=1 data.sensor.facing_deg=0",
        ),
        (HALF, even(-135, 0.25, 1081), "field_of_view_deg=270 data.sensor.resolution_deg=0.25"),
        (HALF, even(-180, 1, 360), "field_of_view_deg=360 data.sensor.resolution_deg=1"),
        (HALF, even(-90, 3, 61), "field_of_view_deg=180 data.sensor.resolution_deg=3"),
        (HALF, even(-90, 0.1, 1801), "field_of_view_deg=180 data.sensor.resolution_deg=0.1"),
        (ROUND, even(-90, 0.2, 901), "field_of_view_deg=180 data.sensor.resolution_deg=0.2"),
        (
            HALF,
            even(90.3, 1, 180),
            "field_of_view_deg=180 data.sensor.resolution_deg=1 data.sensor.facing_deg=",
        ),
        (Sensor(1.0, 180.0, 40.0, facing_deg=90), even(-90, 1, 181), "field_of_view_deg=180"),
        (ROUND, even(0, 360 / 1024, 1024), "field_of_view_deg=360 data.sensor.resolution_deg=0.5"),
        (
            ROUND,
            even(90, 1, 181),
            "field_of_view_deg=180 data.sensor.resolution_deg=1 data.sensor.facing_deg=180",
        ),
    ],
)
def test_beams_of_another_laser_and_the_sensor_that_fits_them(sensor, bearings, advice):
    check = BeamCheck(sensor)
    assert "its beams lie" in check(scan(bearings))
    message = str(check.refusal("log", "set {}"))
    assert f"; set data.sensor.{advice}" in message
    options = dict(pair.split("=") for pair in re.findall(r"\w+=[-.\d]+", message))
    fitting = Sensor(**{name: float(value) for name, value in options.items()})
    assert BeamCheck(fitting)(scan(bearings)) == "", "the advice is right"


def test_beams_that_no_sensor_fits():
    check = BeamCheck(HALF)
    check(scan(even(-90, 20, 10), frame_id="laser"))
    assert str(check.refusal("log", "set {}")).endswith(
        "one every 1 (frame laser); no sensor has beams so far apart, 10 degrees at most"
    )


def test_several_scans_are_judged_and_again_when_they_change():
    good, half, none = scan(even(-90, 1, 181)), scan(even(-90, 1, 91)), scan(even(-90, 1, 181), 0.0)
    check = BeamCheck(HALF)
    for each in (half, none, half, Scan(np.zeros(0), np.zeros(0)), half):
        check(each)
    assert (check.fitting, check.in_a_row, check.is_another_laser) == (0, 3, False)
    assert check(good) == ""
    assert (check.fitting, check.in_a_row) == (1, 0)
    for number in range(PATIENCE):
        assert not check.is_another_laser
        assert "from -90 to 0 degrees" in check(half), number
    assert check.is_another_laser
    assert check(good) == ""
    assert check(scan(even(-90, 1, 181) + 0.5, frame_id="rear"))


def test_scans_that_do_not_tell_of_beams_fit():
    check = BeamCheck(HALF)
    assert check(Scan.from_points(np.ones((5, 2)))) == ""
    assert check(Scan(np.ones(180))) == check(Scan(np.ones(361))) == ""
    assert "one every 0.25" in check(Scan(np.ones(720)))
    assert "single beam" in check(Scan(np.ones(1), np.zeros(1)))


@pytest.mark.parametrize(
    ("ranges", "fits"),
    [
        (np.linspace(0.5, 39, 181), True),
        (np.linspace(50, 3900, 181), False),  # centimetres
        (np.linspace(500, 39000, 181), False),  # millimetres
        (np.full(181, 819.1), True),  # nothing came back: a laser writes one and the same reading
        (np.where(np.arange(181) % 3, 819.1, 5.0), True),
        (np.full(181, np.inf), True),
    ],
)
def test_readings_that_cannot_be_metres(ranges, fits):
    reason = BeamCheck(HALF)(Scan(ranges, even(-90, 1, 181)))
    assert (reason == "") == fits
    assert fits or "cannot be metres" in reason


def test_a_ring_of_returns_is_compared_by_what_is_known_of_its_laser():
    velodyne = Beams(-180.0, 360.0, 0.18)
    assert compare_beams(velodyne, ROUND) == ""
    assert compare_beams(velodyne, HALF) == (
        "its beams lie all round, one every 0.18 degrees, "
        "but the sensor's lie from -90 to 90 degrees, one every 1"
    )
