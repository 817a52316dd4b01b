"""All images of a fused lidar frame: as files in a folder, or side by side on one sheet."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import OptionError, OutputError
from sceneloom.formats.file_names import file_stem, file_stems
from sceneloom.formats.output import replacing
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.images.canvas import Canvas, PilImage, seconds_text
from sceneloom.images.cloud_above import draw_cloud_above
from sceneloom.images.cloud_perspective import draw_cloud_perspective
from sceneloom.images.ego import find_ego
from sceneloom.images.views import draw_depth_image, draw_overlay, view_scale
from sceneloom.scene.poses import Poses

_COMPRESSION = 2
"""Higher levels of PNG make these images 3 % smaller and take three times as long."""


def iter_images(
    frame: FusedFrame,
    index: int,
    *,
    ego_poses: Poses | None = None,
    show_hidden: bool = False,
) -> Iterator[tuple[str, Callable[[], PilImage]]]:
    """Name each image of a frame and state how to draw it.

    Args:
        index: number of the frame, part of the names.
        ego_poses: the ego trajectory through the world; by default the position of the first camera stands in.
        show_hidden: mark hidden points in the overlays.

    Yields:
        A file name without suffix, unique within the frame, and a function that draws.
    """
    stems = file_stems(view.camera_id for view in frame.views)
    for view, stem in zip(frame.views, stems, strict=True):
        scale = view_scale(view)
        yield f"{stem}_{index:06d}_overlay", partial(draw_overlay, view, scale=scale, show_hidden=show_hidden)
        yield f"{stem}_{index:06d}_depth", partial(draw_depth_image, view, scale=scale)
    title = f"{frame.lidar_id} · {seconds_text(frame.timestamp_ns)}"
    ego_path = None if ego_poses is None else ego_poses.positions
    ego = find_ego(_ego_at(ego_poses, frame.reference_ns), ego_path, frame.views)
    points = frame.points
    stem = f"cloud_{file_stem(frame.lidar_id)}_{index:06d}"
    for name, draw in (("above", draw_cloud_above), ("perspective", draw_cloud_perspective)):
        cloud = partial(draw, points.positions, points.colors, camera_index=points.camera_index)
        yield f"{stem}_{name}", partial(cloud, ego=ego, ego_path=ego_path, caption=[title])


def save_images(
    frame: FusedFrame,
    folder: Path,
    index: int,
    *,
    ego_poses: Poses | None = None,
    show_hidden: bool = False,
    overwrite: bool = False,
) -> list[Path]:
    """Draw all images of a frame into a folder, which is made where it is missing.

    For each view `<camera>_<index>_overlay.png` and `..._depth.png`; for the frame `cloud_<lidar>_<index>_above.png`
    and `..._perspective.png`. What a file name cannot hold of an id is written as %XX.

    Args:
        index: number of the frame, six digits in the names.
        ego_poses: the ego trajectory through the world; by default the position of the first camera stands in.
        show_hidden: mark hidden points in the overlays.
        overwrite: replace files that are there.

    Returns:
        The paths written.

    Raises:
        OutputError: a file exists or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made: {error.strerror}") from error
    plots = iter_images(frame, index, ego_poses=ego_poses, show_hidden=show_hidden)
    return [save_image(draw(), folder / f"{name}.png", overwrite=overwrite) for name, draw in plots]


def contact_sheet(images: Sequence[PilImage], *, columns: int = 2, width_px: int = 1600) -> PilImage:
    """Put images side by side in rows on one sheet, each scaled to its column.

    Args:
        columns: images in a row; the last row may have fewer.
        width_px: width of the sheet.

    Raises:
        OptionError: no image, no column, or no room for one.
    """
    gap = max(2, width_px // 160)
    cell = (width_px - gap * (columns + 1)) // max(columns, 1)
    if not images or columns < 1 or cell < 1:
        raise OptionError(f"sheet of {len(images)} images in {columns} columns on {width_px} px; no room")
    scaled = [image.resize((cell, max(1, round(image.height * cell / image.width)))) for image in images]
    rows = [scaled[start : start + columns] for start in range(0, len(scaled), columns)]
    heights = [max(image.height for image in row) for row in rows]
    sheet = Canvas.blank(width_px, sum(heights) + gap * (len(rows) + 1), text_px=12)
    top = gap
    for row, height in zip(rows, heights, strict=True):
        for number, image in enumerate(row):
            sheet.image.paste(image, (gap + number * (cell + gap), top))
        top += height + gap
    return sheet.image


def _ego_at(ego_poses: Poses | None, timestamp_ns: int) -> RigidTransform | None:
    """Give `world_from_ego` at a time; beyond the path's ends the pose of the nearer end."""
    if ego_poses is None:
        return None
    pose = ego_poses.held(np.array([timestamp_ns], np.int64))
    return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])


def save_image(image: PilImage, path: Path, *, overwrite: bool = False) -> Path:
    """Write an image as PNG, whole or not at all; gives the path.

    Raises:
        OutputError: the file exists or cannot be written.
    """
    with replacing(path, overwrite=overwrite) as draft:
        image.save(draft, "PNG", compress_level=_COMPRESSION)
    return path
