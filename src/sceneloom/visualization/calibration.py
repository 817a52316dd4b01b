"""Images to judge a calibration by: points by range, and the edges of the sweep, over the image."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.health import CalibrationHealth
from sceneloom.calibrate.measures import Change, Parameter, extract
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.formats.base.output import filling
from sceneloom.visualization.canvas import PilImage, draw_discs, seconds_text
from sceneloom.visualization.colour_scales import DepthScale
from sceneloom.visualization.fused_frames import framed, image_canvas, save_image, subdued

MOST_DRAWN = 3
"""Frames that are drawn, evenly spread."""


def save_calibration_images(
    frames: Sequence[CalibrationFrame], health: CalibrationHealth, folder: Path, *, overwrite: bool = False
) -> list[Path]:
    """Draw frames under the stated calibration, and under the best one where it was found, into a folder.

    `points_<number>.png` and `edges_<number>.png`, by number of the image, and with `_best` before the suffix the
    same where images and sweeps agree best.

    Returns:
        The paths written.

    Raises:
        OutputError: the folder has something in it and `overwrite` is not stated, or it cannot be written.
    """
    return save_change_images(frames, Change(health.change), folder, overwrite=overwrite)


def save_change_images(
    frames: Sequence[CalibrationFrame], best: Change, folder: Path, *, overwrite: bool = False
) -> list[Path]:
    """Draw frames under the stated calibration and, where that is another one, under the best.

    Raises:
        OutputError: the folder has something in it and `overwrite` is not stated, or it cannot be written.
    """
    rows = np.unique(np.linspace(0, len(frames) - 1, min(MOST_DRAWN, len(frames))).astype(int)).tolist()
    changes = {"": Change()}
    if any(best.numbers):
        changes["_best"] = best
    written = []
    with filling(folder, overwrite=overwrite) as drafts:
        for frame in (frames[row] for row in rows):
            edges = extract(frame).edge_points
            for suffix, change in changes.items():
                under = "best" if suffix else "stated"
                for name, points in (("points", frame.points_lidar), ("edges", edges)):
                    written.append(f"{name}_{frame.index:06d}{suffix}.png")
                    drawn = draw_points(frame, points, change, f"{name} of the sweep, {under} calibration")
                    save_image(drawn, drafts / written[-1])
    return [folder / name for name in written]


def draw_points(
    frame: CalibrationFrame, points_lidar: Float64Array, change: Change, caption: str
) -> PilImage:
    """Draw points of a frame over its image under a candidate calibration, coloured by range.

    Args:
        points_lidar: (N, 3) [m], lidar frame at the image's time.
        change: what the candidate changes of the stated calibration.
        caption: stands below the image.
    """
    matrix = change.camera_from_points(frame)
    points_camera = points_lidar @ matrix[:3, :3].T + matrix[:3, 3]
    pixels, inside = project(_camera_model(frame.camera, change), points_camera)
    ranges: FloatArray = np.linalg.norm(points_camera[inside], axis=1)
    scale = DepthScale.of(ranges)
    radius = max(frame.camera.width / 900.0, 1.0)
    drawn = draw_discs(subdued(frame.rgb), pixels[inside], ranges, scale.colours(ranges), radius)
    title = f"{frame.camera_id} · {seconds_text(frame.image_ns)}"
    return framed(image_canvas(drawn), [title, caption], scale=scale)


def _camera_model(camera: Camera, change: Change) -> Camera:
    scale = float(np.exp(change.numbers[Parameter.FOCAL]))
    return Camera(
        camera.model, camera.width, camera.height, camera.fx * scale, camera.fy * scale, camera.cx, camera.cy,
        camera.coefficients,
    )  # fmt: skip
