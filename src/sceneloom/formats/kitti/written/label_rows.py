"""Annotations as rows of KITTI's labels: which frames they are told in, in the reference camera's frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.formats.kitti.camera_boxes import CENTRE_TO_CORNER, observation_angles
from sceneloom.formats.kitti.labels import DONT_CARE, NO_OUTLINE, NO_TRACK, KittiLabels
from sceneloom.formats.kitti.number_lines import LATEST
from sceneloom.formats.kitti.scenes.boxes import UNTOLD
from sceneloom.formats.kitti.written.choice import Choice
from sceneloom.formats.kitti.written.timeline import NONE, Timeline, nearest_frames
from sceneloom.formats.loss import Fate, Loss
from sceneloom.geometry.boxes import box_corners
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion, multiply_quaternions
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, Projection
from sceneloom.scene.at import activated, active_at, attribute_at, box_2d_at, cuboid_poses
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.types import Identifier, key_of

_NEAR = 0.1
"""What has no corner further in front of the camera than this has no outline in its pictures [m]."""
_UPRIGHT_WITHIN = 1e-6
_TOLD = ("truncated", "occluded", "alpha", "score", "type")
_NO_SPACE = (-1.0, -1.0, -1.0, -1000.0, -1000.0, -1000.0, -10.0)
"""What rows of boxes in pictures have for size, place and heading."""
_NO_OUTLINE = np.full(4, NO_OUTLINE)
_PICTURE_ONLY = " (picture)"


@dataclass(slots=True)
class _Rows:
    frames: list[int] = field(default_factory=list)
    tracks: list[int] = field(default_factory=list)
    types: list[str] = field(default_factory=list)
    told: list[tuple[float, float, float, float]] = field(default_factory=list)
    corners: list[Float64Array] = field(default_factory=list)
    space: list[Sequence[float]] = field(default_factory=list)


class LabelRows:
    """Collects the rows of a scene's boxes.

    Attributes:
        losses: what the rows do not hold.
    """

    def __init__(
        self,
        choice: Choice,
        timeline: Timeline,
        reference_at: Callable[[int], RigidTransform],
        lens_at: Callable[[int, CameraSensor], Camera],
        *,
        with_tracks: bool,
    ) -> None:
        """Begin.

        Args:
            choice: whose annotations are written; its reference is the camera in whose pictures boxes are. Without
                one, every box is a row in each of its frames, and where a picture shows it is not told.
            timeline: the frames.
            reference_at: `world_from_rectified` of a frame.
            lens_at: of a frame's picture of the camera.
            with_tracks: whether rows have tracks.
        """
        self.losses: list[Loss] = []
        scene = choice.scene
        self._scene, self._timeline = scene, timeline
        self._camera = None if choice.reference is None else choice.cameras[choice.reference]
        self._reference_at, self._lens_at = reference_at, lens_at
        self._with_tracks = with_tracks
        self._stamps_ns = self._picture_times(choice.reference)
        self._angles = CuboidAngles.of(scene)
        self._rows = _Rows()
        self._tilt, self._tilted = 0.0, 0
        self._tracks = self._track_ids()

    def _picture_times(self, number: int | None) -> Int64Array:
        """When each frame's picture was; the frame's own time where it has none."""
        chosen = None if number is None else self._timeline.pictures.get(number)
        stamps = self._timeline.timestamps_ns.copy()
        if chosen is not None and self._camera is not None and len(self._camera.pictures):
            there = chosen != NONE
            stamps[there] = self._camera.pictures.timestamps_ns[chosen[there]]
        return stamps

    def labels(self) -> KittiLabels:
        """Give all rows, by frame; within a frame in the order of the annotations."""
        for annotation in self._scene.annotations:
            if isinstance(annotation, CuboidAnnotation):
                self._add_cuboid(annotation)
            elif isinstance(annotation, Box2DAnnotation):
                self._add_box(annotation)
        self._tell_tilt()
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
            self.losses.append(
                Loss(field="annotations.cuboid.id", what=what, count=renamed, fate=Fate.CONVERTED)
            )
        return ids

    def _add_cuboid(self, annotation: CuboidAnnotation) -> None:
        seen = self._projection(annotation)
        frames, told_boxes = self._frames_of(annotation, seen)
        if not len(frames):
            what = "left out: in no frame's picture"
            self.losses.append(Loss(field="annotations.cuboid", what=what))
            return
        seeing = self._seeing
        stamps, starts = self._stamps_ns, self._stamps_ns
        if self._camera is None:
            stamps = self._timeline.timestamps_ns
            starts = self._timeline.starts_ns(next(iter(self._scene.lidars), None))
        active = active_at(annotation, seeing, stamps[frames], since_ns=starts[frames])
        if not active.all():
            what = "left out in frames in which it is not active for the sensor of the labels"
            lost = int((~active).sum())
            self.losses.append(Loss(field="annotations.cuboid.path.values", what=what, count=lost))
            frames, told_boxes = frames[active], told_boxes[active]
        times = self._times_within(annotation, frames)
        by_path = cuboid_poses(annotation, times, angles=self._angles)
        poses = activated(annotation, seeing, times, by_path, angles=self._angles)
        attributes = {attribute.name: attribute for attribute in annotation.attributes}
        self._lose_rest(annotation, seen)
        before = len(self._rows.frames)
        for k, frame in enumerate(frames.tolist()):
            if not (poses.there[k] and np.isfinite(poses.centers_world[k]).all()):
                continue
            rectified_from_world = self._reference_at(frame).inverse()
            center = rectified_from_world.apply(poses.centers_world[k])
            turn = multiply_quaternions(rectified_from_world.quaternion_xyzw, poses.quaternions_xyzw[k])
            corners = told_boxes[k]
            if not np.isfinite(corners).all():
                found = self._outline(frame, center, poses.sizes_lwh[k], turn)
                if found is None:
                    continue
                corners = found
            space = self._space(center, poses.sizes_lwh[k], turn)
            self._add_row(annotation, frame, corners, attributes, space)
        self._tell_unseen(len(frames), len(self._rows.frames) - before)

    @property
    def _seeing(self) -> Identifier | None:
        """The sensor by whose activations boxes are there: the camera of the labels, else the first lidar."""
        if self._camera is not None:
            return self._camera.id
        return self._scene.lidars[0].id if self._scene.lidars else None

    def _tell_unseen(self, frames: int, rows: int) -> None:
        """Tell of frames that a box is in, but whose pictures do not show it: labels are of what is seen."""
        if not rows:
            self.losses.append(Loss(field="annotations.cuboid", what="left out: in no frame's picture"))
        elif rows < frames:
            what = "left out in frames whose pictures do not show the box"
            self.losses.append(Loss(field="annotations.cuboid.path.values", what=what, count=frames - rows))

    def _projection(self, annotation: CuboidAnnotation) -> Projection | None:
        if self._camera is None:
            return None
        wanted = key_of(self._camera.id)
        return next((p for p in annotation.projections if key_of(p.sensor_id) == wanted), None)

    def _frames_of(
        self, annotation: CuboidAnnotation, seen: Projection | None
    ) -> tuple[Int64Array, Float64Array]:
        """The frames in which a box is told, and where its picture shows it (NaN where that is not told).

        These are the frames of its boxes in pictures, where it has some, else all in which it is there.
        """
        stamps = annotation.path.timestamps_ns
        if seen is not None and seen.boxes is not None:
            there = np.isfinite(seen.boxes).all(axis=1)
            rows = self._frame_numbers(seen.timestamps_ns[there])
            known = rows != NONE
            left, top, width, height = seen.boxes[there][known].T
            corners = np.column_stack([left, top, left + width, top + height])
            numbers, first = np.unique(rows[known], return_index=True)
            return numbers, corners[first]
        if not len(stamps):
            return np.zeros(0, np.int64), np.zeros((0, 4))
        times = self._timeline.timestamps_ns
        inside = (times >= stamps[0]) & (times <= stamps[-1]) | bool(annotation.stationary)
        frames = np.union1d(np.flatnonzero(inside), self._known(self._frame_numbers(stamps)))
        return frames, np.full((len(frames), 4), np.nan)

    def _frame_numbers(self, stamps_ns: Int64Array) -> Int64Array:
        return nearest_frames(self._stamps_ns, stamps_ns)

    @staticmethod
    def _known(frames: Int64Array) -> Int64Array:
        known: Int64Array = frames[frames != NONE]
        return known

    def _times_within(self, annotation: CuboidAnnotation, frames: Int64Array) -> Int64Array:
        """The frames' times, brought within the box's own."""
        stamps = annotation.path.timestamps_ns
        times = self._timeline.timestamps_ns[frames]
        return times if annotation.stationary or not len(stamps) else np.clip(times, stamps[0], stamps[-1])

    def _outline(
        self, frame: int, center: Float64Array, size_lwh: Float64Array, turn: Float64Array
    ) -> Float64Array | None:
        """The box around what a picture shows of a box in space, corner convention; None where it shows nothing."""
        from sceneloom.visibility.outlines import box_extents

        if self._camera is None:
            return _NO_OUTLINE
        corners = box_corners(center, size_lwh, turn)
        if corners[:, 2].max() <= _NEAR:
            return None
        extents, _ = box_extents(self._lens_at(frame, self._camera), corners[None])
        left, top, right, bottom = extents[0].tolist()
        return extents[0] if np.isfinite(extents).all() and right > left and bottom > top else None

    def _space(self, center: Float64Array, size_lwh: Float64Array, turn: Float64Array) -> list[float]:
        """Size, place and heading of an upright box: how it is tilted is dropped."""
        matrix = matrix_from_quaternion(turn)
        tilt = float(np.arccos(np.clip(-matrix[1, 2], -1.0, 1.0)))
        if tilt > _UPRIGHT_WITHIN and np.hypot(matrix[0, 2], matrix[2, 2]) > _UPRIGHT_WITHIN:
            self._tilt, self._tilted = max(self._tilt, tilt), self._tilted + 1
        length, width, height = size_lwh.tolist()
        bottom = (center + np.array([0.0, height / 2, 0.0])).tolist()
        return [height, width, length, *bottom, float(np.arctan2(-matrix[2, 0], matrix[0, 0]))]

    def _tell_tilt(self) -> None:
        if self._tilted:
            what = "stood upright about the camera's y axis: their tilt against it is dropped [deg]"
            self.losses.append(
                Loss(
                    field="annotations.cuboid.path.values",
                    what=what,
                    count=self._tilted,
                    fate=Fate.APPROXIMATED,
                    largest_error=float(np.degrees(self._tilt)),
                )
            )

    def _add_box(self, annotation: Box2DAnnotation) -> None:
        if self._camera is None or key_of(annotation.sensor_id) != key_of(self._camera.id):
            what = "left out: drawn into pictures of another camera"
            self.losses.append(Loss(field="annotations.box_2d", what=what))
            return
        frames = np.unique(self._known(self._frame_numbers(annotation.path.timestamps_ns)))
        stamps = annotation.path.timestamps_ns
        if len(stamps) > 1:
            inside = (self._stamps_ns >= stamps[0]) & (self._stamps_ns <= stamps[-1])
            if len(stamps) < int(inside.sum()) and not self._is_by_frame(annotation):
                frames = np.flatnonzero(inside)
        times = self._stamps_ns[frames]
        if len(stamps):
            times = np.clip(times, stamps[0], stamps[-1])
        values, there = box_2d_at(annotation, times)
        attributes = {attribute.name: attribute for attribute in annotation.attributes}
        for k, frame in enumerate(frames.tolist()):
            if there[k] and np.isfinite(values[k]).all():
                left, top, width, height = values[k]
                corners = np.array([left, top, left + width, top + height])
                self._add_row(annotation, frame, corners, attributes, _NO_SPACE)

    def _is_by_frame(self, annotation: Box2DAnnotation) -> bool:
        """Whether a box has a stamp for each frame that it is in, gaps between them being meant."""
        return bool((self._frame_numbers(annotation.path.timestamps_ns) != NONE).all())

    def _add_row(
        self,
        annotation: CuboidAnnotation | Box2DAnnotation,
        frame: int,
        corners: Float64Array,
        attributes: dict[str, AttributePath],
        space: Sequence[float],
    ) -> None:
        time = [int(self._stamps_ns[frame])]
        told = {name: _number(attributes.get(name), time) for name in _TOLD[:4]}
        kinds = attribute_at(attributes["type"], time) if "type" in attributes else [None]
        rows = self._rows
        rows.frames.append(frame)
        rows.tracks.append(self._tracks[key_of(annotation.id)])
        rows.types.append(self._word(kinds[0] if isinstance(kinds[0], str) else annotation.label))
        rows.corners.append(corners if corners is _NO_OUTLINE else corners - CENTRE_TO_CORNER)
        rows.space.append(space)
        alpha = told["alpha"]
        if alpha is None:
            alpha = UNTOLD["alpha"]
            if space[0] > 0 and corners is not _NO_OUTLINE:
                alpha = float(observation_angles(np.array([space[3:6]]), np.array([space[6]]))[0])
        truncated, occluded, score = told["truncated"], told["occluded"], told["score"]
        rows.told.append(
            (
                UNTOLD["truncated"] if truncated is None else truncated,
                UNTOLD["occluded"] if occluded is None else float(int(occluded)),
                alpha,
                np.nan if score is None else score,
            )
        )

    def _word(self, label: str | None) -> str:
        """A class as a word without blanks."""
        word = "_".join((label or "Misc").split())
        word = word if word[:1].isalpha() else f"Misc_{word}"
        if word != label:
            what = f"{label!r} written as {word!r}: a class is a word there"
            self.losses.append(Loss(field="annotations.cuboid.label", what=what, fate=Fate.CONVERTED))
        return word

    def _lose_rest(self, annotation: CuboidAnnotation, seen: Projection | None) -> None:
        """Tell of what a box has beside what rows hold."""
        others = [a for a in annotation.attributes if a.name not in _TOLD]
        further = len(annotation.projections) - (seen is not None)
        for name, count in (
            ("attributes", len(others)),
            ("activations", len(annotation.activations)),
            ("projections", further),
            ("stationary", int(annotation.stationary is not None)),
            ("parent_id", int(annotation.parent_id is not None)),
            ("extras", len(annotation.extras)),
        ):
            if count:
                what = "left out: a row has no place for it"
                self.losses.append(Loss(field=f"annotations.cuboid.{name}", what=what, count=count))

    def _collected(self) -> KittiLabels:
        rows = self._rows
        count = len(rows.frames)
        order = np.argsort(np.array(rows.frames, np.int64), kind="stable")
        told = np.array(rows.told, np.float64).reshape(count, 4)[order]
        space = np.array(rows.space, np.float64).reshape(count, 7)[order]
        scored = count > 0 and bool(np.isfinite(told[:, 3]).all())
        if count and not scored and np.isfinite(told[:, 3]).any():
            what = "left out: rows have scores only where all of them have one"
            lost = int(np.isfinite(told[:, 3]).sum())
            self.losses.append(Loss(field="annotations.cuboid.attributes", what=what, count=lost))
        return KittiLabels(
            frames=np.array(rows.frames, np.int64)[order],
            track_ids=np.array(rows.tracks, np.int64)[order],
            types=tuple(rows.types[k] for k in order.tolist()),
            truncations=told[:, 0].copy(),
            occlusions=told[:, 1].astype(np.int64),
            alphas=told[:, 2].copy(),
            corners_xyxy=np.array(rows.corners, np.float64).reshape(count, 4)[order],
            sizes_hwl=space[:, :3].copy(),
            bottoms=space[:, 3:6].copy(),
            rotations_y=space[:, 6].copy(),
            scores=told[:, 3].copy() if scored else None,
        )


def _own_track(annotation: CuboidAnnotation | Box2DAnnotation) -> int | None:
    """The number that a box's id says, if it says one."""
    identifier = annotation.id
    text = str(identifier).removesuffix(_PICTURE_ONLY)
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
