"""The exact answers to what a simulated drive asks."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.poses import Poses
from sceneloom.simulate.boxes import BoxTruth, boxes_of
from sceneloom.simulate.camera import ImageTruth, RenderedCamera
from sceneloom.simulate.casting import Rays, bundles_by_direction, cast
from sceneloom.simulate.edges import edge_mask
from sceneloom.simulate.inertial import ImuTruth
from sceneloom.simulate.lidar import ScanningLidar, Sweep
from sceneloom.simulate.movers import Mover
from sceneloom.simulate.path import EgoPath
from sceneloom.simulate.radar import SimulatedRadar
from sceneloom.simulate.street import Street, StreetObject

_BEYOND = 1.0
"""How far past a point its line of sight is followed [m]: enough to find the surface that it lies on."""


@dataclass(frozen=True, slots=True, eq=False)
class CleanPoints:
    """Where the returns of a sweep come from, in the order of the frame's points, without noise.

    Attributes:
        positions_world: (N, 3) float64 [m].
        instances: (N,) int32, what was hit; 0 is the ground.
        colors: (N, 3) uint8, colour of the bare surface there, which an image shows averaged over a pixel.
        ranges: (N,) float64 [m], from the lidar at the point's own time.
        velocities: (N, 3) float64 [m/s], world frame, of what was hit, at the point; zero where it is stationary.
    """

    positions_world: Float64Array
    instances: AnyArray
    colors: UInt8Array
    ranges: Float64Array
    velocities: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class OcclusionTruth:
    """What hides objects in an image; those that no pixel's centre would show are left out.

    Attributes:
        instances: (I,) int64, rising.
        visible_px: (I,) int64, pixels whose centres show the object.
        alone_px: (I,) int64, pixels that would show it if nothing else were there.
    """

    instances: Int64Array
    visible_px: Int64Array
    alone_px: Int64Array

    @property
    def hidden(self) -> Float64Array:
        """Which share of each object is hidden, (I,) float64, 0 to 1."""
        shares: Float64Array = 1.0 - self.visible_px / self.alone_px
        return shares


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is exactly so in a simulated drive. Images are rendered when asked for, nothing is kept.

    Attributes:
        street: everything that stands in it and that moves.
        path: the ego trajectory as a curve.
        lidars: the lidars by id, with their noise apart.
        cameras: the cameras by id.
        radars: the radars by id, with their noise apart.
        imu: the inertial unit's signals without errors, and its bias.
    """

    street: Street
    path: EgoPath
    lidars: Mapping[str, ScanningLidar]
    cameras: Mapping[str, RenderedCamera]
    radars: Mapping[str, SimulatedRadar]
    imu: ImuTruth

    @property
    def lidar(self) -> ScanningLidar:
        """The first lidar."""
        return next(iter(self.lidars.values()))

    @property
    def objects(self) -> tuple[StreetObject, ...]:
        """What stands in the street; object k has instance number k + 1."""
        return self.street.objects

    @property
    def movers(self) -> tuple[Mover, ...]:
        """What moves; instance numbers go on after those of the objects."""
        return self.street.movers.things

    def boxes(self, timestamps_ns: ArrayLike) -> BoxTruth:
        """Boxes and velocities of all that stands and moves, at (T,) times [ns]."""
        return boxes_of(self.street, np.asarray(timestamps_ns, np.int64))

    def world_from_ego(self, timestamps_ns: Int64Array) -> Poses:
        """Exact ego poses at strictly increasing times [ns]."""
        return self.path.poses(timestamps_ns)

    def world_from_camera(self, camera_id: str, k: int) -> RigidTransform:
        """Exact pose of a camera at the time of its image k; of a rolling shutter, that of its middle."""
        return self._camera(camera_id).pose(k)

    def image(self, camera_id: str, k: int) -> ImageTruth:
        """Depths, instances and colours of image k in one go.

        Raises:
            OptionError: there is no such camera.
        """
        return self._camera(camera_id).truth(k)

    def depth(self, camera_id: str, k: int) -> Float32Array:
        """Depth z at the pixels' centres, (H, W) float32 [m]; 0 for the sky."""
        return self.image(camera_id, k).depths

    def instances(self, camera_id: str, k: int) -> AnyArray:
        """What the pixels' centres show, (H, W) int32; 0 the ground, -1 the sky."""
        return self.image(camera_id, k).instances

    def colors(self, camera_id: str, k: int) -> UInt8Array:
        """Colour along the ray through each pixel's centre, (H, W, 3) uint8, whatever the exposure was."""
        return self.image(camera_id, k).colors

    def exposure(self, camera_id: str, k: int) -> float:
        """By what image k is brighter than the true colours, in its middle; 1.0 where nothing changes it."""
        return self._camera(camera_id).gain(k)

    def edges(self, camera_id: str, k: int, *, within_px: int = 2) -> BoolArray:
        """Which pixels lie near an outline, (H, W) bool; `edge_mask` says what an outline is."""
        return edge_mask(self.image(camera_id, k), within_px=within_px)

    def occlusion(self, camera_id: str, k: int) -> OcclusionTruth:
        """How much of each object image k shows, and how much it would show if nothing stood before it."""
        camera = self._camera(camera_id)
        alone = camera.silhouettes(k)
        shown = self.instances(camera_id, k)
        visible = np.bincount(shown[shown > 0], minlength=len(alone) + 1)[1:]
        inside = np.flatnonzero(alone)
        return OcclusionTruth(inside + 1, visible[inside], alone[inside])

    def visible(
        self, camera_id: str, k: int, points_world: ArrayLike, *, tolerance: float = 0.01
    ) -> BoolArray:
        """Report for each surface point whether nothing stands between it and the camera, when its line is taken.

        Whether it falls into the image is another question.

        Args:
            points_world: (N, 3) float [m], on surfaces, such as `clean_points_world` gives.
            tolerance: how far from the first surface on its line of sight a point may lie and be seen [m].

        Returns:
            (N,) bool.
        """
        camera, points = self._camera(camera_id), np.asarray(points_world, np.float64).reshape(-1, 3)
        lines, (_, origins) = camera.lines_seeing(k, points), camera.line_poses(k)
        apart = points - origins[lines]
        distances = np.linalg.norm(apart, axis=1)
        directions = apart / np.maximum(1e-12, distances)[:, None]
        rays = Rays.bundled(directions, bundles_by_direction(directions), pose_of_ray=lines)
        reach = float(distances.max(initial=0.0)) + _BEYOND
        upright = np.tile(np.eye(3), (len(origins), 1, 1))
        hits = cast(self.street, rays, upright, origins, camera.line_times_ns(k), reach=reach)
        free: BoolArray = (hits.ranges == 0.0) | (hits.ranges > distances - tolerance)
        return free

    def sweep(self, k: int, lidar_id: str | None = None) -> Sweep:
        """Sweep k of a lidar, by default the first, with everything that is known about it.

        Raises:
            OptionError: there is no such lidar.
        """
        return self._lidar(lidar_id).sweep(k)

    def clean_points_world(self, k: int, lidar_id: str | None = None) -> CleanPoints:
        """Where the points of frame k of a lidar, by default the first, come from, without noise.

        Raises:
            OptionError: there is no such lidar.
        """
        sweep = self.sweep(k, lidar_id)
        return CleanPoints(sweep.points_world, sweep.instances, sweep.colors, sweep.ranges, sweep.velocities)

    def _lidar(self, lidar_id: str | None) -> ScanningLidar:
        if lidar_id is None:
            return self.lidar
        if lidar_id not in self.lidars:
            raise OptionError(f"lidar {lidar_id!r}; expected one of {', '.join(map(repr, self.lidars))}")
        return self.lidars[lidar_id]

    def _camera(self, camera_id: str) -> RenderedCamera:
        if camera_id not in self.cameras:
            raise OptionError(f"camera {camera_id!r}; expected one of {', '.join(map(repr, self.cameras))}")
        return self.cameras[camera_id]
