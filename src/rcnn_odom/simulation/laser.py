"""Measurement model of lasers: one ring of an HDL-64 on a car, or a robot's level scanner."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray, wrap_angle
from rcnn_odom.simulation.raycast import NO_WALL, cast, cast_each
from rcnn_odom.simulation.scene import Material, Scene

GROUND = Material(returned=0.9, roughness=0.03)


@dataclass(frozen=True)
class Laser:
    """A 2D laser. One measurement of a beam is called a shot.

    Attributes:
        step_deg: change of azimuth from one shot to the next.
        half_steps: part of the shots that follow after half of ``step_deg``, as an HDL-64's encoder causes.
        field_of_view_deg: angle that the laser covers.
        max_range: metres.
        rise: metres, height of the beams' common origin above the origin of the laser's frame.
        elevation_deg: elevation of all beams. ``rise`` and ``elevation_deg`` were fitted to the HDL-64's
            eighth ring in KITTI, in frames 0 to 5 of sequence 00 and 0 to 19 of 90: its returns lie on
            z = 0.206 m - 0.452 degrees times range, to a millimetre. So the elevation of a return seen from
            the origin changes with its range.
        noise: metres, standard deviation of a range.
        reach: metres up to which a wall that is hit at a right angle always gives a return. For farther or
            slanted walls, the probability falls with the power that is reflected.
        lost: probability that a shot is lost independently of the scene.
        trembling_deg: standard deviation of a shot's azimuth.
        noise_share: the standard deviation of a range is at least this part of the range; None: no such
            bound.
        facing_deg: direction of the middle of the field of view, which is cut out of a whole ring; None:
            evenly spaced shots, symmetric about straight ahead.
    """

    step_deg: float
    half_steps: float = 0.0
    field_of_view_deg: float = 360.0
    max_range: float = 80.0
    rise: float = 0.0
    elevation_deg: float = 0.0
    noise: float = 0.018
    reach: float = 110.0
    lost: float = 0.006
    trembling_deg: float = 0.0
    noise_share: float | None = None
    facing_deg: float | None = None

    def look(
        self, scene: Scene, frame: int, pose: FloatArray, rng: np.random.Generator, missing: bool = True
    ) -> npt.NDArray[np.float32]:
        """Simulate one revolution in which all shots happen at the same time.

        Args:
            scene: the scene.
            frame: number of the frame, which gives the positions of moving objects.
            pose: (4, 4) laser to world.
            rng: source of the noise and of lost shots.
            missing: whether shots can be lost; False: everything within range gives a return.

        Returns:
            The points of the returns as from :meth:`points`, sorted by azimuth in [0, 2 pi).
        """
        azimuth = self.azimuths(rng)
        return self.points(azimuth, self.shoot(scene, frame, pose, azimuth, rng, missing))

    def shoot(
        self,
        scene: Scene,
        frame: int,
        pose: FloatArray,
        azimuth: FloatArray,
        rng: np.random.Generator,
        missing: bool = True,
    ) -> FloatArray:
        """Simulate the ranges of shots.

        Args:
            scene, frame, rng, missing: as for :meth:`look`.
            pose: (4, 4) laser to world, or (B, 4, 4) one for each shot.
            azimuth: (B,) radians, azimuths of the shots in any order.

        Returns:
            Ranges (B,) in metres in the laser's plane; inf for no return.
        """
        start, own = self._beams(azimuth)
        walls, turn = scene.walls(frame), pose[..., :3, :3]
        if pose.ndim == 2:
            directions, origin = own @ turn.T, turn @ start + pose[:3, 3]
            depth, hit, squareness = cast(walls, scene.ground, origin, directions, self.max_range)
        else:
            directions, origins = np.einsum("bij,bj->bi", turn, own), turn @ start + pose[:, :3, 3]
            depth, hit, squareness = cast_each(walls, scene.ground, origins, directions, self.max_range)
        # HIT_GROUND (-2) and NO_WALL (-1) index the two values that are appended.
        roughness = np.append(walls.roughness, [GROUND.roughness, 0.0])[hit]
        ranges = depth / np.hypot(directions[:, 0], directions[:, 1])
        ranges += np.hypot(self._noise_at(ranges), roughness) * rng.standard_normal(len(ranges))
        luck = rng.random(len(ranges))
        met = (hit != NO_WALL) & (ranges > 0.1) & (ranges < self.max_range)
        if missing:
            chance = np.append(walls.returned, [GROUND.returned, 0.0])[hit]
            power = squareness * (self.reach / depth) ** 2
            met &= luck < (1 - self.lost) * chance * np.minimum(1, power)
        return np.where(met, ranges, np.inf)

    def points(self, azimuth: FloatArray, ranges: FloatArray) -> npt.NDArray[np.float32]:
        """Convert the shots with a return to points.

        Args:
            azimuth: (B,) radians.
            ranges: (B,) metres, as from :meth:`shoot`.

        Returns:
            (P, 4) x, y, z in metres in the laser's frame and reflectance 0, as in a file of an HDL-64.

        >>> hdl64_ring(max_range=80.0).points(np.zeros(2), np.array([10.0, np.inf])).shape
        (1, 4)
        """
        start, own = self._beams(azimuth)
        met = np.isfinite(ranges)
        points = np.zeros((int(met.sum()), 4), dtype=np.float32)
        points[:, :3] = start + ranges[met, None] * own[met]
        return points

    def _beams(self, azimuth: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Common origin (3,) of the beams and their directions (B, 3), of horizontal length 1."""
        rise = np.full_like(azimuth, np.tan(np.deg2rad(self.elevation_deg)))
        return np.array([0.0, 0.0, self.rise]), np.stack([np.cos(azimuth), np.sin(azimuth), rise], axis=1)

    def _noise_at(self, ranges: FloatArray) -> FloatArray | float:
        """Standard deviation in metres of ranges (B,)."""
        if self.noise_share is None:
            return self.noise
        return np.maximum(self.noise, self.noise_share * np.minimum(ranges, self.max_range))

    def azimuths(self, rng: np.random.Generator) -> FloatArray:
        """Azimuths (B,) of the shots of a revolution in radians, sorted in [0, 2 pi).

        They are sorted because the next ring of a Velodyne's file begins where the azimuth falls.
        """
        step, view = self.step_deg, self.field_of_view_deg
        if view < 360 and self.facing_deg is None:
            shots = round(view / step) + 1
            azimuth = np.deg2rad(np.arange(shots) * step - view / 2)
        else:
            shots = int(360 / (step * (1 - self.half_steps / 2))) + 1
            steps = np.where(rng.random(shots + 60) < self.half_steps, step / 2, step)
            turned = rng.uniform(0, step) + np.cumsum(steps) - steps[0]
            azimuth = np.deg2rad(turned[turned < 360])
        if self.trembling_deg:
            azimuth = azimuth + np.deg2rad(self.trembling_deg) * rng.standard_normal(len(azimuth))
        if self.facing_deg is not None:
            aside = wrap_angle(azimuth - np.deg2rad(self.facing_deg))
            azimuth = azimuth[np.abs(aside) <= np.deg2rad(view / 2)]
        return np.sort(azimuth % (2 * np.pi))


def hdl64_ring(max_range: float) -> Laser:
    """The ring of an HDL-64 that the KITTI reader chooses; its values were fitted to real frames."""
    return Laser(
        step_deg=0.18,
        half_steps=0.14,
        max_range=max_range,
        rise=0.206,
        elevation_deg=-0.452,
        trembling_deg=0.002,
    )


def scanner(resolution_deg: float, field_of_view_deg: float, max_range: float) -> Laser:
    """A robot's level laser, such as a SICK LMS: degrees from beam to beam and covered, and metres."""
    return Laser(resolution_deg, field_of_view_deg=field_of_view_deg, max_range=max_range, noise=0.01)
