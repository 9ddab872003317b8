"""Tiny recordings in KITTI's layouts: a car among posts and walls, scans and poses that agree."""

from collections.abc import Sequence as Names
from pathlib import Path

import numpy as np

TR = np.array(
    [
        [4.276802385584e-04, -9.999672484946e-01, -8.084491683471e-03, -1.198459927713e-02],
        [-7.210626507497e-03, 8.081198471645e-03, -9.999413164504e-01, -5.403984729748e-02],
        [9.999738645903e-01, 4.859485810390e-04, -7.206933692422e-03, -2.921968648686e-01],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
VELO_FROM_IMU = np.array(
    [
        [9.999976e-01, 7.553071e-04, -2.035826e-03, -8.086759e-01],
        [-7.854027e-04, 9.998898e-01, -1.482298e-02, 3.195559e-01],
        [2.024406e-03, 1.482454e-02, 9.998881e-01, -7.997231e-01],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
RECTIFICATION = np.array(
    [
        [9.999239e-01, 9.837760e-03, -7.445048e-03],
        [-9.869795e-03, 9.999421e-01, -4.278459e-03],
        [7.402527e-03, 4.351614e-03, 9.999631e-01],
    ]
)
LATITUDE, LONGITUDE = 49.015, 8.434
ELEVATIONS_DEG = (0.9, 0.5, 0.1, -0.3, -0.7)
LEVEL_RING = 2


def make_kitti(
    root: Path,
    names: Names[str] = ("00",),
    frames: int = 60,
    rings: int = 4,
    beams: int = 720,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Write sequences under ``root``; returns x, y and heading of the laser, (frames, 3), by name.

    About 1 m a frame and turns of up to 2 degrees. Ring 2 is the most level one. The azimuth is noisy,
    so that points of a ring's beginning can fall just short of azimuth 0.
    """
    made = {}
    for index, name in enumerate(names):
        rng = np.random.default_rng([seed, index])
        planar = drive(rng, frames, distance=(0.8, 1.2), turn_deg=2.0)
        files = [root / "sequences" / name / "velodyne" / f"{frame:06d}.bin" for frame in range(frames)]
        _write_scans(files, rng, planar, rings, beams)
        _write_texts(root, name, planar)
        made[name] = planar
    return made


def make_kitti_raw(
    root: Path, name: str = "2011_09_26_drive_0001_sync", frames: int = 6, first: int = 0
) -> np.ndarray:
    """Write a drive of KITTI raw below ``root``, its frames numbered from ``first`` on.

    Returns:
        x, y and heading of the laser, (frames, 3), up to where it begins.
    """
    rng = np.random.default_rng([0, 0])
    planar = drive(rng, frames, distance=(0.8, 1.2), turn_deg=2.0)
    date = root / name[:10]
    folder = date / name
    numbers = range(first, first + frames)
    files = [folder / "velodyne_points" / "data" / f"{number:010d}.bin" for number in numbers]
    _write_scans(files, rng, planar, rings=4, beams=720)
    stamps = "".join(f"2011-09-26 13:02:{25.951199337 + 0.1036 * frame:012.9f}\n" for frame in numbers)
    earlier = "".join(f"2011-09-26 13:02:{25.9 + 0.001 * number:012.9f}\n" for number in range(first))
    (folder / "oxts" / "data").mkdir(parents=True)
    for sensor in ("velodyne_points", "oxts"):
        (folder / sensor / "timestamps.txt").write_text(earlier + stamps)
    for number, pose in zip(numbers, _laser_poses(planar) @ VELO_FROM_IMU, strict=True):
        (folder / "oxts" / "data" / f"{number:010d}.txt").write_text(oxts_line(pose) + "\n")
    for file, transform in (("velo_to_cam", TR), ("imu_to_velo", VELO_FROM_IMU)):
        lines = f"R: {_words(transform[:3, :3])}\nT: {_words(transform[:3, 3])}\n"
        (date / f"calib_{file}.txt").write_text(f"calib_time: 15-Mar-2012 11:37:16\n{lines}")
    (date / "calib_cam_to_cam.txt").write_text(f"S_00: 1392 512\nR_rect_00: {_words(RECTIFICATION)}\n")
    return planar


def oxts_line(pose: np.ndarray) -> str:
    """A line of the GPS/IMU for its pose (4, 4), x east and y north of a place in Karlsruhe."""
    x, y, z = pose[:3, 3]
    radius = 6378137 * np.cos(np.deg2rad(LATITUDE))
    north = np.arcsinh(np.tan(np.deg2rad(LATITUDE))) + y / radius
    place = (np.rad2deg(np.arctan(np.sinh(north))), LONGITUDE + np.rad2deg(x / radius), 116.4 + z)
    yaw, pitch = np.arctan2(pose[1, 0], pose[0, 0]), -np.arcsin(pose[2, 0])
    roll = np.arctan2(pose[2, 1], pose[2, 2])
    return " ".join(f"{value:.16g}" for value in (*place, roll, pitch, yaw, *np.zeros(24)))


def _words(values: np.ndarray) -> str:
    return " ".join(f"{value:.12e}" for value in values.ravel())


def drive(
    rng: np.random.Generator, frames: int, distance: tuple[float, float], turn_deg: float
) -> np.ndarray:
    """x, y and heading, (frames, 3), of a smooth drive from the origin: straights and bends in turn."""
    time = np.arange(frames - 1)
    middle, half = np.mean(distance), np.ptp(distance) / 2
    steps = middle + half * np.sin(time / 9.0 + rng.uniform(0, 6))
    bends = np.sin(time / 12.0 + rng.uniform(0, 6))
    turns = np.deg2rad(turn_deg) * np.sign(bends) * np.maximum(np.abs(bends) - 0.3, 0) / 0.7
    heading = np.concatenate([[0.0], np.cumsum(turns)])
    x = np.concatenate([[0.0], np.cumsum(steps * np.cos(heading[1:]))])
    y = np.concatenate([[0.0], np.cumsum(steps * np.sin(heading[1:]))])
    return np.stack([x, y, heading], axis=1)


def world(
    rng: np.random.Generator,
    planar: np.ndarray,
    clearance: float,
    margin: float,
    posts: int,
    radius: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Posts off the path as rows of x, y, radius (K, 3), and walls round it all: x and y limits (2, 2)."""
    walls = np.stack([planar[:, :2].min(0) - margin, planar[:, :2].max(0) + margin])
    circles = np.column_stack(
        [rng.uniform(walls[0], walls[1], (posts * 4, 2)), rng.uniform(*radius, posts * 4)]
    )
    gap = np.hypot(*(circles[:, None, :2] - planar[None, :, :2]).transpose(2, 0, 1)).min(1) - circles[:, 2]
    return circles[gap > clearance][:posts], walls


def cast(pose: np.ndarray, angles: np.ndarray, circles: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Range in metres along every beam (P,) from a pose (3,) to the nearest post or wall."""
    x, y, heading = pose
    along = np.stack([np.cos(heading + angles), np.sin(heading + angles)])
    with np.errstate(divide="ignore"):
        to_walls = (walls[:, :, None] - np.array([x, y])[None, :, None]) / along[None]
    ranges = np.where(to_walls > 0, to_walls, np.inf).min(axis=(0, 1))
    centre = circles[:, :2] - np.array([x, y])
    ahead = centre @ along
    aside = centre[:, :1] * along[1] - centre[:, 1:] * along[0]
    inside = circles[:, 2:] ** 2 - aside**2
    hit = (ahead > 0) & (inside > 0)
    to_circles = np.where(hit, ahead - np.sqrt(np.maximum(inside, 0)), np.inf)
    return np.minimum(ranges, to_circles.min(axis=0, initial=np.inf))


def _write_scans(files: Names[Path], rng, planar: np.ndarray, rings: int, beams: int) -> None:
    """A file for each pose: what a laser of so many rings sees among posts and walls."""
    circles, walls = world(rng, planar, clearance=2.5, margin=25.0, posts=60, radius=(0.3, 1.5))
    files[0].parent.mkdir(parents=True)
    for file, pose in zip(files, planar, strict=True):
        points = [_ring(rng, pose, circles, walls, beams, elevation) for elevation in ELEVATIONS_DEG[:rings]]
        np.concatenate(points).astype("<f4").tofile(file)


def _ring(rng, pose, circles, walls, beams, elevation_deg):
    angles = np.arange(beams) * 2 * np.pi / beams + rng.normal(0, np.deg2rad(0.02), beams)
    ranges = cast(pose, angles, circles, walls) + rng.normal(0, 0.01, beams)
    height = ranges * np.tan(np.deg2rad(elevation_deg + rng.normal(0, 0.05, beams)))
    points = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), height, np.zeros(beams)], axis=1)
    return points[(ranges < 80) & (rng.random(beams) > 0.02)]


def _laser_poses(planar: np.ndarray) -> np.ndarray:
    laser = np.tile(np.eye(4), (len(planar), 1, 1))
    cos, sin = np.cos(planar[:, 2]), np.sin(planar[:, 2])
    laser[:, 0, 0], laser[:, 0, 1], laser[:, 1, 0], laser[:, 1, 1] = cos, -sin, sin, cos
    laser[:, :2, 3] = planar[:, :2]
    return laser


def _write_texts(root: Path, name: str, planar: np.ndarray) -> None:
    camera = TR @ _laser_poses(planar) @ np.linalg.inv(TR)
    folder = root / "sequences" / name
    (root / "poses").mkdir(exist_ok=True)
    np.savetxt(root / "poses" / f"{name}.txt", camera[:, :3].reshape(-1, 12), fmt="%.12e")
    np.savetxt(folder / "times.txt", 0.1036 * np.arange(len(planar)), fmt="%.6e")
    projection = "7.188560000000e+02 0 6.071928000000e+02 0 0 7.188560000000e+02 1.852157000000e+02 0 0 0 1 0"
    lines = [f"P{camera_index}: {projection}" for camera_index in range(4)]
    lines.append("Tr: " + " ".join(f"{value:.12e}" for value in TR[:3].ravel()))
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
