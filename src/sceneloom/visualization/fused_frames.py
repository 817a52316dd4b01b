"""Visualisations of fused lidar frames: points over the image, depth images sparse and dense, contact sheets.

And the accumulated cloud of a drive.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sceneloom.arrays import Float32Array, UInt8Array
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.editing.thin import FIRST, one_per_cube
from sceneloom.errors import OptionError, OutputError
from sceneloom.formats.base.output import file_stem, file_stems, replacing
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.poses import Poses
from sceneloom.visualization.canvas import Canvas, PilImage, draw_crosses, draw_discs, leave_out, seconds_text, several
from sceneloom.visualization.clouds import UNSEEN, draw_cloud_above, draw_cloud_perspective, find_ego
from sceneloom.visualization.colour_scales import DepthScale, framed, image_canvas

if TYPE_CHECKING:
    from sceneloom.colouring.depth_completion import DenseDepth  # imports the compiler

NO_DEPTH = (10, 11, 14)
"""Colour of the pixels of a depth image that hold no depth: darker than any colour of the maps."""
_HIDDEN = (176, 178, 184)
_LARGEST_RADIUS_PX = 4.0
_MOST_COVER = 0.35  # share of the image that the discs may cover together, so that the image can be seen between them
_GREYNESS = 0.45
_BRIGHTNESS = 0.62
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def draw_overlay(view: FusedView, *, scale: DepthScale | None = None, show_hidden: bool = False) -> PilImage:
    """Draw the points over the image as discs coloured by depth, the nearer over the farther.

    Args:
        scale: the colours of the depths; by default chosen to hold the view's own depths.
        show_hidden: mark the points behind nearer surfaces with small grey crosses.

    Returns:
        The image, its pixels where they were, with a strip of caption and scale bar below it.
    """
    used = scale or view_scale(view)
    drawn = subdued(view.rgb)
    if show_hidden:
        drawn = draw_crosses(drawn, view.pixels[~view.visible], _HIDDEN, arm_px=round(_disc_radius(view)))
    depths = view.depths[view.visible]
    radius = _disc_radius(view)
    drawn = draw_discs(drawn, view.pixels[view.visible], depths, used.colours(depths), radius)
    hidden = len(view.depths) - len(depths)
    counts = f"{several(len(depths), 'point')}, {hidden:,} more hidden" + (" (crosses)" if show_hidden else "")
    return framed(image_canvas(drawn), [_title(view), counts], scale=used)


def draw_depth_image(view: FusedView, *, scale: DepthScale | None = None) -> PilImage:
    """Draw the depth image, each depth enlarged to a small disc; nearly black where there is none.

    Args:
        scale: the colours of the depths; by default chosen to hold the view's own depths.

    Returns:
        The depth image, its pixels where they were, with a strip of caption and scale bar below it.
    """
    used = scale or view_scale(view)
    rows, columns = np.nonzero(view.depth_image > 0)
    depths: Float32Array = view.depth_image[rows, columns]
    empty: UInt8Array = np.full((*view.depth_image.shape, 3), NO_DEPTH, np.uint8)
    pixels = np.column_stack([columns, rows]).astype(np.float32)
    drawn = draw_discs(empty, pixels, depths, used.colours(depths), max(1.0, _disc_radius(view)))
    share = 100.0 * len(depths) / view.depth_image.size
    counts = f"{several(len(depths), 'pixel')} with depth, {share:.2g} %"
    return framed(image_canvas(drawn), [_title(view), counts], scale=used)


def view_scale(view: FusedView) -> DepthScale:
    """Choose the depth scale that suits the visible points of a view."""
    return DepthScale.of(view.depths[view.visible])


def _disc_radius(view: FusedView) -> float:
    """Choose the radius of the discs [px], in half pixels: larger on larger images, smaller for dense points."""
    width, height = view.camera.width, view.camera.height
    by_size = min(width / 950.0, _LARGEST_RADIUS_PX)
    by_density = np.sqrt(_MOST_COVER * width * height / (np.pi * max(len(view.depths), 1)))
    return float(max(round(2 * min(max(by_size, 1.0), by_density)) / 2, 0.5))


def _title(view: FusedView) -> str:
    return f"{view.camera_id} · {seconds_text(view.timestamp_ns)}"


def subdued(rgb: UInt8Array) -> UInt8Array:
    """Take colour and brightness off an image, so that what is drawn over it stands out."""
    grey = (rgb @ _LUMA)[..., None]
    return np.asarray(_BRIGHTNESS * (_GREYNESS * grey + (1.0 - _GREYNESS) * rgb.astype(np.float32)), np.uint8)


def draw_dense_depth(view: FusedView, dense: "DenseDepth") -> PilImage:
    """Draw a completed depth image below its image, and its confidence below it: black 0, white 1.

    Args:
        dense: what was made of it.
    """
    scale = view_scale(view)
    known = dense.depths > 0
    depths: UInt8Array = np.full((*dense.depths.shape, 3), NO_DEPTH, np.uint8)
    depths[known] = scale.colours(dense.depths[known])
    grey = np.rint(dense.confidence * 255).astype(np.uint8)
    sheet = np.concatenate([view.rgb, depths, np.repeat(grey[..., None], 3, axis=2)])
    share, sure = 100.0 * known.mean(), 100.0 * (dense.confidence >= 0.9).mean()
    lines = [
        f"{view.camera_id} · {seconds_text(view.timestamp_ns)}",
        f"{share:.1f} % with depth, {sure:.1f} % surer than 0.9",
    ]
    return framed(image_canvas(sheet), lines, scale=scale)


_COMPRESSION = 2  # higher levels of PNG make these images 3 % smaller and take three times as long


def iter_images(
    frame: FusedFrame, index: int, *, ego_poses: Poses | None = None, show_hidden: bool = False
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
    world_from_ego = None
    if ego_poses is not None:  # beyond the path's ends the pose of the nearer end
        pose = ego_poses.held(np.array([frame.reference_ns], np.int64))
        world_from_ego = RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])
    ego = find_ego(world_from_ego, ego_path, frame.views)
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


def save_image(image: PilImage, path: Path, *, overwrite: bool = False) -> Path:
    """Write an image as PNG, whole or not at all; gives the path.

    Raises:
        OutputError: the file exists or cannot be written.
    """
    with replacing(path, overwrite=overwrite) as draft:
        image.save(draft, "PNG", compress_level=_COMPRESSION)
    return path


CUBE = 0.04
"""Of each sweep, one point per cube of this side is kept [m]: more shows in no image."""
MOST_SWEEPS = 40
"""Sweeps of one lidar that are gathered, spread over the drive: enough for an image, bounded for any drive."""
_MARGIN = 25.0  # around the trajectory of the ego, so much of its surroundings is shown [m]


@dataclass(slots=True)
class DriveCloud:
    """Gathers the fused sweeps of some numbers and draws them together."""

    chosen: frozenset[int]
    _parts: list[tuple[Float32Array, UInt8Array, UInt8Array]] = field(default_factory=list)

    def add(self, frame: FusedFrame) -> None:
        """Take a sweep if it is chosen, thinned; points with a colour go before those without."""
        if frame.index not in self.chosen or frame.unfused is not None or len(frame.points) == 0:
            return
        points = frame.points
        count = len(points)
        colors = np.full((count, 3), 255, np.uint8) if points.colors is None else points.colors
        seen_by = np.full(count, UNSEEN, np.uint8) if points.camera_index is None else points.camera_index
        rows = np.flatnonzero(np.isfinite(points.positions).all(axis=1))
        leave_out("points", count - len(rows))
        rows = rows[np.argsort(seen_by[rows] == UNSEEN, kind="stable")]
        rows = rows[one_per_cube(points.positions[rows], CUBE, keep=FIRST)]
        self._parts.append((points.positions[rows], colors[rows], seen_by[rows]))

    def save(self, folder: Path, ego_poses: Poses | None) -> list[Path]:
        """Draw the cloud as `draw` does into `cloud_drive_above.png` and `cloud_drive_perspective.png`; give the paths.

        Raises:
            OutputError: a file exists or cannot be written.
        """
        images = self.draw(ego_poses)
        return [save_image(image, folder / f"cloud_drive_{name}.png") for name, image in images.items()]

    def draw(self, ego_poses: Poses | None) -> dict[str, PilImage]:
        """Draw the cloud "above" and in "perspective"; nothing where fewer than two sweeps were gathered.

        Args:
            ego_poses: the ego trajectory; the eye stands behind it, where half of it is done.
        """
        if len(self._parts) < 2:
            return {}
        positions, colors, camera_index = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        trajectory, pose, reach = None, None, None
        if ego_poses is not None:
            steps = np.linalg.norm(np.diff(ego_poses.positions, axis=0), axis=1)
            done = np.concatenate([[0.0], np.cumsum(steps)])
            row = int(np.searchsorted(done, done[-1] / 2))
            pose = RigidTransform.from_quaternion(ego_poses.positions[row], ego_poses.quaternions_xyzw[row])
            if not ego_poses.static:
                trajectory = ego_poses.positions
            if trajectory is not None and len(trajectory) > 1:  # all of it is on the map
                middle = trajectory[int(np.searchsorted(done[1:], done[-1] / 2))]
                reach = float(np.abs(trajectory[:, :2] - middle[:2]).max()) + _MARGIN
        ego = find_ego(pose, trajectory, ())
        caption = [f"{several(len(self._parts), 'sweep')} of the drive together"]
        above, perspective = (
            partial(draw, positions, colors, camera_index=camera_index, ego=ego, ego_path=trajectory, caption=caption)
            for draw in (draw_cloud_above, draw_cloud_perspective)
        )
        return {"above": above(reach=reach), "perspective": perspective()}
