"""How ``evaluate.py`` scores a model of whole scans."""

import pytest

from evaluate import evaluate
from rcnn_odom.geometry import Steps
from rcnn_odom.models.matcher import Matcher

OPTIONS = ["model=matcher", "data=simulated", "data.frames=20", "data.test=['05']", "data.train=['00']"]


@pytest.fixture
def evaluate_truth(configure, monkeypatch):
    """Scores what a matcher would say that knows the truth; and the drives that it is given."""
    seen = []

    def estimate(self, drive):
        seen.append((self.deskew, drive))
        return Steps.with_unknown_covariance(0.5 * drive.steps)

    monkeypatch.setattr(Matcher, "estimate", estimate)

    def run(*options):
        config = configure(*OPTIONS, "data.lengths=[5.0]", *options, name="evaluate", run="scored")
        return evaluate(config), seen

    return run


def test_its_drives_are_not_encoded(evaluate_truth, tmp_path):
    metrics, ((deskew, drive),) = evaluate_truth()
    assert drive.scans.shape == (20, 0)
    assert len(list(drive.raw_scans())) == 20
    assert not list((tmp_path / "outputs").glob("cache/*"))
    assert deskew == "auto"
    assert metrics["path_ratio"] == {"05": pytest.approx(0.5)}
    assert metrics["test"]["drift"] == pytest.approx(0.5, abs=0.05)
    assert metrics["latency"]["frames"] == 19


@pytest.mark.parametrize("wanted", ["on", "off"])
def test_deskewing_is_handed_over(evaluate_truth, wanted):
    _, ((deskew, _),) = evaluate_truth(f"data.deskew={wanted}")
    assert deskew == wanted
