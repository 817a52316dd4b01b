"""Depth images of a drive, sparse or dense: one scene in, a folder of images out."""

import time
from collections import Counter
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import finite_rows
from sceneloom.colouring.depth_completion import DenseDepth, complete_depth
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.images import write_grey_png
from sceneloom.formats.base.output import check_output, filling
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.pipeline.alignment import align
from sceneloom.pipeline.outputs import DepthFolder
from sceneloom.pipeline.play import Skips, build_system, check_any_placed, check_has_lidar, play, telling
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Progress, key_of, reporting
from sceneloom.visualization.canvas import counting_left_out, leave_out
from sceneloom.visualization.fused_frames import draw_dense_depth, save_image
from sceneloom.warnings import DataWarning

_SPARSE, _DENSE = "sparse", "dense"


class DepthCameraReport(msgspec.Struct, frozen=True, kw_only=True):
    """One camera's depth images.

    Attributes:
        images: how many were written.
        filled_percent: share of their pixels that have a depth.
        confidence: mean of these pixels' confidence.
    """

    camera: Identifier
    images: int
    filled_percent: float
    confidence: float


class DepthReport(msgspec.Struct, frozen=True, kw_only=True):
    """The depth images of a drive.

    Attributes:
        method: how they were made.
        sweeps: how many the drive, or the chosen part of it, has.
        unfused: how many of them could not be placed, by reason.
        skipped: one line for each sweep and image that could not be read.
        beyond_range: pixels whose depths the form cannot hold; they are written as 0.
    """

    source: str
    folder: str
    method: str
    sweeps: int
    unfused: dict[str, int]
    skipped: tuple[str, ...]
    cameras: tuple[DepthCameraReport, ...]
    beyond_range: int
    seconds: float
    warnings: tuple[DataWarning, ...]


@dataclass(slots=True)
class _Writer:
    """Writes depth images with what belongs to them: confidence beside PNG images, visualisations in another folder."""

    depth: DepthFolder
    confidence: bool
    images: Path | None
    sums: dict[Identifier, list[float]]

    def add(self, frame: FusedFrame, view: FusedView, dense: DenseDepth) -> None:
        """Write one image, and what belongs to it; count it, its share of pixels with a depth, and their confidence."""
        self.depth.write(frame, view, dense.depths, dense.confidence)
        place = self.depth.place(frame, view).with_suffix(".png")
        if self.confidence and self.depth.form == "png":
            beside = self.depth.folder / place.parent / "confidence"
            beside.mkdir(parents=True, exist_ok=True)
            levels = np.rint(dense.confidence * 255).astype(np.uint8)  # 255 for 1
            write_grey_png(levels, beside / place.name)
        if self.images is not None:
            (self.images / place.parent).mkdir(parents=True, exist_ok=True)
            save_image(draw_dense_depth(view, dense), self.images / place)
        known = dense.depths > 0
        confidence = float(dense.confidence[known].mean()) if known.any() else 0.0
        sums = self.sums[view.camera_id]
        sums[:] = [sums[0] + 1, sums[1] + float(known.mean()), sums[2] + confidence]

    def reports(self) -> tuple[DepthCameraReport, ...]:
        """A report for each camera."""
        return tuple(
            DepthCameraReport(
                camera=camera_id,
                images=int(images),
                filled_percent=100.0 * filled / max(images, 1),
                confidence=confidence / max(images, 1),
            )
            for camera_id, (images, filled, confidence) in self.sums.items()
        )


def write_depth_images(
    scene: Scene, folder: str | Path, *, method: str = _DENSE, form: str = "png",
    cameras: Iterable[Identifier] | None = None, confidence: bool = False, images: str | Path | None = None,
    trajectory: str | None = None, heading: str | None = None, start: float | None = None, stop: float | None = None,
    configuration: FusionConfiguration | None = None, lenient: bool = False, overwrite: bool = False,
    progress: Progress | None = None,
) -> DepthReport:  # fmt: skip
    """Write a depth image for each sweep and each image that belongs to it.

    Sweeps are read, completed and let go one after another. `index.jsonl` in the folder says of each image which sweep
    and which image it is of.

    Args:
        folder: for the images: `<camera>/<number of the sweep>.png`; of several lidars, below `<lidar>/`.
        method: "sparse" (the measured points alone) or "dense" (surfaces between them).
        form: "png" (16 bit, metres times 256) or "npz" (float32 metres and confidence).
        cameras: the only cameras; None for all.
        confidence: write `<camera>/confidence/<number>.png` (8 bit, 255 for 1) beside PNG images; NPZ always hold it.
        images: folder for images to look at: image, depths and confidence.
        trajectory: name of the ego trajectory; "identity" for an ego that is stationary; "lidar" to find it from the
            sweeps; None for the scene's default.
        heading: "motion" to derive orientations where the trajectory has positions only.
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        lenient: count sweeps and images that cannot be read, and go on.

    Raises:
        PoseError: the sensors' motion is not known, or at the time of no sweep.
        DataError: there is no lidar or no camera, or a sweep or an image cannot be read.
        OutputError: the folder holds something, or cannot be written.
        OptionError: a value is not one that can be followed.
    """
    begun = time.perf_counter()
    location, drawn = Path(folder), None if images is None else Path(images)
    for name, value, known in (("method", method, (_SPARSE, _DENSE)), ("form", form, ("png", "npz"))):
        if value not in known:
            raise OptionError(f"{name} {value!r}; expected one of {', '.join(known)}")
    if drawn is not None and drawn.absolute() == location.absolute():
        raise OptionError(f"{location}: named for depth images and for images; expected two folders")
    for output in filter(None, (location, drawn)):
        check_output(output, overwrite=overwrite)
    scene, skips = scene.corrected(), Skips(lenient)
    chosen = _with_cameras(scene, cameras)
    aligned = align(chosen, trajectory=trajectory, heading=heading, start=start, stop=stop, lenient=lenient)
    system = build_system(aligned.scene, aligned.ego, configuration or FusionConfiguration(), skips)
    total, unfused = aligned.sweeps, Counter[str]()
    with telling(skips), counting_left_out() as left, ExitStack() as stack:
        depth = DepthFolder(stack.enter_context(filling(location, overwrite=overwrite)), aligned.scene, form)
        look = None if drawn is None else stack.enter_context(filling(drawn, overwrite=overwrite))
        writer = _Writer(depth, confidence, look, {camera.id: [0, 0.0, 0.0] for camera in aligned.scene.cameras})
        for frame in reporting(play(aligned.scene, system, skips), progress, total):
            leave_out("points", int((~finite_rows(frame.points.positions)).sum()))
            if frame.unfused is not None:
                unfused[frame.unfused] += 1
            for view in frame.views:
                if method == _SPARSE:
                    dense = DenseDepth(view.depth_image, (view.depth_image > 0).astype(np.float32))
                else:
                    dense = complete_depth(view)
                writer.add(frame, view, dense)
        check_any_placed(aligned.scene, unfused, total)
    return DepthReport(
        source=scene.source,
        folder=str(location),
        method=method,
        sweeps=total,
        unfused=dict(unfused),
        skipped=skips.reasons,
        cameras=writer.reports(),
        beyond_range=depth.beyond_range,
        seconds=time.perf_counter() - begun,
        warnings=(*aligned.scene.warnings, *left.warnings),
    )


def _with_cameras(scene: Scene, cameras: Iterable[Identifier] | None) -> Scene:
    """Leave out the images of all cameras but some, which need not be decoded then."""
    check_has_lidar(scene, "depth images need")
    if not scene.cameras:
        raise DataError(scene.source, "", "no camera in it; depth images need one")
    if cameras is None:
        return scene
    known = {key_of(camera.id) for camera in scene.cameras}
    wanted = {key_of(identifier) for identifier in cameras}
    if missing := [key for key in wanted if key not in known]:
        there = ", ".join(str(camera.id) for camera in scene.cameras)
        raise OptionError(f"{scene.source}: no camera {missing[0][-1]!r}; expected some of {there}")
    kept = [s for s in scene.sensors if not isinstance(s, CameraSensor) or key_of(s.id) in wanted]
    return replace(scene, sensors=tuple(kept))
