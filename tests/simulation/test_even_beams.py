"""Evenly spaced beams: where each points and when, against lists written out by hand."""

import numpy as np
import pytest

from rcnn_odom.simulation.beams import EvenBeams


def degrees(beams, frame=0):
    return np.rad2deg(beams.bearings(frame))


@pytest.mark.parametrize("spacing", [0.05, 0.25, 1 / 3, 0.5, 1.0])
def test_a_half_circle_has_a_beam_at_both_ends(spacing) -> None:
    found = degrees(EvenBeams(spacing, 180.0))
    assert len(found) == round(180 / spacing) + 1
    np.testing.assert_allclose(found[[0, -1]], [-90, 90], atol=1e-9)
    np.testing.assert_allclose(np.diff(found), spacing, atol=1e-9)


@pytest.mark.parametrize(("spacing", "count"), [(0.9, 400), (0.5, 720), (0.05, 7200), (0.7, 515)])
@pytest.mark.parametrize("phase", [0.0, 0.01])
def test_a_circle_has_no_beam_twice(spacing, count, phase) -> None:
    found = degrees(EvenBeams(spacing, 360.0, phase_deg=phase))
    assert len(found) == count
    gap = 360 - (found[-1] - found[0])
    assert 0 < gap <= spacing + 1e-9
    np.testing.assert_allclose(found[0], -180 + phase, atol=1e-9)


def test_phase_facing_and_direction() -> None:
    expected = [160.25, 161.25, 162.25, 163.25, 164.25]
    np.testing.assert_allclose(degrees(EvenBeams(1.0, 5.0, facing_deg=162.5, phase_deg=0.25)), expected)
    backwards = degrees(EvenBeams(1.0, 5.0, facing_deg=162.5, phase_deg=0.25, clockwise=True))
    np.testing.assert_allclose(backwards, [164.75, 163.75, 162.75, 161.75, 160.75])


def test_interlaced_scans_lie_between_each_other() -> None:
    beams = EvenBeams(1.0, 180.0, interlaced=True)
    even, odd = degrees(beams, 0), degrees(beams, 1)
    assert (len(even), len(odd)) == (181, 180)
    np.testing.assert_allclose(odd, (even[1:] + even[:-1]) / 2)
    np.testing.assert_array_equal(degrees(beams, 2), even)
    circle = EvenBeams(0.5, 360.0, interlaced=True)
    assert len(degrees(circle, 0)) == len(degrees(circle, 1)) == 720
    np.testing.assert_allclose(degrees(circle, 1) - degrees(circle, 0), 0.25)


@pytest.mark.parametrize("clockwise", [False, True])
def test_times_are_those_of_a_mirror_that_turns_evenly(clockwise) -> None:
    """A LMS 200's mirror takes 13.3 ms for a turn, half of which is the scan."""
    times = EvenBeams(1.0, 180.0, clockwise=clockwise).times(0, 75.0)
    assert times[0] == 0
    np.testing.assert_allclose(times[-1], 1 / 150)
    np.testing.assert_allclose(np.diff(times), 1 / 75 / 360)
    late = EvenBeams(1.0, 180.0, phase_deg=0.5, interlaced=True, clockwise=clockwise)
    np.testing.assert_allclose(late.times(0, 75.0)[0], 0.5 / 360 / 75)
    np.testing.assert_allclose(late.times(1, 75.0)[0], 1.0 / 360 / 75)
