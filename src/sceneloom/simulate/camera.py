"""Simulated cameras: exposure, rendered images and their truth."""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import check_camera, project, unproject
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.types import NO_FIELDS
from sceneloom.simulate.casting import Hits, Paint, Rays, cast, instances_of, paint, silhouettes
from sceneloom.simulate.parameters import Stream, check_bounds, generator_for
from sceneloom.simulate.street import Street
from sceneloom.simulate.trajectory import EgoPath, sensor_mount

_EXPOSURE_FIELD = "exposureTimeSeconds"  # the recording format's word for how long an image was exposed [s]
_SECOND_WAVE = 0.382
"""The shorter of the two waves of the drift, as a share of `drift_period`: without a common measure with it."""


@dataclass(frozen=True, slots=True)
class ExposureSpec:
    """How the brightness of a camera's images changes. A stop is a factor of two.

    The gain is one number per image and multiplies its 8-bit values, which are then cut off at 255. Nothing is
    blurred, however long the exposure.

    Attributes:
        drift_stops: how far the automatic wanders to either side at most.
        drift_period: time of its slow wave [s].
        steps: sudden changes of the light: when, in seconds after the start of the drive, and by how many stops, such
            as (4.0, 1.5) for the way out of a shadow. The automatic takes each back.
        recovery: time in which it takes back 63 % of a step [s]; infinite: never.
        vignetting: share of the light that the corner farthest from the image's middle lacks; it falls off with the
            square of the distance.
        exposure_ns: how long each image is exposed [ns], as its `exposureTimeSeconds` says; 0: not stated.

    Raises:
        OptionError: a number is out of bounds.
    """

    drift_stops: float = 0.35
    drift_period: float = 7.0
    steps: tuple[tuple[float, float], ...] = ()
    recovery: float = 0.8
    vignetting: float = 0.0
    exposure_ns: int = 8_000_000

    def __post_init__(self) -> None:
        check_bounds(
            "exposure",
            self,
            drift_stops=(0.0, 8.0),
            drift_period=(0.01, 1e6),
            recovery=(1e-6, float("inf")),
            vignetting=(0.0, 1.0),
            exposure_ns=(0, 10**9),
        )
        if not all(np.isfinite(seconds) and -8.0 <= stops <= 8.0 for seconds, stops in self.steps):
            raise OptionError(f"exposure.steps: {self.steps}; expected finite times, and -8 to 8 stops")


@dataclass(frozen=True, slots=True)
class Exposure:
    """The exposure of one camera on one drive.

    Attributes:
        spec: how it changes.
        start_ns: start of the drive [ns].
        phases: of the two waves of the drift [rad].
    """

    spec: ExposureSpec
    start_ns: int
    phases: tuple[float, float]

    @classmethod
    def of(cls, spec: ExposureSpec, *, start_ns: int, seed: int, camera: int) -> "Exposure":
        """Draw the drift of camera number `camera`."""
        first, second = generator_for(seed, Stream.EXPOSURE, sensor=camera).uniform(0.0, 2.0 * np.pi, 2)
        return cls(spec, start_ns, (float(first), float(second)))

    def gain(self, timestamp_ns: int) -> float:
        """The factor of an image at a time [ns]."""
        seconds, spec = (timestamp_ns - self.start_ns) * 1e-9, self.spec
        rotations = 2.0 * np.pi * seconds / spec.drift_period
        waves = 0.7 * np.sin(rotations + self.phases[0]) + 0.3 * np.sin(rotations / _SECOND_WAVE + self.phases[1])
        stops = spec.drift_stops * waves
        for begin, step in spec.steps:
            if seconds >= begin:
                stops += step * np.exp((begin - seconds) / spec.recovery)
        return float(2.0**stops)

    def applied(self, rgb: UInt8Array, timestamp_ns: int) -> UInt8Array:
        """An image (H, W, 3) as the camera gives it at a time [ns], rounded and cut off at 255."""
        factor = self.gain(timestamp_ns) * self._falloff(rgb.shape[0], rgb.shape[1])
        exposed: UInt8Array = np.rint(np.minimum(255.0, rgb * factor[..., None])).astype(np.uint8)
        return exposed

    def _falloff(self, height: int, width: int) -> Float64Array:
        """Share of the light that each pixel gets, (H, W)."""
        v, u = np.mgrid[:height, :width]
        squared = (u - (width - 1) / 2) ** 2 + (v - (height - 1) / 2) ** 2
        share: Float64Array = 1.0 - self.spec.vignetting * squared / max(1.0, float(squared[0, 0]))
        return share


_TILE = 16
_REACH = 900.0
_LONGEST_READOUT_NS = 100_000_000
LINE_ROUNDS = 4
"""How often the line that sees a point is looked for: each guess is off by what the image moves while the lines that
the guess before was off by are read, so the second is within a line in traffic."""

_EGO_FROM_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes of a camera that looks along the ego's x: right, down, forward."""


def camera_mount(
    *,
    position: tuple[float, float, float] = (0.55, 0.06, 1.62),
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
) -> RigidTransform:
    """Give `ego_from_camera` of a camera that looks ahead, rotated left by yaw and down by pitch.

    Args:
        position: in the ego frame [m].
        yaw_deg, pitch_deg, roll_deg: rotations about the ego's z, y and x axis, roll first.
    """
    ahead = sensor_mount(position=position, yaw_deg=yaw_deg, pitch_deg=pitch_deg, roll_deg=roll_deg)
    return RigidTransform(ahead.rotation @ _EGO_FROM_AHEAD, ahead.translation)


@dataclass(frozen=True, slots=True, eq=False)
class CameraSpec:
    """A camera that takes one image in each sweep of the lidar.

    Attributes:
        camera: the camera model.
        mount: `ego_from_camera`.
        offset_ns: time of the image after the start of the sweep [ns].
        supersampling: rays per pixel along each axis. 1: a pixel is the colour of the surface at its centre, exactly
            what the truth says; 2 or more: the mean over the pixel, which is prettier at outlines.
        readout_ns: how long a rolling shutter takes from the first row to the last [ns]: row r of H is taken at
            t + ((r + 0.5)/H - 0.5)·readout_ns, so that the image's time t is that of its middle. 0: all at once.
        left_to_right: the shutter rolls over the columns, from the left, instead of the rows from the top.
        exposure: how the brightness changes; None: it does not.

    Raises:
        OptionError: `supersampling` is not 1 to 8, or `readout_ns` not 0 to 0.1 s.
        CalibrationError: the camera model is unknown.
    """

    camera: Camera = field(default=Camera("pinhole", 1242, 375, 720.0, 720.0, 620.5, 187.0))
    mount: RigidTransform = field(default_factory=lambda: camera_mount(yaw_deg=-0.4, pitch_deg=0.6, roll_deg=0.2))
    offset_ns: int = 50_000_000
    supersampling: int = 1
    readout_ns: int = 0
    left_to_right: bool = False
    exposure: ExposureSpec | None = None

    def __post_init__(self) -> None:
        check_camera(self.camera)
        check_bounds("camera", self, supersampling=(1, 8), readout_ns=(0, _LONGEST_READOUT_NS))

    @property
    def line_count(self) -> int:
        """How many lines (rows or columns) the shutter takes one after the other; 1 where it takes all at once."""
        if self.readout_ns == 0:
            return 1
        return self.camera.width if self.left_to_right else self.camera.height

    def line_offsets_ns(self) -> Int64Array:
        """When each line is taken, (L,) int64 [ns], after the image's time.

        Source: "Time" in docs/CONVENTIONS.md: row r of H at t + ((r + 0.5)/H - 0.5)·roll time.
        """
        share = (np.arange(self.line_count) + 0.5) / self.line_count - 0.5
        offsets: Int64Array = np.rint(share * self.readout_ns).astype(np.int64)
        return offsets


@dataclass(frozen=True, slots=True, eq=False)
class ImageTruth:
    """What a camera sees along the rays through the pixels' centres.

    With a rolling shutter each line is as seen at the line's own time, from where the camera is then.

    Attributes:
        depths: (H, W) float32 [m], z in the camera frame, 0 for the sky and outside the camera model.
        instances: (H, W) int32, 0 the ground, -1 the sky and outside the camera model.
        colors: (H, W, 3) uint8; equal to the image where `supersampling` is 1 and nothing changes the exposure.
    """

    depths: Float32Array
    instances: AnyArray
    colors: UInt8Array


@dataclass(frozen=True, slots=True, eq=False)
class RenderedCamera:
    """A camera on its way through a street.

    Attributes:
        spec: the device.
        street, path: what it sees and how it moves.
        timestamps_ns: (F,) int64 [ns], time of each image.
        rays: the rays through the pixels' centres; the pose of a ray is its line's.
        between: further sets of rays, for supersampling.
        exposure: how the images' brightness changes; None: it does not.
    """

    spec: CameraSpec
    street: Street
    path: EgoPath
    timestamps_ns: Int64Array
    rays: Rays
    between: tuple[Rays, ...]
    exposure: Exposure | None = None

    @classmethod
    def of(
        cls,
        spec: CameraSpec,
        street: Street,
        path: EgoPath,
        *,
        timestamps_ns: Int64Array,
        seed: int = 0,
        number: int = 0,
    ) -> "RenderedCamera":
        """Set up the rays of an image, and draw the exposure of camera `number` of the drive."""
        steps = (np.arange(spec.supersampling) + 0.5) / spec.supersampling - 0.5
        between = tuple(_pixel_rays(spec, du, dv) for dv in steps for du in steps if spec.supersampling > 1)
        exposure = None
        if spec.exposure is not None:
            exposure = Exposure.of(spec.exposure, start_ns=path.start_ns, seed=seed, camera=number)
        return cls(spec, street, path, timestamps_ns, _pixel_rays(spec, 0.0, 0.0), between, exposure)

    def pose(self, k: int) -> RigidTransform:
        """Exact `world_from_camera` at the time of image k."""
        ego = self.path.at(self.timestamps_ns[k : k + 1])
        return RigidTransform(ego.rotations[0], ego.positions[0]) @ self.spec.mount

    def line_times_ns(self, k: int) -> Int64Array:
        """When each line of image k is taken, (L,) int64 [ns]; a single time where all are taken at once."""
        times_ns: Int64Array = self.timestamps_ns[k] + self.spec.line_offsets_ns()
        return times_ns

    def line_poses(self, k: int) -> tuple[Float64Array, Float64Array]:
        """Exact `world_from_camera` at each line's time: (L, 3, 3) rotations and (L, 3) positions [m]."""
        return self.path.mounted(self.line_times_ns(k), self.spec.mount)

    def lines_seeing(self, k: int, points_world: Float64Array) -> Int64Array:
        """Find which line of image k sees each stationary point, (N,) int64; the middle one for points far outside.

        Args:
            points_world: (N, 3) float64 [m].
        """
        count = self.spec.line_count
        lines = np.full(len(points_world), count // 2, np.int64)
        if count == 1:
            return lines
        rotations, origins = self.line_poses(k)
        wider, border = _with_border(self.spec.camera)
        for _ in range(LINE_ROUNDS):
            in_camera = np.einsum("nji,nj->ni", rotations[lines], points_world - origins[lines])
            pixels, inside = project(wider, in_camera)
            across = pixels[inside, 0 if self.spec.left_to_right else 1] - border
            lines[inside] = np.clip(np.rint(across), 0, count - 1).astype(np.int64)
        return lines

    def gain(self, k: int) -> float:
        """By what image k is brighter than the bare colours, in its middle."""
        return 1.0 if self.exposure is None else self.exposure.gain(int(self.timestamps_ns[k]))

    def image(self, k: int) -> CameraImage:
        """Image k, rendered when its pixels are asked for."""
        exposure_ns = 0 if self.spec.exposure is None else self.spec.exposure.exposure_ns
        extras = {_EXPOSURE_FIELD: exposure_ns / 1e9} if exposure_ns else NO_FIELDS
        return CameraImage(int(self.timestamps_ns[k]), self.spec.camera, partial(self.render, k), extras=extras)

    def render(self, k: int) -> UInt8Array:
        """Render image k, (H, W, 3) uint8, with the camera's exposure."""
        rgb = self._bare(k)
        return rgb if self.exposure is None else self.exposure.applied(rgb, int(self.timestamps_ns[k]))

    def _bare(self, k: int) -> UInt8Array:
        """Image k in the colours of what is there."""
        shape = (self.spec.camera.height, self.spec.camera.width, 3)
        sets = self.between or (self.rays,)
        total = np.zeros(shape, np.uint16)
        for rays in sets:
            total += self._look(k, rays)[1].colors.reshape(shape)
        return ((total + len(sets) // 2) // len(sets)).astype(np.uint8)

    def truth(self, k: int) -> ImageTruth:
        """Render the truth of image k."""
        shape = (self.spec.camera.height, self.spec.camera.width)
        hits, look = self._look(k, self.rays)
        depths = np.zeros(self.rays.slot_count, np.float32)
        depths[self.rays.slots] = hits.ranges[self.rays.slots] * self.rays.directions[:, 2]
        instances = instances_of(self.street, hits).reshape(shape)
        return ImageTruth(depths.reshape(shape), instances, look.colors.reshape(*shape, 3))

    def silhouettes(self, k: int) -> Int64Array:
        """Count the pixels of image k that each object would fill if it were alone, by instance number - 1."""
        return silhouettes(self.street, self.rays, *self.line_poses(k), self.line_times_ns(k), reach=_REACH)

    def _look(self, k: int, rays: Rays) -> tuple[Hits, Paint]:
        rotations, origins = self.line_poses(k)
        angle = 1.0 / (max(1, self.spec.supersampling) * min(self.spec.camera.fx, self.spec.camera.fy))
        hits = cast(self.street, rays, rotations, origins, self.line_times_ns(k), reach=_REACH)
        return hits, paint(self.street, rays, rotations, origins, hits, pixel_angle=angle)


def _pixel_rays(spec: CameraSpec, du: float, dv: float) -> Rays:
    """Rays through all pixels, (du, dv) beside their centres, bundled by tiles; slots count along the rows."""
    camera = spec.camera
    v, u = (grid.ravel() for grid in np.mgrid[: camera.height, : camera.width])
    directions: Float64Array = unproject(camera, np.column_stack([u + du, v + dv]))
    tiles = (v // _TILE * camera.width + u // _TILE).astype(np.int64)
    line = None if spec.line_count == 1 else (u if spec.left_to_right else v).astype(np.int64)
    return Rays.bundled(directions, tiles, pose_of_ray=line)


def _with_border(camera: Camera) -> tuple[Camera, int]:
    """The camera model of an image with a border all around, and how wide that is [px].

    A point that moves into the image while it is read lies outside at some lines' times.
    """
    border = max(camera.width, camera.height) // 2
    wider = replace(
        camera,
        width=camera.width + 2 * border,
        height=camera.height + 2 * border,
        cx=camera.cx + border,
        cy=camera.cy + border,
    )
    return wider, border
