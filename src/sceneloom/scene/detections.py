"""Detections (boxes in space and in images, per sweep and per image), and tracked objects over time."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum, StrEnum
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array, check_array, hold_arrays, read_only
from sceneloom.errors import ArrayError
from sceneloom.geometry.boxes import box_corners
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.types import Identifier, PointsFrame


class ScoreForm(StrEnum):
    """What a detector's scores are."""

    PROBABILITY = "probability"
    """0 to 1: that the object exists."""
    LOGIT = "logit"
    """Any number, larger for surer; often a logarithm of odds, seldom a well calibrated one."""


@dataclass(frozen=True, slots=True, eq=False)
class Boxes3D:
    """The upright boxes that a detector reports at one time, best kept in the detector's own order.

    Shapes are checked here; what the numbers are worth is judged by those who read or fuse them.

    Attributes:
        timestamp_ns: when the objects were there [ns]; of a sweep its reference time.
        centers: (N, 3) float64 [m], middles of the boxes.
        sizes_lwh: (N, 3) float64 [m], length, width and height.
        yaws: (N,) float64 [rad], heading about the frame's z axis, counter-clockwise from its x axis.
        scores: (N,) float64, in the form of `score_form`.
        labels: N classes.
        velocities: (N, 3) float64 [m/s] over ground, along the frame's axes, or None.
        covariances: (N, 7, 7) float64 of center, size and yaw in this order [m², m rad, rad²], or None.
        ids: (N,) int64, the detector's own numbers, or None.
        frame: the frame of centers, yaws and velocities; of the sensor or the ego at `timestamp_ns`.
        score_form: what the scores are.
        sensor_id: the sensor of the detector, or None.

    Raises:
        ArrayError: shapes or dtypes are wrong, or there are more or fewer labels than boxes.

    Source: tables 7 and 10 of DB34/T 4101-2022; direction = (cos yaw, sin yaw, 0), its speed is along it.
    """

    timestamp_ns: int
    centers: Float64Array
    sizes_lwh: Float64Array
    yaws: Float64Array
    scores: Float64Array
    labels: tuple[str, ...]
    velocities: Float64Array | None = None
    covariances: Float64Array | None = None
    ids: Int64Array | None = None
    frame: PointsFrame = PointsFrame.SENSOR
    score_form: ScoreForm = ScoreForm.PROBABILITY
    sensor_id: Identifier | None = None

    def __post_init__(self) -> None:
        count = hold_arrays(
            self,
            "boxes",
            {
                "timestamp_ns": (int,),
                "centers": (np.float64, "N", 3),
                "sizes_lwh": (np.float64, "N", 3),
                "yaws": (np.float64, "N"),
                "scores": (np.float64, "N"),
                "velocities?": (np.float64, "N", 3),
                "covariances?": (np.float64, "N", 7, 7),
                "ids?": (np.int64, "N"),
            },
            frozen=True,
        )
        _hold_labels(self, count)

    def __len__(self) -> int:
        return len(self.centers)

    @classmethod
    def empty(
        cls, timestamp_ns: int, *, frame: PointsFrame = PointsFrame.SENSOR, sensor_id: Identifier | None = None
    ) -> "Boxes3D":
        """A sweep in which nothing was found."""
        none = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0)
        return cls(timestamp_ns, *none, (), frame=frame, sensor_id=sensor_id)

    @property
    def directions(self) -> Float64Array:
        """Where the objects head, (N, 3) float64, unit."""
        return np.column_stack([np.cos(self.yaws), np.sin(self.yaws), np.zeros(len(self))])

    @property
    def speeds(self) -> Float64Array | None:
        """Speed along the heading, (N,) float64 [m/s], negative for reversing; None without velocities."""
        if self.velocities is None:
            return None
        speeds: Float64Array = (self.velocities * self.directions).sum(axis=1)
        return speeds

    @property
    def corners(self) -> Float64Array:
        """(N, 8, 3) float64 [m], in the order of `geometry.boxes.CORNER_SIGNS`."""
        halves = self.yaws / 2
        zero = np.zeros(len(self))
        quaternions = np.column_stack([zero, zero, np.sin(halves), np.cos(halves)])
        return box_corners(self.centers, self.sizes_lwh, quaternions)

    def select(self, rows: ArrayLike) -> "Boxes3D":
        """Keep some boxes: (M,) numbers of boxes, or (N,) bool."""
        return _selected(self, rows)

    def moved(self, b_from_a: RigidTransform, frame: PointsFrame) -> "Boxes3D":
        """The same boxes in another frame, `b_from_a` taking points of their frame into it.

        They stay upright there: of a frame that is tilted, the heading's horizontal part counts.
        """
        rotated = b_from_a.rotate(self.directions)
        covariances = self.covariances
        if covariances is not None:
            rotation = np.eye(7)
            rotation[:3, :3] = b_from_a.rotation
            covariances = rotation @ covariances @ rotation.T
        return replace(
            self,
            centers=b_from_a.apply(self.centers),
            yaws=np.arctan2(rotated[:, 1], rotated[:, 0]),
            velocities=None if self.velocities is None else b_from_a.rotate(self.velocities),
            covariances=covariances,
            frame=frame,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Boxes2D:
    """The boxes that a detector reports in one image.

    Shapes are checked here; what the numbers are worth is judged by those who read or fuse them.

    Attributes:
        timestamp_ns: of the image [ns].
        corners_xyxy: (N, 4) float64 [px], left, top, right and bottom edge in the corner convention: the image's
            own corner is (0, 0), right and bottom are exclusive, so a box around one pixel is 1 wide.
        scores: (N,) float64, in the form of `score_form`.
        labels: N classes.
        ids: (N,) int64, the detector's own numbers, or None.
        score_form: what the scores are.
        sensor_id: the camera, or None.

    Raises:
        ArrayError: shapes or dtypes are wrong, or there are more or fewer labels than boxes.

    Source: table 8 of DB34/T 4101-2022, with edges that need not be whole numbers.
    """

    timestamp_ns: int
    corners_xyxy: Float64Array
    scores: Float64Array
    labels: tuple[str, ...]
    ids: Int64Array | None = None
    score_form: ScoreForm = ScoreForm.PROBABILITY
    sensor_id: Identifier | None = None

    def __post_init__(self) -> None:
        count = hold_arrays(
            self,
            "boxes",
            {
                "timestamp_ns": (int,),
                "corners_xyxy": (np.float64, "N", 4),
                "scores": (np.float64, "N"),
                "ids?": (np.int64, "N"),
            },
            frozen=True,
        )
        _hold_labels(self, count)

    def __len__(self) -> int:
        return len(self.corners_xyxy)

    @classmethod
    def empty(cls, timestamp_ns: int, *, sensor_id: Identifier | None = None) -> "Boxes2D":
        """An image in which nothing was found."""
        return cls(timestamp_ns, np.zeros((0, 4)), np.zeros(0), (), sensor_id=sensor_id)

    @property
    def sizes_wh(self) -> Float64Array:
        """Width and height of the boxes, (N, 2) float64 [px]."""
        sizes: Float64Array = self.corners_xyxy[:, 2:] - self.corners_xyxy[:, :2]
        return sizes

    def select(self, rows: ArrayLike) -> "Boxes2D":
        """Keep some boxes: (M,) numbers of boxes, or (N,) bool."""
        return _selected(self, rows)


Boxes = TypeVar("Boxes", Boxes3D, Boxes2D)


def _hold_labels(boxes: "Boxes3D | Boxes2D", count: int) -> None:
    labels = boxes.labels
    if isinstance(labels, list):
        labels = tuple(labels)
        object.__setattr__(boxes, "labels", labels)
    if not isinstance(labels, tuple) or len(labels) != count:
        raise ArrayError(f"boxes.labels: {type(labels).__name__} of {len(labels)}; expected a tuple of {count}")


def _selected(boxes: Boxes, rows: ArrayLike) -> Boxes:
    picked = np.asarray(rows)
    chosen = np.arange(len(boxes))[picked if picked.dtype == np.bool_ else picked.astype(np.int64)]
    kept: dict[str, Any] = {"labels": tuple(boxes.labels[k] for k in chosen.tolist())}
    for f in fields(boxes):
        value = getattr(boxes, f.name)
        if isinstance(value, np.ndarray):
            kept[f.name] = value[chosen]
    return replace(boxes, **kept)


class Support(IntEnum):
    """What a state of a track rests on at its time."""

    BOTH = 0
    """A box of a sweep and one of an image."""
    SWEEP = 1
    """A box of a sweep alone."""
    IMAGE = 2
    """A box of an image alone."""
    PREDICTED = 3
    """No box: where its motion leads it."""
    INTERPOLATED = 4
    """No box: between boxes before and after."""


_STATE = {
    "centers": (np.float64, "N", 3),
    "sizes_lwh": (np.float64, "N", 3),
    "yaws": (np.float64, "N"),
    "velocities": (np.float64, "N", 3),
    "yaw_rates": (np.float64, "N"),
    "covariances": (np.float64, "N", 10, 10),
    "scores": (np.float64, "N"),
    "supports": (np.uint8, "N"),
}  # the arrays of states: dtype and shape


def _hold_states(states: "Track | TrackedObjects", path: str, first: dict[str, tuple[Any, ...]]) -> int:
    count = hold_arrays(states, path, first | _STATE, frozen=True)
    corners_xyxy = {}
    for camera_id, corners in states.corners_xyxy.items():
        check_array(f"{path}.corners_xyxy[{camera_id!r}]", corners, (count, 4), np.float64)
        corners_xyxy[camera_id] = read_only(corners)
    object.__setattr__(states, "corners_xyxy", MappingProxyType(corners_xyxy))
    return count


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One object through time, in the world frame.

    Attributes:
        id: of the object, the same through the drive.
        label: its class.
        timestamps_ns: (K,) int64 [ns], rising.
        centers: (K, 3) float64 [m].
        sizes_lwh: (K, 3) float64 [m], length, width and height.
        yaws: (K,) float64 [rad], heading about the world's z axis, counter-clockwise from its x axis.
        velocities: (K, 3) float64 [m/s] over ground.
        yaw_rates: (K,) float64 [rad/s].
        covariances: (K, 10, 10) float64 of center, size, yaw and velocity in this order.
        scores: (K,) float64, 0 to 1: probability that the object exists, at that time.
        supports: (K,) uint8 of `Support`.
        corners_xyxy: by camera, (K, 4) float64 [px] in the corner convention, NaN where no box of that camera's image
            is the object's.

    Raises:
        ArrayError: shapes or dtypes are wrong, or times do not rise.
    """

    id: int
    label: str
    timestamps_ns: Int64Array
    centers: Float64Array
    sizes_lwh: Float64Array
    yaws: Float64Array
    velocities: Float64Array
    yaw_rates: Float64Array
    covariances: Float64Array
    scores: Float64Array
    supports: UInt8Array
    corners_xyxy: Mapping[Identifier, Float64Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _hold_states(self, "track", {"timestamps_ns": (np.int64, "N")})
        if (np.diff(self.timestamps_ns) <= 0).any():
            raise ArrayError(f"track {self.id}: timestamps_ns do not rise")

    def __len__(self) -> int:
        return len(self.timestamps_ns)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedObjects:
    """All objects that a tracker believes in at one time, in the world frame.

    Attributes:
        timestamp_ns: the time [ns].
        ids: (N,) int64, of the objects.
        labels: N classes.
        centers, sizes_lwh, yaws, velocities, yaw_rates, covariances, scores, supports, corners_xyxy: as of `Track`, a
            row for each object.

    Raises:
        ArrayError: shapes or dtypes are wrong.
    """

    timestamp_ns: int
    ids: Int64Array
    labels: tuple[str, ...]
    centers: Float64Array
    sizes_lwh: Float64Array
    yaws: Float64Array
    velocities: Float64Array
    yaw_rates: Float64Array
    covariances: Float64Array
    scores: Float64Array
    supports: UInt8Array
    corners_xyxy: Mapping[Identifier, Float64Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = _hold_states(self, "objects", {"timestamp_ns": (int,), "ids": (np.int64, "N")})
        if len(self.labels) != count:
            raise ArrayError(f"objects.labels: {len(self.labels)}; expected {count}")

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class Tracks:
    """The objects of a drive.

    Attributes:
        tracks: each once, in the order of their ids.
    """

    tracks: tuple[Track, ...]

    def __len__(self) -> int:
        return len(self.tracks)

    def __iter__(self) -> Iterator[Track]:
        return iter(self.tracks)

    def __getitem__(self, k: int) -> Track:
        return self.tracks[k]
