"""The figures of a run: their text can be read in a file and in TensorBoard, and nothing is cut off."""

from itertools import pairwise

import numpy as np
import pytest

from rcnn_odom.evaluation.figures import coverage_figure, draw_pixels, motion_figure, trajectory_figure
from rcnn_odom.geometry import planar_to_poses

TITLE = "rcnn_regression on simulated_streets_of_a_long_name 05: errors within their estimated deviations"
POSES = planar_to_poses(np.stack([np.linspace(0, 900, 50), np.linspace(0, 3, 50), np.zeros(50)], 1))
MOTIONS = np.random.default_rng(0).normal(size=(49, 2))
FIGURES = {
    "trajectory": lambda: trajectory_figure(TITLE, POSES, POSES),
    "motion": lambda: motion_figure(TITLE, MOTIONS, MOTIONS),
    "coverage": lambda: coverage_figure(TITLE, np.abs(MOTIONS)),
}


@pytest.mark.parametrize("kind", FIGURES)
def test_text_has_a_readable_size_and_none_is_cut(kind):
    figure = FIGURES[kind]()
    pixels = draw_pixels(figure)
    width, height = figure.get_size_inches() * figure.dpi
    assert pixels.shape == (round(height), round(width), 3)
    assert pixels.min() == 0
    for border in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
        assert border.min() == 255  # white: no text is cut off
    assert figure.get_size_inches()[0] < 6  # inches, for text of 10 points
    assert "\n" in figure.axes[0].get_title()  # it needs more than one line
    labels = [axes.yaxis.label.get_window_extent() for axes in figure.axes]
    assert all(upper.y0 >= lower.y1 for upper, lower in pairwise(labels))
