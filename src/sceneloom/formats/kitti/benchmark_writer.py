"""Write the object and tracking benchmarks: frames, calibration, and annotations as rows of label files."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import FolderKind, filling, replacing
from sceneloom.formats.base.text_tables import seconds_text
from sceneloom.formats.base.written_ego import egos_at
from sceneloom.formats.kitti.calibration import Mounted, write_calibration
from sceneloom.formats.kitti.frames_writer import (
    NONE,
    Choice,
    Timeline,
    kept_calibration,
    kept_of,
    nearest_frames,
    report_unwritten,
)
from sceneloom.formats.kitti.labels import (
    CENTRE_TO_CORNER,
    DONT_CARE,
    NO_OUTLINE,
    NO_TRACK,
    NUMBERS,
    KittiLabels,
    observation_angles,
)
from sceneloom.formats.kitti.object_reader import FRAME_NS
from sceneloom.formats.kitti.oxts import oxts_lines
from sceneloom.formats.kitti.sensors import UNTOLD
from sceneloom.formats.kitti.spec import OBJECT_CAMERAS, TRACKING_CAMERAS
from sceneloom.formats.kitti.text import LATEST, write_lines
from sceneloom.geometry.boxes import box_corners
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion, multiply_quaternions
from sceneloom.scene.annotations import AttributePath, Box2DAnnotation, CuboidAnnotation, Projection
from sceneloom.scene.annotations_at import CuboidAngles, activated, active_at, attribute_at, box_2d_at, cuboid_poses
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, key_of

_NEAR = 0.1  # what has no corner further in front of the camera than this has no outline in its images [m]
_UPRIGHT_WITHIN = 1e-6
_REPORTED = ("truncated", "occluded", "alpha", "score", "type")

_NO_SPACE = (-1.0, -1.0, -1.0, -1000.0, -1000.0, -1000.0, -10.0)
"""What rows of boxes in images have for size, location and heading."""

_NO_OUTLINE = np.full(4, NO_OUTLINE)
_IMAGE_ONLY = " (image)"


@dataclass(frozen=True, slots=True)
class _Row:
    """One row of labels; its numbers in the order of `NUMBERS`, and a score or NaN."""

    frame: int
    track: int
    type: str
    values: tuple[float, ...]


class _LabelRows:
    """Collects the rows of a scene's boxes."""

    def __init__(
        self,
        choice: Choice,  # its reference is the camera in whose images boxes are
        timeline: Timeline,
        reference_at: Callable[[int], RigidTransform],  # `world_from_rectified` of a frame
        camera_model_at: Callable[[int, CameraSensor], Camera],  # of a frame's image
        *,
        with_tracks: bool,
    ) -> None:
        """Begin; without a reference, a box is in all its frames, and its image box is not reported."""
        self.losses = choice.losses
        scene = choice.scene
        self._scene, self._timeline = scene, timeline
        self._camera = None if choice.reference is None else choice.cameras[choice.reference]
        self._reference_at, self._camera_model_at = reference_at, camera_model_at
        self._with_tracks = with_tracks
        self._timestamps_ns = self._image_times(choice.reference)
        self._angles = CuboidAngles.of(scene)
        self._rows: list[_Row] = []
        self._tilt, self._tilted = 0.0, 0
        self._tracks = self._track_ids()

    def _image_times(self, number: int | None) -> Int64Array:
        """When each frame's image was; the frame's own time where it has none."""
        chosen = None if number is None else self._timeline.images.get(number)
        timestamps = self._timeline.timestamps_ns.copy()
        if chosen is not None and self._camera is not None and len(self._camera.images):
            there = chosen != NONE
            timestamps[there] = self._camera.images.timestamps_ns[chosen[there]]
        return timestamps

    def labels(self) -> KittiLabels:
        """Give all rows, by frame; within a frame in the order of the annotations."""
        for annotation in self._scene.annotations:
            if isinstance(annotation, CuboidAnnotation):
                self._add_cuboid(annotation)
            elif isinstance(annotation, Box2DAnnotation):
                self._add_box(annotation)
        self._report_tilt()
        return self._collected()

    def _track_ids(self) -> dict[tuple[type, Identifier], int]:
        """A number for each box: its own id where that is one, else a free one."""
        boxes = [a for a in self._scene.annotations if isinstance(a, CuboidAnnotation | Box2DAnnotation)]
        ids = {key_of(a.id): number for a in boxes if (number := _own_track(a)) is not None}
        taken, free = set(ids.values()), 0
        renamed = 0
        for annotation in boxes:
            if key_of(annotation.id) in ids:
                continue
            if annotation.label == DONT_CARE:
                ids[key_of(annotation.id)] = NO_TRACK
                continue
            while free in taken:
                free += 1
            taken.add(free)
            ids[key_of(annotation.id)] = free
            renamed += 1
        if self._with_tracks and renamed:
            what = "tracks are called by numbers there"
            self.losses.converted("annotations.cuboid.id", what, count=renamed)
        return ids

    def _add_cuboid(self, annotation: CuboidAnnotation) -> None:
        camera = None if self._camera is None else key_of(self._camera.id)
        seen = next((one for one in annotation.projections if key_of(one.sensor_id) == camera), None)
        frames, reported_boxes = self._frames_of(annotation, seen)
        if not len(frames):
            what = "left out: in no frame's image"
            self.losses.dropped("annotations.cuboid", what)
            return
        seeing = self._seeing
        timestamps, starts = self._timestamps_ns, self._timestamps_ns
        if self._camera is None:
            timestamps = self._timeline.timestamps_ns
            starts = self._timeline.starts_ns(next(iter(self._scene.lidars), None))
        active = active_at(annotation, seeing, timestamps[frames], since_ns=starts[frames])
        if not active.all():
            what = "left out in frames in which it is not active for the sensor of the labels"
            lost = int((~active).sum())
            self.losses.dropped("annotations.cuboid.path.values", what, count=lost)
            frames, reported_boxes = frames[active], reported_boxes[active]
        times, own = self._timeline.timestamps_ns[frames], annotation.path.timestamps_ns
        if len(own) and not annotation.stationary:
            times = np.clip(times, own[0], own[-1])
        by_path = cuboid_poses(annotation, times, angles=self._angles)
        poses = activated(annotation, seeing, times, by_path, angles=self._angles)
        attributes = {attribute.name: attribute for attribute in annotation.attributes}
        what = "left out: a row has no field for it"
        report_unwritten(annotation, _REPORTED, what, self.losses, seen=int(seen is not None))
        before = len(self._rows)
        for k, frame in enumerate(frames.tolist()):
            if not (poses.there[k] and np.isfinite(poses.centers_world[k]).all()):
                continue
            rectified_from_world = self._reference_at(frame).inverse()
            center = rectified_from_world.apply(poses.centers_world[k])
            rotation = multiply_quaternions(rectified_from_world.quaternion_xyzw, poses.quaternions_xyzw[k])
            corners = reported_boxes[k]
            if not np.isfinite(corners).all():
                found = self._outline(frame, center, poses.sizes_lwh[k], rotation)
                if found is None:
                    continue
                corners = found
            space = self._space(center, poses.sizes_lwh[k], rotation)
            self._add_row(annotation, frame, corners, attributes, space)
        self._report_unseen(len(frames), len(self._rows) - before)

    @property
    def _seeing(self) -> Identifier | None:
        """The sensor by whose activations boxes are there: the camera of the labels, else the first lidar."""
        if self._camera is not None:
            return self._camera.id
        return self._scene.lidars[0].id if self._scene.lidars else None

    def _report_unseen(self, frames: int, rows: int) -> None:
        """Report of frames that a box is in, but whose images do not show it: labels are of what is seen."""
        if not rows:
            self.losses.dropped("annotations.cuboid", "left out: in no frame's image")
        elif rows < frames:
            what = "left out in frames whose images do not show the box"
            self.losses.dropped("annotations.cuboid.path.values", what, count=frames - rows)

    def _frames_of(self, annotation: CuboidAnnotation, seen: Projection | None) -> tuple[Int64Array, Float64Array]:
        """Frames of its boxes in images, else all in which a box is there, and its image boxes (NaN: not reported)."""
        timestamps = annotation.path.timestamps_ns
        if seen is not None and seen.boxes is not None:
            there = np.isfinite(seen.boxes).all(axis=1)
            rows = self._frame_numbers(seen.timestamps_ns[there])
            known = rows != NONE
            left, top, width, height = seen.boxes[there][known].T
            corners = np.column_stack([left, top, left + width, top + height])
            numbers, first = np.unique(rows[known], return_index=True)
            return numbers, corners[first]
        if not len(timestamps):
            return np.zeros(0, np.int64), np.zeros((0, 4))
        times = self._timeline.timestamps_ns
        inside = (times >= timestamps[0]) & (times <= timestamps[-1]) | bool(annotation.stationary)
        frames = np.union1d(np.flatnonzero(inside), self._known(self._frame_numbers(timestamps)))
        return frames, np.full((len(frames), 4), np.nan)

    def _frame_numbers(self, timestamps_ns: Int64Array) -> Int64Array:
        return nearest_frames(self._timestamps_ns, timestamps_ns)

    @staticmethod
    def _known(frames: Int64Array) -> Int64Array:
        known: Int64Array = frames[frames != NONE]
        return known

    def _outline(
        self, frame: int, center: Float64Array, size_lwh: Float64Array, rotation: Float64Array
    ) -> Float64Array | None:
        """The box around what an image shows of a box in space, corner convention; None where it shows nothing."""
        from sceneloom.colouring.cuboid_projection import box_extents

        if self._camera is None:
            return _NO_OUTLINE
        corners = box_corners(center, size_lwh, rotation)
        if corners[:, 2].max() <= _NEAR:
            return None
        extents, _ = box_extents(self._camera_model_at(frame, self._camera), corners[None])
        left, top, right, bottom = extents[0].tolist()
        return extents[0] if np.isfinite(extents).all() and right > left and bottom > top else None

    def _space(self, center: Float64Array, size_lwh: Float64Array, rotation: Float64Array) -> list[float]:
        """Size, location and heading of an upright box: how it is tilted is dropped."""
        matrix = matrix_from_quaternion(rotation)
        tilt = float(np.arccos(np.clip(-matrix[1, 2], -1.0, 1.0)))
        if tilt > _UPRIGHT_WITHIN and np.hypot(matrix[0, 2], matrix[2, 2]) > _UPRIGHT_WITHIN:
            self._tilt, self._tilted = max(self._tilt, tilt), self._tilted + 1
        length, width, height = size_lwh.tolist()
        bottom = (center + np.array([0.0, height / 2, 0.0])).tolist()
        return [height, width, length, *bottom, float(np.arctan2(-matrix[2, 0], matrix[0, 0]))]

    def _report_tilt(self) -> None:
        if self._tilted:
            what = "stood upright about the camera's y axis: their tilt against it is dropped [deg]"
            self.losses.approximated(
                "annotations.cuboid.path.values", what, count=self._tilted, error=float(np.degrees(self._tilt))
            )

    def _add_box(self, annotation: Box2DAnnotation) -> None:
        if self._camera is None or key_of(annotation.sensor_id) != key_of(self._camera.id):
            what = "left out: drawn into images of another camera"
            self.losses.dropped("annotations.box_2d", what)
            return
        timestamps = annotation.path.timestamps_ns
        numbers = self._frame_numbers(timestamps)
        frames = np.unique(self._known(numbers))
        # gaps are meant in a box with a timestamp for each frame that it is in
        if len(timestamps) > 1 and (numbers == NONE).any():
            inside = (self._timestamps_ns >= timestamps[0]) & (self._timestamps_ns <= timestamps[-1])
            if len(timestamps) < int(inside.sum()):
                frames = np.flatnonzero(inside)
        times = self._timestamps_ns[frames]
        if len(timestamps):
            times = np.clip(times, timestamps[0], timestamps[-1])
        values, there = box_2d_at(annotation, times)
        attributes = {attribute.name: attribute for attribute in annotation.attributes}
        for k, frame in enumerate(frames.tolist()):
            if there[k] and np.isfinite(values[k]).all():
                left, top, width, height = values[k]
                corners = np.array([left, top, left + width, top + height])
                self._add_row(annotation, frame, corners, attributes, _NO_SPACE)

    def _add_row(
        self,
        annotation: CuboidAnnotation | Box2DAnnotation,
        frame: int,
        corners: Float64Array,
        attributes: dict[str, AttributePath],
        space: Sequence[float],
    ) -> None:
        time = [int(self._timestamps_ns[frame])]
        reported = {name: _number(attributes.get(name), time) for name in _REPORTED[:4]}
        kinds = attribute_at(attributes["type"], time) if "type" in attributes else [None]
        if space[0] > 0 and corners is not _NO_OUTLINE and reported["alpha"] is None:
            reported["alpha"] = float(observation_angles(np.array([space[3:6]]), np.array([space[6]]))[0])
        truncated, occluded, alpha = (UNTOLD[n] if (v := reported[n]) is None else v for n in _REPORTED[:3])
        edges = corners if corners is _NO_OUTLINE else corners - CENTRE_TO_CORNER
        score = np.nan if reported["score"] is None else reported["score"]
        word = self._word(kinds[0] if isinstance(kinds[0], str) else annotation.label)
        values = (truncated, float(int(occluded)), alpha, *edges.tolist(), *space, score)
        self._rows.append(_Row(frame, self._tracks[key_of(annotation.id)], word, values))

    def _word(self, label: str | None) -> str:
        """A class as a word without blanks."""
        word = "_".join((label or "Misc").split())
        word = word if word[:1].isalpha() else f"Misc_{word}"
        if word != label:
            what = f"{label!r} written as {word!r}: a class is a word there"
            self.losses.converted("annotations.cuboid.label", what)
        return word

    def _collected(self) -> KittiLabels:
        rows = self._rows
        order = np.argsort(np.array([row.frame for row in rows], np.int64), kind="stable").tolist()
        values = np.array([rows[k].values for k in order], np.float64).reshape(len(rows), len(NUMBERS) + 1)
        scored = np.isfinite(values[:, -1])
        if not (scored.all() and len(rows)):
            what = "left out: rows have scores only where all of them have one"
            self.losses.dropped("annotations.cuboid.attributes", what, count=int(scored.sum()))
            values = values[:, :-1]
        return KittiLabels.of(
            [rows[k].frame for k in order], [rows[k].track for k in order], [rows[k].type for k in order], values
        )


def _own_track(annotation: CuboidAnnotation | Box2DAnnotation) -> int | None:
    """The number that a box's id says, if it says one."""
    identifier = annotation.id
    text = str(identifier).removesuffix(_IMAGE_ONLY)
    if isinstance(identifier, int) or (text != identifier and text.isascii() and text.isdigit()):
        number = int(text)
        return number if 0 <= number <= LATEST else None
    return None


def _number(attribute: AttributePath | None, time_ns: list[int]) -> float | None:
    if attribute is None:
        return None
    value = attribute_at(attribute, time_ns)[0]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and np.isfinite(value) else None


_OBJECT_HELD = frozenset({LidarSensor, CameraSensor, CuboidAnnotation, Box2DAnnotation})
"""Kinds of sensors and annotations that frames can hold."""

_OBJECT_KIND = FolderKind(
    "folder of KITTI's object benchmark",
    (r"training/velodyne/\d{6}\.bin", r"training/(calib|label_2)/\d{6}\.txt", r"training/image_\d/\d{6}\.(png|jpe?g)"),
    r"training/calib/\d{6}\.txt",
)


def write_object(scene: Scene, path: Path, *, overwrite: bool = False) -> LossReport:
    """Write a scene as frames in a folder `training` below the path."""
    choice = Choice.of(scene, tuple(OBJECT_CAMERAS), _OBJECT_HELD, rigid=False)
    choice.check_files(labels=True)
    timeline = choice.timeline(one_time=False)
    numbers = _numbers(scene, timeline)
    _report_times(choice, timeline)
    with replacing(path, overwrite=overwrite, folder=_OBJECT_KIND) as draft:
        folder = draft / "training"
        (folder / "calib").mkdir(parents=True)
        images = {number: folder / kind for number, kind in OBJECT_CAMERAS.items()}
        choice.write_frames(
            timeline, lambda k: f"{numbers[k]:06d}", folder / "velodyne", images, own_camera_models=True
        )
        locations = _FrameLocations(choice, timeline)
        rectified = [
            write_calibration(
                folder / "calib" / f"{numbers[k]:06d}.txt", "object", locations.mounted(k), _kept(scene, numbers[k])
            )
            for k in range(len(timeline))
        ]
        _write_labels(choice, timeline, numbers, locations, rectified, folder / "label_2")
    return LossReport.of(choice.losses)


def _numbers(scene: Scene, timeline: Timeline) -> list[int]:
    """The numbers of frames: those that a scene of such frames had, else from 0 on."""
    kept = kept_of(scene).get("numbers")
    rows = [divmod(time, FRAME_NS) for time in timeline.timestamps_ns.tolist()]
    if isinstance(kept, list) and all(rest == 0 and 0 <= row < len(kept) for row, rest in rows):
        return [int(kept[row]) for row, _ in rows]
    return list(range(len(timeline)))


def _report_times(choice: Choice, timeline: Timeline) -> None:
    """Frames have neither times nor a trajectory: what of both a scene has is lost."""
    if kept_of(choice.scene).get("benchmark") == "object":
        return
    swept = int((timeline.sweeps != NONE).sum())
    shown = sum(int((rows != NONE).sum()) for rows in timeline.images.values())
    what = "left out: frames have numbers and no times"
    choice.losses.dropped("sensors.lidar.frames.timestamp_ns", what, count=swept)
    choice.losses.dropped("sensors.camera.images.timestamp_ns", what, count=shown)
    if choice.ego_path is not None:
        choice.losses.dropped("trajectories", "left out: every frame's world is its own lidar's frame")


def _kept(scene: Scene, number: int) -> dict[str, list[float]] | None:
    """The entries of the calibration that a frame was read with."""
    kept = kept_of(scene)
    reported = kept.get("calibration")
    if kept.get("benchmark") != "object" or not isinstance(reported, dict):
        return None
    row = reported.get("frames", {}).get(str(number))
    different = reported.get("different", [])
    return different[row] if isinstance(row, int) and 0 <= row < len(different) else None


class _FrameLocations:
    """Where the cameras are in each frame, and with which camera models: images may have their own."""

    def __init__(self, choice: Choice, timeline: Timeline) -> None:
        self._choice, self._timeline = choice, timeline

    def image(self, number: int, k: int) -> CameraImage | None:
        """The image of a camera in a frame."""
        row = int(self._timeline.images[number][k])
        return None if row == NONE else self._choice.cameras[number].images[row]

    def camera_model(self, number: int, k: int) -> Camera:
        """The camera model of a frame's image; the camera's own, where it has none or another kind."""
        own, image = self._choice.cameras[number].camera, self.image(number, k)
        return image.camera if image is not None and image.camera.model == "pinhole" else own

    def mounted(self, k: int) -> Mounted:
        """Calibration of a frame."""
        choice = self._choice
        camera_models, mounts = {}, {}
        for number, mount in choice.ego_from_camera.items():
            image = self.image(number, k)
            ego_from_camera = mount if image is None or image.mount is None else image.mount
            camera_models[number] = self.camera_model(number, k)
            mounts[number] = ego_from_camera.inverse() @ choice.ego_from_lidar
        lidar_from_imu = None if choice.ego_is_lidar else choice.ego_from_lidar.inverse()
        return Mounted(camera_models, mounts, lidar_from_imu, choice.reference, choice.lidar is not None)


def _write_labels(
    choice: Choice,
    timeline: Timeline,
    numbers: list[int],
    locations: _FrameLocations,
    rectified_from_lidar: list[RigidTransform],
    folder: Path,
) -> None:
    egos = egos_at(choice.ego_path, timeline.timestamps_ns)
    world_from_rectified = [
        ego @ choice.ego_from_lidar @ rectified.inverse()
        for ego, rectified in zip(egos, rectified_from_lidar, strict=True)
    ]
    rows = _LabelRows(
        choice,
        timeline,
        world_from_rectified.__getitem__,
        lambda k, _: locations.camera_model(choice.reference or 0, k),
        with_tracks=False,
    )
    labels = rows.labels()
    write_object_labels(labels.with_frames(numbers), folder, frames=numbers)
    tracked = sum(isinstance(a, CuboidAnnotation) and len(a.path.timestamps_ns) > 1 for a in choice.scene.annotations)
    what = "frames know nothing of each other: an object is another one in each"
    choice.losses.dropped("annotations.cuboid.id", what, count=tracked)


_TRACKING_HELD = frozenset(
    {LidarSensor, CameraSensor, ImuSensor, GnssSensor, OdometrySensor, CuboidAnnotation, Box2DAnnotation}
)
"""Kinds of sensors and annotations that a sequence can hold."""

_TRACKING_KIND = FolderKind(
    "folder of KITTI's tracking benchmark",
    (
        r"training/(velodyne|image_\d\d)/(?P<one>\d{4})/\d{6}\.(bin|png|jpe?g)",
        r"training/(calib|label_\d\d|times|oxts)/(?P<one>\d{4})\.txt",
    ),
    r"training/calib/\d{4}\.txt",
)


def write_tracking(scene: Scene, path: Path, *, overwrite: bool = False, sequence: str | None = None) -> LossReport:
    """Write a scene as a sequence in a folder `training` below the path.

    Args:
        sequence: its name, four digits; None for the one that the scene was read from, else "0000".

    Raises:
        OptionError: the name is none.
    """
    name = sequence or kept_of(scene).get("sequence") or "0000"
    name = name if len(name) == 4 else f"{int(name):04d}" if name.isascii() and name.isdigit() else name
    if not (len(name) == 4 and name.isascii() and name.isdigit()):
        raise OptionError(f"sequence {name!r}; expected four digits, as 0000")
    choice = Choice.of(scene, tuple(TRACKING_CAMERAS), _TRACKING_HELD)
    timeline = choice.timeline()
    with replacing(path, overwrite=overwrite, folder=_TRACKING_KIND) as draft:
        folder = draft / "training"
        for kind in ("calib", "label_02", "times"):
            (folder / kind).mkdir(parents=True)
        images = {number: folder / kind / name for number, kind in TRACKING_CAMERAS.items()}
        choice.write_frames(timeline, "{:06d}".format, folder / "velodyne" / name, images)
        with_imu = choice.ego_path is not None or not choice.ego_is_lidar
        mounted = choice.mounted(with_imu=with_imu)
        rectified_from_lidar = write_calibration(
            folder / "calib" / f"{name}.txt", "tracking", mounted, kept_calibration(scene)
        )
        write_lines(folder / "times" / f"{name}.txt", map(seconds_text, timeline.timestamps_ns.tolist()))
        if choice.ego_path is not None:
            lines = oxts_lines(scene, choice.ego_path, timeline.timestamps_ns)
            choice.losses.extend(lines.losses)
            (folder / "oxts").mkdir()
            write_lines(folder / "oxts" / f"{name}.txt", lines.texts())
        egos = egos_at(choice.ego_path, timeline.timestamps_ns)
        ego_from_rectified = choice.ego_from_lidar @ rectified_from_lidar.inverse()
        rows = _LabelRows(
            choice,
            timeline,
            lambda frame: egos[frame] @ ego_from_rectified,
            lambda _, camera: camera.camera,
            with_tracks=True,
        )
        write_lines(folder / "label_02" / f"{name}.txt", _format_labels(rows.labels(), path))
    return LossReport.of(choice.losses)


def write_object_labels(
    labels: KittiLabels, folder: Path | str, *, frames: Sequence[int] | None = None, overwrite: bool = False
) -> None:
    """Write labels or results as the object benchmark has them: `NNNNNN.txt` for each frame, tracks left out.

    Args:
        labels: of any number of frames.
        folder: to be written.
        frames: that get a file, be it empty; None for those that have an object.
        overwrite: whether files that exist may be replaced.

    Raises:
        OutputError: the folder has something in it, or cannot be written.
        DataError: a number is not finite, or a class has a blank.
    """
    texts = dict.fromkeys(labels.frames.tolist() if frames is None else frames, "")
    lines = _format_labels(labels, folder, tracked=False)
    for frame, line in zip(labels.frames.tolist(), lines, strict=True):
        if frame in texts:
            texts[frame] += f"{line}\n"
    with filling(Path(folder), overwrite=overwrite) as draft:
        for frame, text in texts.items():
            (draft / f"{frame:06d}.txt").write_text(text, "utf-8", newline="\n")


def write_labels(labels: KittiLabels, path: Path | str, *, overwrite: bool = False) -> None:
    """Write labels or results as the tracking benchmark has them, a line each in their order.

    Numbers have six decimals.

    Raises:
        OutputError: the file exists, or cannot be written.
        DataError: a number is not finite, or a class has a blank.
    """
    path = Path(path)
    with replacing(path, overwrite=overwrite) as draft:
        draft.write_text("".join(f"{line}\n" for line in _format_labels(labels, path)), "utf-8", newline="\n")


def _format_labels(labels: KittiLabels, path: Path | str = "", *, tracked: bool = True) -> Iterator[str]:
    """The lines of labels or results, without their ends; `tracked`: frame and track stand first."""
    values = labels.values
    wrong = ~np.isfinite(values[:, 2:]).all(axis=1)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(path, f"object {k}", f"{values[k, 2:].tolist()}; expected finite numbers")
    heads = zip(labels.frames.tolist(), labels.track_ids.tolist(), labels.types, values.tolist(), strict=True)
    for frame, track, word, (truncation, occlusion, *row) in heads:
        if not word or any(letter.isspace() for letter in word):
            raise DataError(path, "", f"class {word!r}; expected a word without blanks")
        first = f"{frame} {track} " if tracked else ""
        yield f"{first}{word} {truncation:g} {int(occlusion)} {' '.join(f'{value:.6f}' for value in row)}"
