"""Matchers of other projects behind the contract, on a room whose scans can be computed by hand."""

import sys

import numpy as np
import pytest

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import planar_to_poses, poses_to_planar, relative_steps
from rcnn_odom.models.contract import all_models, find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.peers.peer import Peer, PeerTracker, points_of
from rcnn_odom.models.tracking import Kind, Tracking
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.scan import Scan

SENSOR = Sensor(resolution_deg=1.0, field_of_view_deg=360.0, max_range=20.0)
VOXELS = {"kiss_icp": 0.2, "genz_icp": 0.1, "small_gicp": 0.05, "karto": 0.03}
CLOSENESS = {"kiss_icp": 0.03, "genz_icp": 0.03, "small_gicp": 0.15, "karto": 0.03}
"""Part of the path by which its end may be missed; from scan to scan, points drag along smooth walls."""
MODULES = {
    "kiss_icp": "kiss_icp.kiss_icp",
    "genz_icp": "genz_icp.genz_icp",
    "small_gicp": "small_gicp",
    "karto": "karto_scanmatcher",
}
WIDTH, DEPTH = 9.0, 6.0
"""Of the room in metres, its corner at the origin."""
NOISE = 0.005
"""Standard deviation of a range in metres."""


def scan_of_the_room(x, y, heading):
    """Ranges of 360 beams from a place in the room to its walls."""
    bearings = np.deg2rad(np.arange(-180.0, 180.0))
    direction = np.stack([np.cos(bearings + heading), np.sin(bearings + heading)])
    with np.errstate(divide="ignore"):
        along = np.where(direction > 0, [[WIDTH - x], [DEPTH - y]], [[-x], [-y]]) / direction
    noise = np.random.default_rng(round(1e6 * (x + y + heading))).normal(0.0, NOISE, 360)
    return Scan(np.abs(along).min(0) + noise, bearings)


def drive_in_the_room(scans=40):
    """A bend through the room, 3 m long, a few centimetres and degrees from scan to scan."""
    turn = np.linspace(0.0, 1.2, scans)
    places = np.column_stack([2.0 + 2.5 * np.sin(turn), 1.5 + 2.5 * (1 - np.cos(turn)), turn])
    poses = planar_to_poses(places)
    return Drive(
        name="room",
        key="",
        scans=np.empty((scans, 0), np.float32),
        poses=poses,
        stamps=np.arange(float(scans)),
        camera_from_laser=np.eye(4),
        has_clock=False,
        read_scan=lambda frame: scan_of_the_room(*places[frame]),
    )


def peer_of(name):
    """The peer; skips where its package is not installed."""
    pytest.importorskip(MODULES[name], reason=f"{name}: its package is not installed")
    return find_model(name)({"voxel": VOXELS[name]}, SENSOR)


def test_the_room_is_seen_as_it_is():
    scan = scan_of_the_room(2.0, 1.5, np.pi / 2)
    ahead, left = scan.ranges[180], scan.ranges[270]
    assert (ahead, left) == pytest.approx((DEPTH - 1.5, 2.0), abs=5 * NOISE)
    points = points_of(scan, SENSOR)
    assert points.shape == (360, 3)
    assert not points[:, 2].any()
    # In the laser's frame the walls are at -1.5 and 4.5 m ahead, and 2 m to the left and 7 to the right.
    np.testing.assert_allclose([points[:, 0].min(), points[:, 0].max()], [-1.5, 4.5], atol=5 * NOISE)
    np.testing.assert_allclose([points[:, 1].min(), points[:, 1].max()], [-7.0, 2.0], atol=5 * NOISE)


@pytest.mark.parametrize("name", VOXELS)
def test_a_drive_is_followed(name):
    drive = drive_in_the_room()
    steps = peer_of(name).estimate(drive)
    assert len(steps) == len(drive) - 1
    assert np.isnan(steps.covariances).all()
    lengths = [np.hypot(*every[:, :2].T).sum() for every in (steps.values, drive.steps)]
    assert lengths[0] / lengths[1] == pytest.approx(1, abs=0.08)
    end = poses_to_planar(np.linalg.inv(drive.poses[:1]) @ drive.poses[-1:])[0]
    found = poses_to_planar(steps.poses())[-1]
    assert np.hypot(*(found - end)[:2]) < CLOSENESS[name] * lengths[1]
    assert found[2] == pytest.approx(end[2], abs=CLOSENESS[name])


@pytest.mark.parametrize("name", VOXELS)
def test_a_scan_without_returns_is_passed_over(name):
    scans = list(drive_in_the_room(20).raw_scans())
    empty = Scan(np.zeros(360), scans[0].bearings)
    tracking = Tracking(peer_of(name).tracker())
    found = [tracking.step(scan) for scan in [*scans[:10], empty, *scans[10:]]]
    assert found[10].kind is Kind.HELD
    assert found[10].notes == ("no match: 0 returns, 10 are needed",)
    assert {tracked.kind for tracked in found[11:]} == {Kind.ESTIMATED}


@pytest.mark.parametrize("name", VOXELS)
def test_a_missing_package_is_told_with_its_remedy(name, monkeypatch):
    for module in [*sys.modules]:
        if module.split(".")[0] == MODULES[name].split(".")[0]:
            monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, MODULES[name].split(".")[0], None)
    model = find_model(name)
    message = rf"^model {name}: needs the package {model.package}; pip install 'rcnn-odom\[peers\]'$"
    with pytest.raises(InputError, match=message):
        model({"voxel": 0.1}, SENSOR).tracker()


def test_all_of_them_are_models_of_whole_scans():
    models = all_models()
    assert set(VOXELS) <= set(models)
    assert not any(models[name].uses_depth_vectors or models[name].trains for name in VOXELS)


class Failing(Peer):
    """A peer that says nan at its third scan and raises an error at its fifth."""

    name, package = "failing", "none"

    def aligner(self):
        return self

    count = 0

    def add(self, scan, points):
        self.count += 1
        if self.count == 5:
            raise RuntimeError("lost")
        return np.full((4, 4), np.nan) if self.count == 3 else planar_to_poses([(self.count, 0.0, 0.0)])[0]


def test_errors_of_a_peer_are_told_and_it_begins_anew():
    tracker = PeerTracker(Failing({"voxel": 1.0}, SENSOR))
    scan = scan_of_the_room(2.0, 2.0, 0.0)
    tracker.begin(scan)
    found = [tracker.register(scan) for _ in range(4)]
    assert [registered.is_estimated for registered in found] == [True, False, True, False]
    assert found[1].notes == ("error: failing: ValueError: its pose is not finite",)
    assert found[3].notes == ("error: failing: RuntimeError: lost",)
    np.testing.assert_allclose(found[1].step.array(), found[0].step.array())


def test_planes_say_nothing_of_points_in_one_plane():
    """Why small_gicp is asked for point to point: its planes stand still, and call it converged."""
    small_gicp = pytest.importorskip("small_gicp", reason="small_gicp is not installed")
    drive = drive_in_the_room()
    scans = list(drive.raw_scans())
    target, source = (points_of(scans[frame], SENSOR) for frame in (0, 4))
    x = relative_steps(drive.poses[[0, 4]])[0, 0]
    found = {
        kind: small_gicp.align(
            target,
            source,
            registration_type=kind,
            downsampling_resolution=0.05,
            max_correspondence_distance=1.0,
        )
        for kind in ("PLANE_ICP", "ICP")
    }
    assert x > 0.25
    assert found["PLANE_ICP"].converged
    assert abs(found["PLANE_ICP"].T_target_source[0, 3]) < 0.01
    assert abs(found["ICP"].T_target_source[0, 3] - x) < 0.1
