"""A network's steps as the priors of the matcher's matches."""

import json
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from conftest import ROOT
from data.make_kitti import make_kitti
from evaluate import evaluate
from matching.rooms import circle, drive, loop, relative
from rcnn_odom.cli import main
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import Step, relative_step, relative_steps
from rcnn_odom.models.contract import Description
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.fused import (
    AVERAGED_MATCHES,
    INFLATION,
    LEAST_DISTANCE,
    Fused,
    FusedTracker,
    NetworkPrior,
    fused_tracker,
    make_prior,
)
from rcnn_odom.models.matcher import MatcherTracker
from rcnn_odom.models.prior import LastMotion, Prior, Wheels
from rcnn_odom.models.tracking import Kind, Tracking
from rcnn_odom.options import check_options
from rcnn_odom.recordings import simulated
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.training.settings import plain

ROUND = Sensor(0.5, 360.0, 80.0)
SURE, VERY_SURE = np.diag([0.01, 0.01, 0.002]) ** 2, np.diag([0.001, 0.001, 0.001]) ** 2


class Told:
    """A network that gives steps (N, 3) of a list, one after the other, with one covariance."""

    def __init__(self, steps, covariance=SURE, sensor=ROUND):
        self.description = Description(sensor)
        self.steps, self.covariance = steps, covariance
        self.reset()

    def reset(self):
        self._next = iter(self.steps)

    def __call__(self, pair):
        x, y, heading = next(self._next).tolist()
        return Step(x, y, heading, self.covariance)


@cache
def blind(name="corridor-8", frames=250):
    """Scans and true steps of a drive where walls tell little."""
    recording = simulated.load(name, world="blind", frames=frames, laser={"kind": "regular"})
    return [recording.read_scan(n) for n in range(frames)], relative_steps(recording.poses)


def track(tracker, scans):
    tracking = Tracking(tracker)
    return [tracking.step(scan) for scan in scans]


def steps_of(tracked):
    return np.array([each.step.array() for each in tracked[1:]])


def way_off(steps, truth):
    """Metres by which the path's length is wrong."""
    return abs(np.hypot(*steps[:, :2].T).sum() - np.hypot(*truth[:, :2].T).sum())


def room(count=40):
    """Scans of a room, which determines everything, and true steps."""
    truth = loop(count)
    scans = drive(truth, circle(), noise=0.005)
    return scans, np.array([relative(*pair) for pair in pairwise(truth)])


def test_a_perfect_prior_follows_the_truth_along_a_bare_corridor():
    scans, truth = blind()
    fused = track(FusedTracker(NetworkPrior(Told(truth)), deskew=False), scans)
    alone = steps_of(track(MatcherTracker(deskew=False), scans))
    steps = steps_of(fused)
    assert np.abs(steps - truth).max(0)[0] < 0.02
    assert way_off(steps, truth) < 0.02 * np.hypot(*truth[:, :2].T).sum()
    assert way_off(steps, truth) < 0.2 * way_off(alone, truth)
    # Across the corridor the walls count, however sure the network is.
    sideways = truth + np.array([0, 0.01, 0.002])
    steps = steps_of(track(FusedTracker(NetworkPrior(Told(sideways)), deskew=False), scans))
    assert np.abs((steps - truth).sum(0)[[1, 2]]).max() < 0.05
    held = [each for each in fused if any(note.startswith("held") for note in each.notes)]
    assert len(held) > 100
    assert all(any("the network's step is used" in note for note in each.notes) for each in held)


def test_a_prior_of_unknown_covariance_is_only_the_start():
    nan = np.full((3, 3), np.nan)
    scans, truth = blind()
    told = truth + np.array([0.01, 0, 0])

    class Start(LastMotion):
        """The matcher's guess put elsewhere, and nothing else."""

        def __init__(self):
            self._steps = iter(told)

        def reset(self):
            self._steps = iter(told)

        def expect(self, scan, periods, seconds, held):
            step = next(self._steps)
            off = step - held.step
            return Prior(held.step + off, held.covariance + np.diag(off**2), comes_from_scan=True), ()

    fused = steps_of(track(FusedTracker(NetworkPrior(Told(told, nan)), deskew=False), scans))
    started = steps_of(track(MatcherTracker(deskew=False, source=Start()), scans))
    np.testing.assert_allclose(fused, started, atol=1e-12)
    # In a room, where all is determined, a start 3 cm off changes nothing but the last digits.
    scans, truth = room()
    fused = steps_of(track(FusedTracker(NetworkPrior(Told(truth + np.array([0.03, 0, 0]), nan))), scans))
    np.testing.assert_allclose(fused, steps_of(track(MatcherTracker(), scans)), atol=2e-3)


@pytest.mark.parametrize("place", [blind, room])
def test_a_prior_that_knows_nothing_leaves_the_matcher_alone(place):
    scans, truth = place()
    enormous = Told(truth + np.array([0.5, 0.3, 0.1]), 1e12 * np.eye(3))
    fused = steps_of(track(FusedTracker(NetworkPrior(enormous), deskew=False), scans))
    alone = steps_of(track(MatcherTracker(deskew=False), scans))
    np.testing.assert_allclose(fused, alone, atol=1e-6)


def test_a_prior_is_the_mean_of_both_by_their_weights():
    held = Prior(np.array([1.0, 0.0, 3.1]), np.diag([0.04, 0.04, 0.01]))
    told = Step(2.0, 0.4, -3.1, np.diag([0.01, 0.04, 0.01]))
    prior = make_prior(told, held)
    turn = 2 * np.pi - 6.2  # the short way round
    np.testing.assert_allclose(prior.step, [1.8, 0.2, 3.1 + turn / 2], atol=1e-12)
    np.testing.assert_allclose(np.diag(prior.covariance), [0.008, 0.02, 0.005])
    assert prior.pull is told.covariance


def test_a_network_that_is_wrong_where_the_scans_tell_is_believed_less():
    scans, truth = room(60)
    half = truth * [0.5, 1, 1]
    source = NetworkPrior(Told(half, VERY_SURE))
    fused = steps_of(track(FusedTracker(source), scans))
    np.testing.assert_allclose(fused, steps_of(track(MatcherTracker(), scans)), atol=3e-3)
    held = Prior(np.zeros(3), np.eye(3))
    far = np.abs(half - truth)[:, 0].mean()
    assert far > 0.02, "twice what it says that it may be off"
    sure = NetworkPrior(Told(half, VERY_SURE))
    sure.begin(scans[0])
    before, _ = sure.expect(scans[1], 1, 0.1, held)
    source._tracker._stepper.reset()
    after, _ = source.expect(scans[1], 1, 0.1, held)
    assert before.pull[0, 0] == pytest.approx(INFLATION**2 * 1e-6 + LEAST_DISTANCE**2)
    # One without memory would be at the mean square of the errors.
    seen = 1 - (1 - 1 / AVERAGED_MATCHES) ** 59
    expected = before.pull[0, 0] * (1 - seen) + seen * np.square(half - truth)[:, 0].mean()
    assert after.pull[0, 0] == pytest.approx(expected, rel=0.3)
    assert after.pull[2, 2] == before.pull[2, 2], "of the heading it was right"


def test_another_laser_than_the_networks_is_told_and_the_matcher_goes_on():
    scans, truth = room()
    quarter = Sensor(0.25, 90.0, 40.0)
    aside = replace(quarter, facing_deg=120.0)
    scans = [replace(scan, ranges=scan.ranges[200:520], bearings=scan.bearings[200:520]) for scan in scans]
    fused = track(FusedTracker(NetworkPrior(Told(truth, sensor=aside))), scans)
    alone = track(MatcherTracker(), scans)
    np.testing.assert_array_equal(steps_of(fused), steps_of(alone))
    assert all(any(note.startswith("no prior: other laser:") for note in each.notes) for each in fused)
    assert all("\n" not in note for each in fused for note in each.notes)


def test_where_nothing_matches_the_networks_step_stands():
    drives = [simulated.load(name, frames=25) for name in ("lost", "elsewhere")]
    here, elsewhere = ([each.read_scan(n) for n in range(25)] for each in drives)
    mixed = [*here[:20], *(replace(elsewhere[n], stamp=here[n].stamp) for n in range(20, 23))]
    told = np.tile([0.9, 0.0, 0.01], (25, 1))
    fused = track(FusedTracker(NetworkPrior(Told(told, sensor=Sensor(0.2, 360.0, 80.0)))), mixed)
    lost = [each for each in fused if any(note.startswith("no match") for note in each.notes)]
    assert lost
    for each in lost:
        assert each.kind is Kind.ESTIMATED
        assert any("the network's step is used" in note for note in each.notes)
        np.testing.assert_allclose(each.step.array(), told[0], atol=0.05)


def test_a_network_tells_of_the_first_scans_that_have_too_little_to_match():
    bearings = np.deg2rad(np.arange(-180, 180, 0.5))
    empty = [
        Scan(np.where(np.arange(720) == 360, 20.0, np.inf), bearings, stamp=0.1 * number)
        for number in range(5)
    ]
    scans, truth = room(10)
    later = [replace(scan, stamp=0.5 + 0.1 * number) for number, scan in enumerate(scans)]
    told = np.concatenate([np.tile([0.2, 0.0, 0.0], (5, 1)), truth])
    fused = track(FusedTracker(NetworkPrior(Told(told))), [*empty, *later])
    alone = track(MatcherTracker(), [*empty, *later])
    np.testing.assert_allclose(steps_of(alone)[:5], 0)
    np.testing.assert_allclose(steps_of(fused)[1:4, 0], 0.2, atol=0.01)
    np.testing.assert_allclose(steps_of(fused)[6:], truth[1:], atol=0.02)


def test_after_scans_without_returns_the_matcher_goes_on_alone():
    """The network's step begins at a pose that the network has predicted, and the matcher is elsewhere."""
    scans, truth = room(20)
    bearings = scans[10].bearings
    scans[10] = replace(scans[10], ranges=np.full(len(bearings), np.inf))
    source, last_motion = NetworkPrior(Told(truth)), Prior(np.zeros(3), np.eye(3))
    source.begin(scans[0])
    alone = [source.expect(scan, 1, 0.1, last_motion)[0] is last_motion for scan in scans[1:]]
    assert [number for number, each in enumerate(alone, start=1) if each] == [10, 11]


def test_held_is_the_last_motion_as_if_it_were_measured():
    held = Prior(np.array([0.1, 0.0, 0.0]), np.diag([0.01, 0.01, 0.01]))
    assert LastMotion().expect(None, 1, None, held) == (held, ())
    measured, _ = LastMotion(is_measured=True).expect(None, 1, None, held)
    assert measured.pull is held.covariance
    assert measured.step is held.step
    scans, truth = room()
    np.testing.assert_allclose(steps_of(track(fused_tracker("held"), scans)), truth, atol=0.03)


def test_wheels_are_a_source_like_any_other():
    held = Prior(np.array([0.1, 0.0, 0.0]), np.eye(3))
    wheels, scan = Wheels(), Scan(np.ones(3), wheel_pose=(1.0, 2.0, np.pi / 2))
    wheels.begin(scan)
    prior, notes = wheels.expect(replace(scan, wheel_pose=(1.0, 3.0, np.pi / 2)), 1, None, held)
    np.testing.assert_allclose(prior.step, [1, 0, 0], atol=1e-12)
    assert prior.pull is prior.covariance
    assert notes == ()
    assert wheels.expect(replace(scan, wheel_pose=None), 1, None, held)[0] is held
    np.testing.assert_allclose(
        prior.step, relative_step(np.array([1.0, 2.0, np.pi / 2]), np.array([1.0, 3.0, np.pi / 2]))
    )


# --- as a model and on the command line --------------------------------------------------------------


def test_a_missing_file_is_told_in_one_line(tmp_path):
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(b"no network")
    with pytest.raises(InputError, match=r"none\.onnx: no such file, nor a model that ships") as told:
        Fused({"network": "none.onnx"}, ROUND)
    assert "\n" not in str(told.value)
    with pytest.raises(InputError, match="not an ONNX file that can be run") as told:
        Fused({"network": str(bad)}, ROUND).tracker()
    assert "\n" not in str(told.value)
    with pytest.raises(InputError, match=r"model\.network= : must be the name of a shipped network"):
        check_options(Fused.Options, {"network": " "}, "model.")


@pytest.mark.parametrize("network", ["held", "all_round", "half_circle"])
def test_it_is_scored_like_any_model(configure, network):
    options = ["data=blind", "data.frames=30", "data.test=[tunnel-8]", "data.lengths=[5.0]"]
    cfg = configure("model=fused", f"model.network={network}", *options, "data.workers=1", name="evaluate")
    assert plain(cfg)["model"] == {"variant": "fused", "network": network}
    metrics = evaluate(cfg)
    assert metrics["variant"] == "fused"
    assert metrics["test"]["sequences"]["tunnel-8"]["frames"] == 30


def test_it_runs_on_recordings_and_streams(tmp_path, capsys, monkeypatch):
    make_kitti(tmp_path, ["05"], frames=6)
    source = str(tmp_path / "sequences" / "05")
    out = tmp_path / "out"
    assert main(["run", source, "--model", "fused", "--out", str(out)]) == 0
    assert json.loads((out / "summary.json").read_text())["model"] == "fused"
    held = ["run", source, "--model", "fused", "--network", "held", "--out", str(tmp_path / "held")]
    assert main(held) == 0
    assert main(["run", source, "--model", "fused", "--network", "x.onnx", "--out", str(tmp_path / "x")]) == 1
    assert "x.onnx: no such file" in capsys.readouterr().err
    for words in (["--network", "held"], ["--model", "fused", "--wheels"]):
        with pytest.raises(SystemExit):
            main(["run", source, *words, "--out", str(tmp_path / "y")])
    assert "--wheels works only with the matcher" in capsys.readouterr().err


def test_the_default_is_the_matcher_alone():
    assert (ROOT / "conf" / "model" / "fused.yaml").exists()
    assert MatcherTracker().wheels is False
    assert isinstance(MatcherTracker()._source, LastMotion)
