"""Lasers by their kinds: noise against the data sheets, what a user may set, and what is refused."""

import numpy as np
import pytest
from test_laser import room

from rcnn_odom.errors import InputError
from rcnn_odom.simulation.kinds import KINDS, choose_laser
from rcnn_odom.simulation.laser import hdl64_ring

SIGMA = {
    ("sick", 2.0): 0.005,
    ("sick", 30.0): 0.005,
    ("hokuyo", 5.0): 0.01,
    ("hokuyo", 20.0): 0.02,
    ("hokuyo", 28.0): 0.028,
    ("rplidar", 1.0): 0.01,
    ("rplidar", 8.0): 0.08,
    ("regular", 20.0): 0.01,
}
"""Metres of standard deviation that the data sheets say, or nothing says otherwise, by kind and range."""


def ranges_in_round_room(options, radius, scans=12):
    laser, beams, _ = choose_laser(options)
    scene, rng = room(radius), np.random.default_rng(1)
    return np.concatenate(
        [laser.shoot(scene, 0, np.eye(4), beams.bearings(n), rng, missing=False) for n in range(scans)]
    )


@pytest.mark.parametrize(("kind", "radius"), SIGMA)
def test_noise_is_that_of_the_data_sheet(kind, radius) -> None:
    errors = ranges_in_round_room({"kind": kind}, radius) - radius
    sigma, count = SIGMA[kind, radius], len(errors)
    assert abs(errors.std() / sigma - 1) < 4 / np.sqrt(2 * count)
    assert abs(errors.mean()) < 4 * sigma / np.sqrt(count) + 1e-4
    # As of a normal distribution: 68 and 95 %.
    for deviations, share in ((1, 0.6827), (2, 0.9545)):
        assert abs(np.mean(np.abs(errors) < deviations * sigma) - share) < 4 * np.sqrt(0.25 / count)
    halves = errors[: count // 2 * 2].reshape(-1, 2)
    assert abs(np.corrcoef(halves.T)[0, 1]) < 5 / np.sqrt(count / 2)


def test_noise_that_is_given_is_that_at_any_range() -> None:
    for radius in (1.0, 10.0):
        errors = ranges_in_round_room({"kind": "rplidar", "noise": 0.003}, radius) - radius
        assert abs(errors.std() / 0.003 - 1) < 0.06
    assert np.ptp(ranges_in_round_room({"kind": "rplidar", "noise": 0.0}, 5.0)) < 1e-4


@pytest.mark.parametrize(("kind", "reach"), [("sick", 80), ("hokuyo", 30), ("rplidar", 12), ("regular", 80)])
def test_what_is_out_of_range_is_inf_in_its_place(kind, reach) -> None:
    assert np.isfinite(ranges_in_round_room({"kind": kind}, 0.9 * reach, 1)).all()
    assert np.isinf(ranges_in_round_room({"kind": kind}, 1.2 * reach, 1)).all()
    assert np.isinf(ranges_in_round_room({"kind": kind, "max_range": 5.0}, 6.0, 1)).all()


def test_an_hdl64_is_the_one_that_streets_have() -> None:
    assert choose_laser({"kind": "hdl64"}) == (hdl64_ring(80.0), None, None)
    assert choose_laser({}) is choose_laser({"kind": None, "noise": None}) is None


def test_an_hdl64_may_see_a_part_of_the_circle_and_shoot_seldomer() -> None:
    laser, _, rate = choose_laser(
        {
            "kind": "hdl64",
            "spacing_deg": 0.4,
            "field_of_view_deg": 90.0,
            "facing_deg": 180.0,
            "noise": 0.0,
            "rate_hz": 20,
        }
    )
    azimuth = np.rad2deg(laser.azimuths(np.random.default_rng(0)))
    assert rate == 20
    assert 135 <= azimuth.min() < 136 < 224 < azimuth.max() <= 225
    # 14 % of its shots come after half of the spacing.
    steps = np.diff(azimuth)
    assert abs(np.mean(steps < 0.3) - 0.14) < 0.08
    assert np.ptp(laser.shoot(room(5.0), 0, np.eye(4), azimuth, np.random.default_rng(0), False)) < 1e-3


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"kind": "kinect"}, r"data.laser.kind=kinect: choose one of hdl64, sick, hokuyo, rplidar, regular"),
        ({"kind": "sick", "spacing_deg": 2.0}, r"spacing_deg=2.0: must be a number of degrees from 0.05"),
        ({"kind": "sick", "spacing_deg": 0.04}, "spacing_deg=0.04"),
        ({"kind": "sick", "phase_deg": 1.0}, r"phase_deg=1: must be less than the spacing of the beams, 1"),
        ({"kind": "sick", "phase_deg": -0.1}, "phase_deg=-0.1"),
        ({"kind": "sick", "field_of_view_deg": 361}, "field_of_view_deg=361"),
        ({"kind": "sick", "field_of_view_deg": 0}, "field_of_view_deg=0"),
        ({"kind": "sick", "facing_deg": 400.0}, "facing_deg=400"),
        ({"kind": "sick", "noise": -1.0}, "noise=-1"),
        ({"kind": "sick", "max_range": 0.0}, "max_range=0"),
        ({"kind": "sick", "rate_hz": float("nan")}, "rate_hz=nan"),
        ({"kind": "sick", "rate_hz": 0}, "rate_hz=0"),
        ({"kind": "sick", "interlaced": 1}, "interlaced=1"),
        ({"kind": "sick", "colour": 1}, "data.laser.colour: there is no such option"),
        ({"spacing_deg": 0.5}, r"data.laser.spacing_deg: .* add data.laser.kind=regular"),
        ({"kind": "hdl64", "interlaced": True}, "data.laser.interlaced: an HDL-64 .*data.laser.kind=regular"),
        ({"kind": "hdl64", "phase_deg": 0.1}, "data.laser.phase_deg"),
    ],
)
def test_wrong_options_are_told_in_one_line(options, told) -> None:
    with pytest.raises(InputError, match=told) as caught:
        choose_laser(options)
    assert "\n" not in str(caught.value)


def test_kinds_have_the_beams_of_their_data_sheets() -> None:
    counts = {kind: len(found.beams.bearings(0)) for kind, found in KINDS.items()}
    assert counts == {"sick": 181, "hokuyo": 1081, "rplidar": 400, "regular": 720}
