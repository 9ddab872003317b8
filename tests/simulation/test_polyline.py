"""Lengths along lines, and points on them."""

import numpy as np

from rcnn_odom.simulation.street.polyline import arc_length, resample, unit

LINE = np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 10.0]])


def test_length_is_that_of_the_straight_pieces():
    np.testing.assert_array_equal(arc_length(LINE), [0, 5, 11])
    np.testing.assert_array_equal(arc_length(LINE[:1]), [0])


def test_points_lie_on_the_pieces_and_beyond_the_ends_stay_there():
    points = resample(LINE, arc_length(LINE), np.array([-1.0, 2.5, 5.0, 8.0, 12.0]))
    np.testing.assert_allclose(points, [[0, 0], [1.5, 2], [3, 4], [3, 7], [3, 10]])


def test_unit_vectors_turn_counter_clockwise_from_x():
    directions = np.pi / 2 * np.arange(4).reshape(2, 2)
    np.testing.assert_allclose(unit(directions), [[[1, 0], [0, 1]], [[-1, 0], [0, -1]]], atol=1e-15)
