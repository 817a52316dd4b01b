"""How frames stand to each other: single transforms as a manifest writes them, and chains of them."""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import CalibrationError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.records import Record
from sceneloom.geometry.euler import rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import GREATEST_ERROR, SILENT_ERROR, matrix_from_quaternion
from sceneloom.scene.warnings import WarningKind

_ROTATIONS = ("quaternion_xyzw", "quaternion_wxyz", "rotation_matrix", "euler_deg")
_NORM_ERROR = 0.01
_FARTHEST = 1e6

_QUARTER_ERROR = 0.003
"""Angles rounded to 1.57 and 3.14 are quarter rotations in radians within this share; 1.5 and 3 degrees are not."""

_AGREEMENT_ROTATION = 2e-3
_AGREEMENT_SHIFT = 0.01
"""Two ways between the same frames may differ by this much [rad, m]: what rounding in files comes to."""

AXES: Mapping[str, tuple[str, str, str]] = {
    "optical": ("+x", "+y", "+z"),
    "flu": ("-y", "-z", "+x"),
    "frd": ("+y", "+z", "+x"),
}
"""Which axes of a frame point right, down and forward: of a camera's optical frame, and of bodies whose x y z are
forward left up, or forward right down."""

_DIRECTIONS = {sign + axis: value for axis in "xyz" for sign, value in (("+", 1.0), ("-", -1.0), ("", 1.0))}


def read_transform(record: Record, location: str, ledger: Ledger) -> RigidTransform:
    """Build a transform from `matrix`, or from `translation` and one form of rotation.

    Raises:
        CalibrationError: it says too much or too little, or the rotation is none.
    """
    forms = [form for form in _ROTATIONS if form in record]
    if "matrix" in record:
        if forms or "translation" in record:
            raise CalibrationError(f"matrix beside {(forms or ['translation'])[0]}; expected one of them")
        return _checked(record["matrix"], location, ledger)
    if len(forms) > 1:
        raise CalibrationError(f"{' and '.join(forms)}; expected one of them")
    if not forms and "translation" not in record:
        raise CalibrationError(
            f"says nothing; expected matrix, or translation and one of {', '.join(_ROTATIONS)}"
        )
    matrix = np.eye(4)
    matrix[:3, 3] = record.get("translation", (0.0, 0.0, 0.0))
    matrix[:3, :3] = _rotation(record, forms[0]) if forms else np.eye(3)
    if forms == ["euler_deg"] and _are_radians(record["euler_deg"]):
        message = (
            f"euler_deg {record['euler_deg'].tolist()} look like radians; degrees are expected, as 90 or -180"
        )
        ledger.note(WarningKind.ASSUMED, "angles-in-radians", location, message)
    return _checked(matrix, location, ledger)


def _are_radians(angles: Float64Array) -> bool:
    """Whether all angles lie within a rotation in radians, and one is a quarter or half rotation of them."""
    quarters = np.abs(angles) / (np.pi / 2)
    whole = (np.abs(quarters - np.round(quarters)) < _QUARTER_ERROR) & (np.round(quarters) > 0)
    return bool(np.abs(angles).max() < 2 * np.pi and whole.any())


def _rotation(record: Record, form: str) -> Float64Array:
    value: Float64Array = record[form]
    if (form == "euler_deg") != ("euler_order" in record):
        raise CalibrationError("euler_deg and euler_order; expected both or neither")
    if form == "rotation_matrix":
        return value
    if form == "euler_deg":
        return rotation_from_cuboid_angles(value, order=record["euler_order"])
    quaternion_xyzw = value if form == "quaternion_xyzw" else value[[1, 2, 3, 0]]
    norm = float(np.linalg.norm(quaternion_xyzw))
    if abs(norm - 1.0) > _NORM_ERROR:
        raise CalibrationError(
            f"{form} {value.tolist()} of length {norm:.4f}; expected 1 within {_NORM_ERROR}"
        )
    return matrix_from_quaternion(quaternion_xyzw)


def _checked(matrix: Float64Array, location: str, ledger: Ledger) -> RigidTransform:
    if np.abs(matrix[:3, 3]).max() > _FARTHEST or np.abs(matrix[:3, :3]).max() > 2:
        problem = f"{matrix.tolist()}; expected a rotation and a translation in metres within {_FARTHEST:g}"
        raise CalibrationError(problem)
    transform, error = RigidTransform.nearest(matrix)
    if not error <= GREATEST_ERROR:
        problem = (
            "mirrored or singular" if error == float("inf") else f"off by {error:.2g} (max abs of R Rᵀ - I)"
        )
        expected = f"expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
        raise CalibrationError(f"rotation {problem}; {expected}")
    if error > SILENT_ERROR:
        message = f"rotation off by {error:.2g} (max abs of R Rᵀ - I); the nearest rotation was taken"
        ledger.note(WarningKind.REPAIRED, "rotation-normalised", location, message)
    return transform


def frame_from_optical(axes: tuple[str, ...]) -> RigidTransform:
    """Rotate from the optical axes (x right, y down, z forward) to those of a frame.

    Args:
        axes: a word out of `AXES`, or the axes of the frame that point right, down and forward.

    Raises:
        CalibrationError: they are no three different axes, or a mirror.
    """
    if len(axes) == 1:
        if axes[0] not in AXES:
            raise CalibrationError(
                f"axes {axes[0]!r}; expected one of {', '.join(AXES)}, or right, down and forward as '-y,-z,+x'"
            )
        axes = AXES[axes[0]]
    rotation = np.zeros((3, 3))
    if len(axes) != 3 or not set(axes) <= set(_DIRECTIONS):
        raise CalibrationError(f"axes {','.join(axes)!r}; expected right, down and forward as '-y,-z,+x'")
    for column, axis in enumerate(axes):
        rotation["xyz".index(axis[-1]), column] = _DIRECTIONS[axis]
    if round(np.linalg.det(rotation)) != 1:
        raise CalibrationError(
            f"axes {','.join(axes)!r} (right, down, forward) are a mirror or no three axes; expected a right-handed set"
        )
    return RigidTransform(rotation, np.zeros(3))


@dataclass(frozen=True, slots=True)
class Edge:
    """One transform of a manifest: `to_from` takes points of frame `source` into frame `target`."""

    source: str
    target: str
    target_from_source: RigidTransform
    location: str


class FrameTree:
    """Frames and the trajectories between them.

    Attributes:
        ego: the frame that everything is seen from.
    """

    def __init__(self, ego: str, edges: Iterable[Edge]) -> None:
        """Follow the transforms from the ego to every frame that they reach.

        Raises:
            CalibrationError: a transform goes from a frame to itself, or two ways between frames contradict each other.
        """
        self.ego = ego
        self._edges = tuple(edges)
        for edge in self._edges:
            if edge.source == edge.target:
                raise CalibrationError(
                    f"{edge.location}: from {edge.source!r} to itself; expected two frames"
                )
        self._ego_from: dict[str, RigidTransform] = {}
        self._towards_ego: dict[str, str] = {}
        self._spread(ego)
        for edge in self._edges:
            self._check(edge)

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames that a transform names, and the ego's."""
        named = [name for edge in self._edges for name in (edge.source, edge.target)]
        return tuple(dict.fromkeys([self.ego, *named]))

    @property
    def loose(self) -> tuple[str, ...]:
        """Frames that no way connects with the ego."""
        return tuple(frame for frame in self.frames if frame not in self._ego_from)

    def ego_from(self, frame: str) -> RigidTransform:
        """Give `ego_from_frame`.

        Raises:
            CalibrationError: no way leads there.
        """
        if frame in self._ego_from:
            return self._ego_from[frame]
        raise CalibrationError(
            f"no transforms lead from frame {frame!r} to the ego's frame {self.ego!r}; {self._hint(frame)}"
        )

    def _hint(self, frame: str) -> str:
        with_ego = ", ".join(map(repr, self._ego_from))
        near = self._connected(frame)
        if len(near) > 1:
            with_frame = ", ".join(map(repr, near[1:]))
            return f"it is connected with {with_frame}, the ego's with {with_ego}: one is missing between"
        known = ", ".join(map(repr, self.frames))
        return f'no transform names it (known frames: {known}); give it an `extrinsic`, or state `ego = "{frame}"`'

    def _connected(self, frame: str) -> list[str]:
        reached = [frame]
        for name in reached:
            pairs = [(edge.source, edge.target) for edge in self._edges if name in (edge.source, edge.target)]
            reached += [other for pair in pairs for other in pair if other not in reached]
        return reached

    def _spread(self, ego: str) -> None:
        self._ego_from[ego] = RigidTransform.identity()
        waiting = deque([ego])
        while waiting:
            frame = waiting.popleft()
            for edge in self._edges:
                for near, far, near_from_far in (
                    (edge.target, edge.source, edge.target_from_source),
                    (edge.source, edge.target, edge.target_from_source.inverse()),
                ):
                    if near == frame and far not in self._ego_from:
                        self._ego_from[far] = self._ego_from[near] @ near_from_far
                        self._towards_ego[far] = near
                        waiting.append(far)

    def _trajectory(self, frame: str) -> list[str]:
        """The frames from one to the ego."""
        trajectory = [frame]
        while trajectory[-1] != self.ego:
            trajectory.append(self._towards_ego[trajectory[-1]])
        return trajectory

    def _loop(self, edge: Edge) -> str:
        """The frames between those of a transform, on the other way."""
        source, target = self._trajectory(edge.source), self._trajectory(edge.target)
        meeting = next(frame for frame in source if frame in target)
        trajectory = [*source[: source.index(meeting) + 1], *reversed(target[: target.index(meeting)])]
        return " - ".join(map(repr, trajectory))

    def _check(self, edge: Edge) -> None:
        """Compare a transform with what the others state of its two frames."""
        if edge.source not in self._ego_from:
            return
        target_from_source = self._ego_from[edge.target].inverse() @ self._ego_from[edge.source]
        rotation = float(np.abs(target_from_source.rotation - edge.target_from_source.rotation).max())
        shift = float(np.abs(target_from_source.translation - edge.target_from_source.translation).max())
        if rotation > _AGREEMENT_ROTATION or shift > _AGREEMENT_SHIFT:
            raise CalibrationError(
                f"{edge.location}: from {edge.source!r} to {edge.target!r} contradicts the trajectory "
                f"{self._loop(edge)} by "
                f"{shift:.3g} m and {np.degrees(rotation):.3g}°; is one of these transforms the other way round?"
            )
