"""Settings that are checked before anything is read: whether scans are undistorted."""

import pytest

from rcnn_odom.errors import InputError
from rcnn_odom.training.settings import plain


@pytest.mark.parametrize(
    ("given", "deskew"), [("on", "on"), ("off", "off"), ("auto", "auto"), ("true", "on"), ("false", "off")]
)
def test_deskew_of_a_model_that_looks_at_whole_scans(configure, given, deskew):
    settings = plain(configure("data=simulated", "model=matcher", f"data.deskew={given}", name="evaluate"))
    assert settings["data"]["deskew"] == deskew


def test_deskew_is_auto_for_all_data(configure):
    for data in ("simulated", "indoor"):
        assert plain(configure(f"data={data}"))["data"]["deskew"] == "auto"


def test_a_network_sees_scans_as_they_were_taken(configure):
    says = "data.deskew=on: networks use scans without deskewing; set data.deskew=auto"
    for given in (
        configure("data.deskew=on"),
        configure("model=cnn_reg", "data.deskew=true"),
        configure("data=simulated", "data.deskew=on", name="evaluate"),  # the network of a run
    ):
        with pytest.raises(InputError) as refusal:
            plain(given)
        assert str(refusal.value) == says
    assert plain(configure("data.deskew=off"))["data"]["deskew"] == "off"


@pytest.mark.parametrize("word", ["yes", "1", "null", "[on]"])
def test_deskew_is_one_of_three_words(configure, word):
    with pytest.raises(InputError, match=r"data\.deskew=.*: choose one of auto, on, off"):
        plain(configure(f"data.deskew={word}"))
