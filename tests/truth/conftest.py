"""Drives that are written as recordings, opened again, fused and written as scenes, with the truth beside them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.pipeline import FusionOutputs, fuse
from sceneloom.scene import CameraSensor, LidarSensor, Scene
from sceneloom.simulate import CameraSpec, ImageTruth, SimulatedDrive, camera_mount, simulate_street
from sceneloom.simulate.drive import CleanPoints, edge_mask

PINHOLE = Camera("pinhole", 960, 360, 700.0, 700.0, 479.5, 179.5)
FISHEYE = Camera("fisheye", 640, 400, 250.0, 250.0, 319.5, 190.0, (0.03, -0.008, 0.002, -0.0004))
BROWN = Camera("brown_conrady", 800, 400, 430.0, 430.0, 399.5, 190.0, (-0.12, 0.04, 0.0004, -0.0003, -0.006))

ASIDE = {"position": (0.35, 0.45, 1.6), "yaw_deg": 62.0, "pitch_deg": 2.0, "roll_deg": 1.0}
CAMERAS = (
    CameraSpec(PINHOLE, camera_mount(yaw_deg=-0.4, pitch_deg=0.6)),
    CameraSpec(FISHEYE, camera_mount(**ASIDE), 20_000_000),
    # Taken after the middle of its sweep by more than half a period: the sweep's nearest image is the one before.
    CameraSpec(BROWN, camera_mount(position=(0.3, -0.45, 1.6), yaw_deg=-58.0), 107_000_000),
)
"""Three camera models whose images overlap, none taken at the same time as another."""

SEEDS = (0, 7)
"""Streets where the ego rotates, to the right and to the left, and gathers speed while the sweeps below are taken."""
SWEEPS = range(7, 9)
"""The sweeps that are used."""

Decoder = Callable[[bytes], dict[str, Any]]


@dataclass(frozen=True)
class Seen:
    """What is true of the points of one sweep in the image that it belongs to."""

    image: int  # its number in the whole drive
    pixels: np.ndarray  # (N, 2), where OpenCV and the exact poses put the points; far outside for those behind
    depths: np.ndarray  # (N,) [m], z
    free: np.ndarray  # (N,) in the image, and nothing stands before it
    counted: np.ndarray  # (N,) in the image, a pixel from its border and 2 px from outlines at least
    truth: ImageTruth  # what the camera sees


def project_with_opencv(camera: Camera, points_camera: np.ndarray) -> np.ndarray:
    """Pixels (N, 2); -1000 for points beside and behind the camera."""
    camera_model = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    coefficients = np.array(camera.coefficients or (0.0,) * 4)
    zero, pixels = np.zeros(3), np.full((len(points_camera), 2), -1000.0)
    # Far off the axis polynomials come back into the image; the camera models above see 50 and 90 degrees at most.
    least = 0.01 if camera.model == "fisheye" else 0.5
    ahead = np.flatnonzero(points_camera[:, 2] > least * np.linalg.norm(points_camera, axis=1))
    points = points_camera[ahead][:, None]
    if camera.model == "fisheye":
        pixels[ahead] = cv2.fisheye.projectPoints(points, zero, zero, camera_model, coefficients)[0][:, 0]
    else:
        pixels[ahead] = cv2.projectPoints(points, zero, zero, camera_model, coefficients)[0][:, 0]
    return pixels


class Truths:
    """What is true of some sweeps of a drive, found when asked for and then kept."""

    def __init__(self, drive: SimulatedDrive, sweeps: range) -> None:
        self._drive, self._sweeps = drive, sweeps
        self._cleans: dict[int, CleanPoints] = {}
        self._seen: dict[tuple[str, int], Seen] = {}

    def clean(self, sweep: int) -> CleanPoints:
        """Where the points of a sweep come from."""
        if sweep not in self._cleans:
            self._cleans[sweep] = self._drive.truth.clean_points_world(sweep)
        return self._cleans[sweep]

    def nearest_image(self, camera_id: str, sweep: int) -> int:
        """The number of the recorded image nearest to the median time of a sweep's points."""
        times = self._drive.truth.cameras[camera_id].timestamps_ns[self._sweeps.start : self._sweeps.stop]
        reference = np.median(self._drive.truth.sweep(sweep).frame.points.timestamps_ns)
        return self._sweeps.start + int(np.argmin(np.abs(times - reference)))

    def seen(self, camera_id: str, sweep: int) -> Seen:
        """The truth about a sweep in the image that belongs to it."""
        if (camera_id, sweep) not in self._seen:
            self._seen[camera_id, sweep] = self._look(camera_id, sweep)
        return self._seen[camera_id, sweep]

    def _look(self, camera_id: str, sweep: int) -> Seen:
        truth, image = self._drive.truth, self.nearest_image(camera_id, sweep)
        camera, points_world = truth.cameras[camera_id].spec.camera, self.clean(sweep).positions_world
        points_camera = truth.world_from_camera(camera_id, image).inverse().apply(points_world)
        pixels = project_with_opencv(camera, points_camera)
        inside = ((pixels >= 0.5) & (pixels <= np.array([camera.width, camera.height]) - 1.5)).all(axis=1)
        pictured = truth.image(camera_id, image)
        column, row = np.rint(pixels[inside]).astype(int).T
        counted, free = np.zeros(len(inside), bool), np.zeros(len(inside), bool)
        counted[inside] = ~edge_mask(pictured)[row, column]
        free[inside] = truth.visible(camera_id, image, points_world[inside])
        return Seen(image, pixels, points_camera[:, 2], free, counted, pictured)


@dataclass(frozen=True)
class FusedDrive:
    """A drive after its trajectory over the disk."""

    drive: SimulatedDrive  # scene and truth of the whole drive
    recording: Path
    content: dict[str, Any]  # the written scene, as a reader that shares nothing with ours decodes it
    depth: Path  # folder of the depth images
    sweeps: range  # numbers in the whole drive
    truths: Truths  # what is true of them

    def sensor(self, sensor_id: str) -> dict[str, Any]:
        """A sensor of the file."""
        return next(sensor for sensor in self.content["sensors"] if sensor["id"] == sensor_id)

    @property
    def camera_ids(self) -> list[str]:
        """The cameras in the order that `camera_index` counts."""
        return self.content["metadata"]["sceneloom"]["fusion"]["cameras"]

    @property
    def world_from_file(self) -> np.ndarray:
        """(4, 4)."""
        return np.array(self.content["metadata"]["sceneloom"]["world_from_file"])

    def to_world(self, points_file: np.ndarray) -> np.ndarray:
        """Take points of the file into the world of the truth."""
        return np.asarray(points_file, float) @ self.world_from_file[:3, :3].T + self.world_from_file[:3, 3]

    def points(self, sweep: int) -> dict[str, np.ndarray]:
        """The points of a sweep as the file has them."""
        return self.sensor("lidar")["frames"][sweep - self.sweeps.start]["points"]

    def time_ns(self, file_time: Any) -> Any:
        """A time of the file on the truth's clock [ns]."""
        return (np.asarray(file_time, np.int64) + self.content["time_offset"]) * 1000


def cut(scene: Scene, sweeps: range) -> Scene:
    """Some sweeps of a scene, and each camera's images of these."""

    def part(sensor: Any) -> Any:
        if isinstance(sensor, LidarSensor):
            return replace(sensor, frames=sensor.frames[sweeps.start : sweeps.stop])
        if isinstance(sensor, CameraSensor):
            return replace(sensor, images=sensor.images[sweeps.start : sweeps.stop])
        return sensor

    return replace(scene, sensors=tuple(part(sensor) for sensor in scene.sensors))


@pytest.fixture(scope="session")
def take_over_disk(tmp_path_factory: pytest.TempPathFactory, decode_sfs: Decoder) -> Callable[..., FusedDrive]:
    """Write some sweeps as a recording, open it, add the boxes that recordings cannot hold, fuse it, read the file."""

    def take(drive: SimulatedDrive, sweeps: range, *, images: str, truths: Truths | None = None) -> FusedDrive:
        folder = tmp_path_factory.mktemp(images)
        recording, target, depth = folder / "drive", folder / "drive.sfs", folder / "depth"
        sceneloom.write(cut(drive.scene, sweeps), recording, images=images)
        with sceneloom.open(recording) as scene:
            boxed = replace(scene, annotations=drive.scene.annotations, metadata=drive.scene.metadata)
            report = fuse(boxed, outputs=FusionOutputs(scene=target, depth=depth, depth_format="npz"))
        assert report.fused == len(sweeps)
        content = decode_sfs(target.read_bytes())
        return FusedDrive(drive, recording, content, depth, sweeps, truths or Truths(drive, sweeps))

    return take


@pytest.fixture(scope="session")
def with_png(take_over_disk: Callable[..., FusedDrive]) -> list[FusedDrive]:
    """Two drives after a trajectory over recordings with PNG images, which lose nothing."""
    drives = [simulate_street(seed, frames=SWEEPS.stop + 2, cameras=CAMERAS) for seed in SEEDS]
    return [take_over_disk(drive, SWEEPS, images="png") for drive in drives]


@pytest.fixture(scope="session")
def with_h264(with_png: list[FusedDrive], take_over_disk: Callable[..., FusedDrive]) -> list[FusedDrive]:
    """The same drives after a trajectory over recordings with H.264 videos."""
    return [take_over_disk(png.drive, SWEEPS, images="h264", truths=png.truths) for png in with_png]
