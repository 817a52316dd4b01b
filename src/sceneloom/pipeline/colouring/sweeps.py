"""One sweep after another with colours, labels and their provenance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, UInt8Array, UInt16Array
from sceneloom.colouring.blending import blend_colours
from sceneloom.colouring.exposure import ExposureGains
from sceneloom.colouring.labels import paint_labels
from sceneloom.colouring.normals import estimate_normals
from sceneloom.colouring.provenance import PointSources
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.colouring.weights import BlendSettings, view_weights
from sceneloom.colouring.world_map import empty_points
from sceneloom.formats.label_folders import LabelFolder
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

NO_IMAGE = -1


@dataclass(frozen=True, slots=True, eq=False)
class ColouredSweep:
    """A fused sweep without its images, and its points as rows of a map.

    Attributes:
        frame: the sweep with its new colours; `views` are left out, which hold whole images.
        points: (N,) of dtype `POINT`.
    """

    frame: FusedFrame
    points: AnyArray


@dataclass(slots=True)
class SweepColouring:
    """Colours sweeps.

    Attributes:
        scene: what the images are of, as read: their numbers are those in its cameras.
        blend: "nearest", "best" or "weighted".
        gains: what evens out the exposures; None: they stay.
        labels: label images; None for none.
    """

    scene: Scene
    blend: str
    gains: ExposureGains | None = None
    labels: LabelFolder | None = None
    _cameras: dict[Identifier, tuple[int, CameraSensor]] = field(default_factory=dict)
    _numbers: dict[Identifier, Mapping[int, int]] = field(default_factory=dict)
    _images: dict[Identifier, tuple[int, UInt16Array | None]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._cameras = {camera.id: (k, camera) for k, camera in enumerate(self.scene.cameras)}
        for camera in self.scene.cameras:
            timestamps = camera.images.timestamps_ns.tolist()
            self._numbers[camera.id] = {time_ns: k for k, time_ns in reversed([*enumerate(timestamps)])}

    def indices(self, views: Sequence[FusedView]) -> list[int]:
        """The numbers of the cameras of views among the scene's."""
        return [self._cameras[view.camera_id][0] for view in views]

    def number(self, view: FusedView) -> int:
        """The number of a view's image in its camera."""
        return self._numbers[view.camera_id].get(view.timestamp_ns, NO_IMAGE)

    def colour(self, frame: FusedFrame) -> ColouredSweep:
        """Give a fused sweep its colours and labels.

        Raises:
            DataError: a label image cannot be read, or has another size than its image.
        """
        points_world = _points_of(frame)
        times = frame.points.timestamps_ns
        colors, sources = self._colours(frame, points_world, times)
        points = empty_points(len(points_world))
        points["position"] = points_world
        points["color"], points["weight"] = colors, sources.weights
        points["camera"], points["pixel"] = sources.camera_index, sources.pixels
        for view in frame.views:
            of_view = sources.camera_index == self._cameras[view.camera_id][0]
            points["image"][of_view] = self.number(view)
        if frame.points.intensities is not None:
            points["intensity"] = frame.points.intensities
        points["time_ns"] = frame.timestamp_ns if times is None else times
        if self.labels is not None:
            images = [self._label_image(view, self.labels) for view in frame.views]
            points["label"] = paint_labels(points_world, frame.views, images, timestamps_ns=times)
        coloured = replace(frame.points, colors=colors, camera_index=sources.camera_index)
        return ColouredSweep(replace(frame, points=coloured, views=()), points)

    def _colours(
        self, frame: FusedFrame, points_world: Float64Array, times: Int64Array | None
    ) -> tuple[UInt8Array, PointSources]:
        indices = self.indices(frame.views)
        gains = {} if self.gains is None else self.gains.for_views(frame.views, indices)
        if self.blend == "nearest":
            return _nearest(frame, indices, gains, points_world, times)
        normals = None
        if frame.views:
            eyes = [view.world_from_camera.translation for view in frame.views]
            normals = estimate_normals(points_world, np.mean(eyes, axis=0))
        settings = BlendSettings(mode=self.blend)
        blended = blend_colours(
            points_world,
            frame.views,
            indices,
            settings=settings,
            normals_world=normals,
            timestamps_ns=times,
            gains=gains,
        )
        return blended.colors, blended.sources

    def _label_image(self, view: FusedView, labels: LabelFolder) -> UInt16Array | None:
        """The label image of an image, read once where several sweeps are paired with it."""
        number = self.number(view)
        kept = self._images.get(view.camera_id)
        if kept is None or kept[0] != number:
            camera = self._cameras[view.camera_id][1]
            kept = number, labels.image(camera, number, (view.camera.width, view.camera.height))
            self._images[view.camera_id] = kept
        return kept[1]


def _points_of(frame: FusedFrame) -> Float64Array:
    """Positions in the world, before they were rounded to float32 where an image was found."""
    return frame.views[0].points_world if frame.views else frame.points.positions.astype(np.float64)


def _nearest(
    frame: FusedFrame,
    indices: Sequence[int],
    gains: Mapping[int, Float64Array],
    points_world: Float64Array,
    times: Int64Array | None,
) -> tuple[UInt8Array, PointSources]:
    """The colours that the fusion gave, with their provenance."""
    sources = PointSources.none(len(frame.points))
    if frame.points.colors is None or frame.points.camera_index is None:
        return np.full((len(frame.points), 3), 255, np.uint8), sources
    colors, chosen = frame.points.colors.copy(), frame.points.camera_index
    sources.camera_index[:] = chosen
    for view, index in zip(frame.views, indices, strict=True):
        rows = np.flatnonzero(chosen[view.point_ids] == index)
        ids = view.point_ids[rows]
        sources.images_ns[ids], sources.pixels[ids] = view.timestamp_ns, view.pixels[rows]
        sources.weights[ids] = view_weights(points_world, view, BlendSettings(), timestamps_ns=times)[rows]
        if index in gains:
            colors[ids] = np.rint(np.clip(colors[ids] * gains[index], 0, 255)).astype(np.uint8)
    return colors, sources
