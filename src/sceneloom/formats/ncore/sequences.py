"""Read and write NCore's sequences: poses, intrinsics, cameras, lidars, radars and cuboids of component stores.

Source: "Data Formats", "Specification" and "Sensor Models" of the documentation of NCore; `ncore.impl.data.v4` of the
package nvidia-ncore.
"""

import ast
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, finite_rows, read_only
from sceneloom.cameras.camera import OPENCV_NAMES, Camera, from_opencv, to_opencv
from sceneloom.errors import CalibrationError, DataError, OptionError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.images import EncodedImage, ImageFile, encode_jpeg, encode_png, with_pinholes
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.losses import Losses, LossReport, Support, field_losses
from sceneloom.formats.base.output import replacing
from sceneloom.formats.base.poses import ego_in_world, mounting
from sceneloom.formats.base.written_ego import ego_trajectory
from sceneloom.formats.ncore.spec import SUPPORTS, is_sequence_file, sequences_in
from sceneloom.formats.ncore.store import Store, StoreWriter
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion, quaternion_from_matrix
from sceneloom.scene.annotations import AttributePath, CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_poses
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor, RadarFrame, RadarPoints, RadarSensor
from sceneloom.scene.ego import check_one_ego
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory, poses_along
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

_MICROSECOND = 1000  # nanoseconds
_LATEST_US = 9_000_000_000_000_000
_RIG, _WORLD, _VERSION = "rig", "world", "v4"
_ENTRY = "ncore"  # of the metadata, and of the extra fields of sensors
_SPAN = "frame_timestamps_us"
_KNOWN = ("poses", "intrinsics", "cameras", "lidars", "radars", "cuboids")
_BOX_RADIANS = CuboidAngles("radians", "zyx")
"""Angles of boxes. Source: `bbox_pose` of ncore.impl.common.transformations: SciPy's "xyz", about axes that stand."""

_OPENCV = ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs")
_GROWTH_PX = 0.01  # an inverse polynomial that is further off than this is reported


# camera models


def camera_of(kind: str, parameters: Mapping[str, Any]) -> tuple[Camera, float]:
    """Take a camera model; NCore counts pixels from the image's corner, but those of ftheta from their centres.

    Args:
        kind: `camera_model_type`.
        parameters: `camera_model_parameters`.

    Returns:
        camera: the camera model.
        error: how far it is off [px]; 0 where it is the same.

    Raises:
        CalibrationError: it is none.

    Source: "Sensor Models" of the documentation of NCore.
    """
    width, height = (int(n) for n in _numbers(parameters, "resolution", 2))
    u, v = _numbers(parameters, "principal_point", 2)
    if kind == "ftheta":
        return _ftheta(parameters, width, height, u, v)
    fx, fy = _numbers(parameters, "focal_length", 2)
    size = (width, height, fx, fy, u - 0.5, v - 0.5)
    if kind == "ideal-pinhole":
        return Camera("pinhole", *size), 0.0
    if kind == "opencv-fisheye":
        return Camera("fisheye", *size, tuple(_numbers(parameters, "radial_coeffs", 4))), 0.0
    if kind not in {"opencv-pinhole", "pinhole"}:
        raise CalibrationError(f"camera_model_type {kind!r}; expected ftheta, opencv-pinhole or opencv-fisheye")
    k, p, s = (_numbers(parameters, name, n) for name, n in zip(_OPENCV, (6, 2, 4), strict=True))
    if not any((*k, *p, *s)):
        return Camera("pinhole", *size), 0.0
    return Camera("brown_conrady", *size, from_opencv((*k[:2], *p, *k[2:], *s))), 0.0


def _ftheta(parameters: Mapping[str, Any], width: int, height: int, u: float, v: float) -> tuple[Camera, float]:
    c, d, e = _numbers(parameters, "linear_cde", 3, default=(1.0, 0.0, 0.0))
    forward = _polynomial(parameters, "angle_to_pixeldist_poly")
    error = 0.0
    if parameters.get("reference_poly") == "PIXELDIST_TO_ANGLE":
        reach = math.hypot(max(u + 0.5, width - 0.5 - u), max(v + 0.5, height - 0.5 - v))
        limit = parameters.get("max_angle")
        largest = float(limit) if isinstance(limit, int | float) and 0 < limit < math.pi else math.pi
        backward = _polynomial(parameters, "pixeldist_to_angle_poly")
        forward, error = _inverse(backward, reach * max(1.0, 1.0 / c if c > 0 else 1.0), largest)
    if not forward[1] > 0:
        raise CalibrationError(f"angle_to_pixeldist_poly {forward.tolist()}; expected a slope above 0")
    k0, k1, *higher = forward.tolist()
    coefficients = (k0 / k1, *(k / k1 for k in higher), d * k1, e * k1)
    return Camera("ftheta_skewed", width, height, c * k1, k1, u, v, coefficients), error


def _inverse(backward: Float64Array, reach: float, largest: float) -> tuple[Float64Array, float]:
    """The polynomial of degree 5 that undoes another one up to a distance and angle, and how far it is off at most."""
    distances = np.linspace(0.0, reach, 2001)
    angles = np.polynomial.polynomial.polyval(distances, backward)
    falling = np.flatnonzero((np.diff(angles) <= 0) | (angles[1:] > largest))
    stop = int(falling[0]) + 1 if len(falling) else len(angles)
    if stop < 20:
        raise CalibrationError(
            f"pixeldist_to_angle_poly {backward.tolist()}; expected angles that grow with the distance"
        )
    angles, distances = angles[:stop], distances[:stop]
    fitted = np.polynomial.polynomial.polyfit(angles, distances, 5)
    off = np.abs(np.polynomial.polynomial.polyval(angles, fitted) - distances)
    return fitted.astype(np.float64), float(off.max())


def _polynomial(parameters: Mapping[str, Any], name: str) -> Float64Array:
    values = parameters.get(name)
    count = len(values) if isinstance(values, list | tuple) else 0
    found = _numbers(parameters, name, max(1, min(count, 6)))
    return np.array([*found, *(0.0,) * (6 - len(found))])


def _numbers(
    parameters: Mapping[str, Any], name: str, count: int, *, default: tuple[float, ...] | None = None
) -> list[float]:
    values = parameters.get(name, default)
    rows = values if isinstance(values, list | tuple) else ()
    if len(rows) != count or not all(type(n) in (int, float) and abs(n) < 1e30 for n in rows):
        raise CalibrationError(f"{name} {str(values)[:80]}; expected {count} numbers")
    return [float(n) for n in rows]


def parameters_of(camera: Camera) -> tuple[str, dict[str, Any]]:
    """State a camera model as NCore does; the inverse of `camera_of`.

    Args:
        camera: `pinhole`, `fisheye`, `ftheta_skewed`, or a `brown_conrady` that OpenCV has.
    """
    common: dict[str, Any] = {
        "resolution": [camera.width, camera.height],
        "shutter_type": "GLOBAL",
        "external_distortion_parameters": None,
    }
    if camera.model == "ftheta_skewed":
        k0, k2, k3, k4, k5, skew_u, skew_v = (*camera.coefficients, *(0.0,) * 7)[:7]
        forward = np.array([k0, 1.0, k2, k3, k4, k5]) * camera.fy
        reach = _largest_angle(camera)
        angles = np.linspace(0.0, reach, 500)
        distances = np.polynomial.polynomial.polyval(angles, forward)
        backward = np.polynomial.polynomial.polyfit(distances, angles, 5)
        return "ftheta", common | {
            "principal_point": [camera.cx, camera.cy],
            "reference_poly": "ANGLE_TO_PIXELDIST",
            "pixeldist_to_angle_poly": backward.tolist(),
            "angle_to_pixeldist_poly": forward.tolist(),
            "max_angle": reach,
            "linear_cde": [camera.fx / camera.fy, skew_u / camera.fy, skew_v / camera.fy],
        }
    common |= {"principal_point": [camera.cx + 0.5, camera.cy + 0.5], "focal_length": [camera.fx, camera.fy]}
    if camera.model == "fisheye":
        k = (*camera.coefficients, *(0.0,) * 4)[:4]
        return "opencv-fisheye", common | {"radial_coeffs": list(k), "max_angle": _largest_angle(camera)}
    numbers = dict(zip(OPENCV_NAMES, (*(to_opencv(camera) or ()), *(0.0,) * len(OPENCV_NAMES)), strict=False))
    groups = ([f"k{n}" for n in range(1, 7)], ["p1", "p2"], ["s1", "s2", "s3", "s4"])
    return "opencv-pinhole", common | {
        name: [numbers[key] for key in keys] for name, keys in zip(_OPENCV, groups, strict=True)
    }


def _largest_angle(camera: Camera) -> float:
    """The angle off the axis of what the image shows [rad], as far as it is known, at most pi."""
    from sceneloom.cameras.projection import unproject

    right, low = camera.width - 0.5, camera.height - 0.5
    at = np.linspace(0.0, 1.0, 33)
    edges = [(u, v) for s in at for u, v in ((s * right, -0.5), (s * right, low), (-0.5, s * low), (right, s * low))]
    rays = unproject(camera, np.array(edges))
    angles = np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2])
    known = angles[np.isfinite(angles)]
    return float(known.max()) if len(known) else math.pi


def _written_exactly(camera: Camera) -> bool:
    if camera.model == "brown_conrady":
        numbers = to_opencv(camera)
        return numbers is not None and not any(numbers[12:])
    return camera.model in {"pinhole", "fisheye", "ftheta_skewed"}


# reading


def open_ncore(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a sequence; images and points are read when asked for, boxes at once.

    Args:
        path: a store, a folder of stores, or the JSON file that lists those of a sequence.
        sequence: name of the sequence, where a folder has several.

    Raises:
        DataError: a store is damaged, or of another version.
        OptionError: there are several sequences, and none was chosen.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Sequence(path, _stores(path, sequence), ledger).scene()


def _stores(path: Path, sequence: str | None) -> list[Store]:
    if path.is_file() and is_sequence_file(path):
        listed = read_json(path, dict).get("component_stores")
        found_names = [one.get("path") for one in listed if isinstance(one, dict)] if isinstance(listed, list) else []
        stores = [name for name in found_names if isinstance(name, str) and Path(name).name == name]
        if not stores or len(stores) < len(found_names):
            raise DataError(path, "component_stores", f"{str(listed)[:80]}; expected names of stores beside the file")
        return [Store(path.parent / name) for name in stores]
    found = sequences_in(path)
    if not found:
        raise DataError(
            path, "", "no component store; expected a file NAME.ncore4.zarr.itar or a folder NAME.ncore4.zarr"
        )
    names = ", ".join(found)
    if sequence is not None and sequence not in found:
        raise OptionError(f"{path}: no sequence {sequence!r}; it has {names}")
    if sequence is None and len(found) > 1:
        raise OptionError(f"{path}: {len(found)} sequences; choose one with `--sequence NAME`: {names}")
    return [Store(one) for one in found[sequence or next(iter(found))]]


@dataclass(frozen=True, slots=True, eq=False)
class _Component:
    """A component in its store, by its key."""

    store: Store
    key: str
    name: str


class _Sequence:
    """The components of a sequence by type, and its poses."""

    def __init__(self, path: Path, stores: Sequence[Store], ledger: Ledger) -> None:
        self.path, self.ledger = path, ledger
        self.about: dict[str, Any] = {}
        self.components: dict[str, list[_Component]] = {}
        for store in stores:
            about = store.attributes("")
            if about.get("version") != _VERSION:
                problem = f"version {about.get('version')!r}; expected a component store of NCore {_VERSION}"
                raise DataError(store.path, ".zattrs", problem)
            if self.about and about.get("sequence_id") != self.about.get("sequence_id"):
                problem = f"sequence_id {about.get('sequence_id')!r}; expected {self.about.get('sequence_id')!r}"
                raise DataError(store.path, ".zattrs", problem)
            self.about = self.about or about
            for kind in store.names(""):
                for name in store.names(kind):
                    self.components.setdefault(kind, []).append(_Component(store, f"{kind}/{name}", name))
        for kind in sorted(set(self.components) - set(_KNOWN)):
            message = f"components of the type {kind} are left out"
            ledger.note(WarningKind.SKIPPED, f"{kind}-left-out", str(path), message, count=len(self.components[kind]))
        self.static, self.dynamic = self._poses(self._chosen("poses"))

    def scene(self) -> Scene:
        """Build the scene."""
        ego = self._path_of(_RIG)
        makers: dict[str, Callable[[_Component], Sensor | None]] = {
            "cameras": self._camera,
            "lidars": partial(self._swept, kind=LidarSensor),
            "radars": partial(self._swept, kind=RadarSensor),
        }
        sensors: list[Sensor] = []
        for kind, make in makers.items():
            for component in self.components.get(kind, []):
                try:
                    sensor = make(component)
                except (CalibrationError, DataError) as error:
                    self.ledger.fault("sensors", _located(error, component))
                    continue
                if sensor is not None:
                    sensors.append(sensor)
        trajectories = {}
        if ego is not None and not ego.static:
            trajectories = {_RIG: Trajectory(_RIG, ego.timestamps_ns, ego.positions, ego.quaternions_xyzw)}
        stated = {name: self.about.get(name) for name in ("sequence_id", "generic_meta_data")}
        fixed = {f"{a} {b}": matrix.matrix.tolist() for (a, b), matrix in self.static.items() if a == _WORLD}
        about = {**stated, **({"static_poses": fixed} if fixed else {})}
        convention = {"euler_unit": str(_BOX_RADIANS.unit), "euler_order": _BOX_RADIANS.order}
        return Scene(
            sensors=tuple(sensors),
            annotations=tuple(self._cuboids()),
            trajectories=MappingProxyType(trajectories),
            metadata=MappingProxyType({_ENTRY: about, "sceneloom": convention}),
            source=str(self.path),
            format="ncore",
            warnings=self.ledger.warnings,
        )

    def _chosen(self, kind: str) -> _Component | None:
        """The instance that is read of a type: `default`, else the first."""
        found = sorted(self.components.get(kind, []), key=lambda one: (one.name != "default", one.name))
        if len(found) > 1:
            others = ", ".join(one.name for one in found[1:])
            message = f"of several components {kind}, {found[0].name!r} is read; {others} left out"
            self.ledger.note(WarningKind.SKIPPED, f"{kind}-instances", str(self.path), message)
        return found[0] if found else None

    # poses

    def _poses(
        self, component: _Component | None
    ) -> tuple[dict[tuple[str, str], RigidTransform], dict[tuple[str, str], Poses]]:
        """Transforms that take points of the first frame into the second, fixed and over time."""
        static: dict[tuple[str, str], RigidTransform] = {}
        dynamic: dict[tuple[str, str], Poses] = {}
        if component is None:
            return static, dynamic
        for table in ("static_poses", "dynamic_poses"):
            for name, row in component.store.attributes(f"{component.key}/{table}").items():
                where = f"{component.key}/{table}: {name}"
                try:
                    frames = _frames_of(name)
                    if table == "static_poses":
                        matrix = np.array(row["pose"], np.float64).reshape(1, 4, 4)
                        static[frames] = RigidTransform.from_quaternion(*(part[0] for part in _rigid(matrix)))
                    else:
                        times = _whole(row["timestamps_us"])
                        matrices = np.array(row["poses"], np.float64).reshape(len(times), 4, 4)
                        dynamic[frames] = Poses(times * _MICROSECOND, *_rigid(matrices))
                except (KeyError, TypeError, ValueError, OverflowError, SceneloomError) as error:
                    problem = f"{error}; expected matrices 4x4 of rigid transforms, and times"
                    self.ledger.fault("poses", DataError(component.store.path, where, problem))
        return static, dynamic

    def _fixed(self, source: str, target: str) -> RigidTransform | None:
        """`target_from_source` along fixed transforms; None where there is no such way."""
        ways: dict[str, RigidTransform] = {source: RigidTransform.identity()}
        fresh = [source]
        while fresh and target not in ways:
            here = fresh.pop()
            for (a, b), there_from_here in self.static.items():
                if here == a and b not in ways:
                    ways[b] = there_from_here @ ways[here]
                    fresh.append(b)
                elif here == b and a not in ways:
                    ways[a] = there_from_here.inverse() @ ways[here]
                    fresh.append(a)
        return ways.get(target)

    def _path_of(self, frame: str) -> Poses | None:
        """`world_from_frame` over time, by a transform that begins in this very frame."""
        path = self.dynamic.get((frame, _WORLD))
        if path is None and (_WORLD, frame) in self.dynamic:
            path = _inverted(self.dynamic[_WORLD, frame])
        if path is None and (fixed := self._fixed(frame, _WORLD)) is not None and frame != _WORLD:
            path = Poses(np.zeros(1, np.int64), fixed.translation[None], fixed.quaternion_xyzw[None], static=True)
        return path

    def _placed(self, component: _Component, timestamps_ns: Int64Array) -> dict[str, Any]:
        """Poses and mounting of a sensor."""
        mount = self._fixed(component.name, _RIG)
        if mount is not None:
            path, chosen = self._path_of(_RIG), np.zeros(len(timestamps_ns), np.int64)
            return {"mount": mount, "poses": poses_along(path, {0: mount}, chosen, timestamps_ns)}
        return {"poses": self._path_of(component.name)}

    def _at(self, frame: str, time_ns: int) -> RigidTransform | None:
        """`world_from_frame` at a time; None where it is not known."""
        if frame == _WORLD:
            return RigidTransform.identity()
        fixed = self._fixed(frame, _RIG)
        path = self._path_of(frame if fixed is None else _RIG)
        if path is None:
            return self._fixed(frame, _WORLD)
        found = path.interpolate(np.array([time_ns], np.int64))
        if not path.static and found.coverage[0] != 0:
            return None
        world_from = RigidTransform.from_quaternion(found.positions[0], found.quaternions_xyzw[0])
        return world_from if fixed is None else world_from @ fixed

    # sensors

    def _spans(self, component: _Component) -> Int64Array:
        """(N, 2) int64 [µs]: start and end of each frame, as frames are stated."""
        rows = component.store.attributes(f"{component.key}/frames").get("frames_timestamps_us", [])
        try:
            spans = np.array(rows, np.int64).reshape(len(rows), 2)
        except (TypeError, ValueError, OverflowError) as error:
            raise self._fault(component, "frames", f"frames_timestamps_us: {error}; expected pairs of times") from error
        if len(spans) and not (spans.min() >= 0 and spans.max() <= _LATEST_US and (spans[:, 0] <= spans[:, 1]).all()):
            raise self._fault(component, "frames", "frames_timestamps_us; expected starts up to their ends, from 0 on")
        return spans[np.argsort(spans[:, 0], kind="stable")]

    def _fault(self, component: _Component, key: str, problem: str) -> DataError:
        return DataError(component.store.path, f"{component.key}/{key}", problem)

    def _intrinsics(self, kind: str, name: str) -> Mapping[str, Any]:
        component = self._calibration
        return {} if component is None else component.store.attributes(f"{component.key}/{kind}/{name}")

    @property
    def _calibration(self) -> _Component | None:
        found = sorted(self.components.get("intrinsics", []), key=lambda one: (one.name != "default", one.name))
        return found[0] if found else None

    def _camera(self, component: _Component) -> CameraSensor | None:
        stated = self._intrinsics("cameras", component.name)
        parameters = stated.get("camera_model_parameters")
        if not isinstance(parameters, dict):
            problem = f"no intrinsics of {component.name!r}; expected them in the component intrinsics"
            raise self._fault(component, "", problem)
        camera, error = camera_of(str(stated.get("camera_model_type")), parameters)
        location = f"{component.store.path}: intrinsics of {component.name}"
        if error > _GROWTH_PX:
            message = f"its polynomial of distances is inverted, at most {error:.2g} px off"
            self.ledger.note(WarningKind.ASSUMED, "ftheta-inverted", location, message)
        if parameters.get("external_distortion_parameters"):
            message = "the distortion of a windshield is not applied; it is kept in the camera's extra fields"
            self.ledger.note(WarningKind.SKIPPED, "windshield", location, message)
        spans = self._spans(component)
        timestamps_ns = spans.sum(axis=1) * (_MICROSECOND // 2)
        order = np.argsort(timestamps_ns, kind="stable")
        spans, timestamps_ns = spans[order], timestamps_ns[order]
        images = LazyFrames(timestamps_ns, partial(_read_image, component, spans, camera), stage=None)
        extras = MappingProxyType({_ENTRY: MappingProxyType(dict(stated))})
        return CameraSensor(component.name, camera, images, extras=extras, **self._placed(component, timestamps_ns))

    def _swept(self, component: _Component, kind: type[Any]) -> Sensor:
        spans = self._spans(component)
        timestamps_ns = spans[:, 0] * _MICROSECOND
        read = _read_sweep if kind is LidarSensor else _read_cycle
        stated = self._intrinsics("lidars", component.name) if kind is LidarSensor else {}
        extras = MappingProxyType({_ENTRY: MappingProxyType(dict(stated))} if stated else {})
        frames: LazyFrames[Any] = LazyFrames(timestamps_ns, partial(read, component, spans))
        made: Sensor = kind(component.name, frames, extras=extras, **self._placed(component, timestamps_ns))
        return made

    # annotations

    def _cuboids(self) -> Iterator[CuboidAnnotation]:
        components = self.components.get("cuboids", [])
        for component in components:
            prefix = f"{component.name}:" if len(components) > 1 else ""
            tracks: dict[str, list[tuple[int, Float64Array, _Observation]]] = {}
            rows = component.store.attributes(f"{component.key}/cuboids").get("cuboid_track_observations", [])
            for number, row in enumerate(rows if isinstance(rows, list) else []):
                where = f"cuboids/cuboid_track_observations[{number}]"
                try:
                    one = msgspec.convert(row, _Observation)
                except msgspec.ValidationError as error:
                    self.ledger.fault("boxes", self._fault(component, where, str(error)))
                    continue
                world_from_ref = self._at(one.reference_frame_id, one.reference_frame_timestamp_us * _MICROSECOND)
                if world_from_ref is None:
                    problem = f"no pose of {one.reference_frame_id!r} at {one.reference_frame_timestamp_us} µs"
                    self.ledger.fault("boxes-without-pose", self._fault(component, where, problem))
                    continue
                box = _box_in_world(one.bbox3, world_from_ref)
                if not np.isfinite(box).all() or min(one.bbox3.dim) <= 0:
                    problem = f"bbox3 {row['bbox3']}; expected finite numbers and sizes above 0"
                    self.ledger.fault("boxes", self._fault(component, where, problem))
                    continue
                tracks.setdefault(one.track_id, []).append((one.timestamp_us, box, one))
            for track_id, observed in tracks.items():
                yield self._cuboid(component, prefix + track_id, observed)

    def _cuboid(
        self, component: _Component, track_id: str, observed: list[tuple[int, Float64Array, "_Observation"]]
    ) -> CuboidAnnotation:
        observed.sort(key=lambda entry: entry[0])
        times, first = np.unique(np.array([time for time, _, _ in observed], np.int64), return_index=True)
        repeated = len(observed) - len(times)
        if repeated:
            location, message = f"{component.store.path}: {component.key}", "several boxes of a track at one time"
            self.ledger.note(WarningKind.SKIPPED, "boxes-repeated", location, f"{message}; the first", count=repeated)
        kept = [observed[k] for k in first.tolist()]
        times_ns = times * _MICROSECOND
        values = np.array([box for _, box, _ in kept])
        sources = tuple(one.source for _, _, one in kept)
        attributes = (AttributePath("source", sources, times_ns),) if any(sources) else ()
        label = kept[0][2].class_id
        return CuboidAnnotation(id=track_id, path=CuboidPath(times_ns, values), label=label, attributes=attributes)


_Triple = tuple[float, float, float]


class _Box(msgspec.Struct):
    centroid: _Triple
    dim: _Triple
    rot: _Triple


class _Observation(msgspec.Struct):
    track_id: str
    class_id: str
    timestamp_us: int
    reference_frame_id: str
    reference_frame_timestamp_us: int
    bbox3: _Box
    source: str = ""

    def __post_init__(self) -> None:
        if not all(0 <= time <= _LATEST_US for time in (self.timestamp_us, self.reference_frame_timestamp_us)):
            raise ValueError(f"a time of {self.timestamp_us}; expected 0 to {_LATEST_US} µs")


def _located(error: SceneloomError, component: _Component) -> SceneloomError:
    return error if isinstance(error, DataError) else DataError(component.store.path, component.key, str(error))


def _whole(values: Any) -> Int64Array:
    """(N,) times [µs]; ValueError where one is none."""
    times = np.array(values, np.int64).reshape(-1)
    if len(times) and not (times.min() >= 0 and times.max() <= _LATEST_US):
        raise ValueError(f"times from {times.min()} to {times.max()}; expected 0 to {_LATEST_US} µs")
    return times


def _frames_of(name: str) -> tuple[str, str]:
    """The two frames that a key such as `('rig', 'world')` names."""
    try:
        source, target = ast.literal_eval(name)
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError(f"{name!r} names no two frames") from error
    return str(source), str(target)


def _rigid(matrices: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Translations (N, 3) and quaternions (N, 4), scalar last, of matrices (N, 4, 4)."""
    if not np.isfinite(matrices).all() or not np.allclose(matrices[:, 3], [0, 0, 0, 1], atol=1e-6):
        raise ValueError("a matrix that is no transform")
    rotations = matrices[:, :3, :3]
    products = rotations @ rotations.transpose(0, 2, 1)
    if not np.allclose(products, np.eye(3), atol=1e-3) or not (np.linalg.det(rotations) > 0).all():
        raise ValueError("a matrix whose upper left part is no rotation")
    return matrices[:, :3, 3], quaternion_from_matrix(rotations)


def _inverted(path: Poses) -> Poses:
    rotations = matrix_from_quaternion(path.quaternions_xyzw).transpose(0, 2, 1)
    positions = -np.einsum("nij,nj->ni", rotations, path.positions)
    return Poses(path.timestamps_ns, positions, quaternion_from_matrix(rotations), static=path.static)


def _box_in_world(box: _Box, world_from_ref: RigidTransform) -> Float64Array:
    """(9,): length, width, height, centre, angles [rad]."""
    centre = world_from_ref.apply(np.array([box.centroid]))
    rotation = matrix_from_quaternion(_BOX_RADIANS.quaternions(np.array([box.rot])))[0]
    angles = _BOX_RADIANS.from_quaternions(quaternion_from_matrix((world_from_ref.rotation @ rotation)[None]))
    return np.concatenate([box.dim, centre[0], angles[0]])


# frames


def _frame_key(component: _Component, spans: Int64Array, k: int) -> str:
    return f"{component.key}/frames/{int(spans[k, 1])}"


@dataclass(frozen=True, slots=True)
class _StoredImage:
    """An encoded image in a store; called, it gives the image."""

    store: Store
    key: str
    width: int
    height: int

    def _encoded(self) -> EncodedImage:
        content, form = self.store.blob(self.key)
        form = {"jpg": "jpeg"}.get(form.lower(), form.lower())
        if form not in {"jpeg", "png"}:
            raise DataError(self.store.path, self.key, f"format {form!r}; expected jpeg or png")
        return EncodedImage(content, form, self.width, self.height, str(self.store.path), self.key)

    def __call__(self) -> AnyArray:
        return self._encoded()()

    def encoded(self) -> bytes:
        """The bytes of the file."""
        return self._encoded().content

    @property
    def form(self) -> str:
        """`jpeg` or `png`."""
        return str(self.store.attributes(self.key).get("format", ""))


def _read_image(component: _Component, spans: Int64Array, camera: Camera, k: int) -> CameraImage:
    key = f"{_frame_key(component, spans, k)}/image"
    source = _StoredImage(component.store, key, camera.width, camera.height)
    span = tuple(spans[k].tolist())
    encoded = source.encoded if source.form in {"jpeg", "jpg"} else None
    time_ns = int(spans[k].sum()) * (_MICROSECOND // 2)
    return CameraImage(time_ns, camera, source, extras=MappingProxyType({_SPAN: span}), encoded=encoded)


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """The returns of a frame: one row for each that is there, the first returns of all rays before the second."""

    positions: AnyArray
    directions: AnyArray
    timestamps_ns: Int64Array | None
    columns: dict[str, AnyArray]
    extras: dict[str, Any]


def _read_rays(component: _Component, spans: Int64Array, k: int) -> _Rays:
    store, key = component.store, _frame_key(component, spans, k)
    directions = store.array(f"{key}/ray_bundle/direction")
    times = store.array(f"{key}/ray_bundle/timestamp_us")
    distances = store.array(f"{key}/ray_bundle_returns/distance_m")
    count = len(directions)
    if (
        directions.ndim != 2
        or directions.shape[1:] != (3,)
        or times.shape != (count,)
        or distances.shape[1:] != (count,)
    ):
        shapes = f"{directions.shape}, {times.shape}, {distances.shape}"
        problem = f"direction, timestamp_us and distance_m are {shapes}; expected (N, 3), (N,), (R, N)"
        raise DataError(store.path, key, problem)
    if times.dtype.kind not in "iu" or (count and int(times.max()) > _LATEST_US):
        raise DataError(store.path, f"{key}/ray_bundle/timestamp_us", "expected whole microseconds of 64 bits")
    returns, rays = np.nonzero(~np.isnan(distances))
    with np.errstate(over="ignore", invalid="ignore"):
        positions = directions[rays].astype(np.float64) * distances[returns, rays, None]
    columns: dict[str, AnyArray] = {}
    for name in store.names(f"{key}/ray_bundle"):
        if name not in {"direction", "timestamp_us"}:
            columns[name] = store.array(f"{key}/ray_bundle/{name}")
            if len(columns[name]) != count:
                raise DataError(store.path, f"{key}/ray_bundle/{name}", f"{len(columns[name])} rows; expected {count}")
            columns[name] = columns[name][rays]
    for name in store.names(f"{key}/ray_bundle_returns"):
        if name != "distance_m":
            values = store.array(f"{key}/ray_bundle_returns/{name}")
            if values.shape[:2] != distances.shape:
                problem = f"{values.shape}; expected {distances.shape}"
                raise DataError(store.path, f"{key}/ray_bundle_returns/{name}", problem)
            columns[name] = values[returns, rays]
    if len(distances) > 1:
        columns["return_index"] = returns.astype(np.uint8)
    extras: dict[str, Any] = {_SPAN: tuple(spans[k].tolist())}
    others: dict[str, AnyArray] = {}
    for name in store.names(f"{key}/generic_data"):
        values = store.array(f"{key}/generic_data/{name}")
        if values.ndim and len(values) == count and name not in columns:
            columns[name] = values[rays]
        else:
            others[name] = read_only(values)
    stated = store.attributes(f"{key}/generic_data")
    extras |= ({"generic_data": MappingProxyType(others)} if others else {}) | (
        {"generic_meta_data": stated} if stated else {}
    )
    chosen = times[rays].astype(np.int64) * _MICROSECOND
    timed = chosen if len(chosen) and spans[k, 0] != spans[k, 1] else None
    return _Rays(positions.astype(np.float32), directions[rays], timed, columns, extras)


def _taken(columns: dict[str, AnyArray], name: str, dtype: type[Any], width: int | None = None) -> Any:
    """A column that has a field of its own, if it is of its type."""
    values = columns.get(name)
    shape_fits = values is not None and values.shape[1:] == (() if width is None else (width,))
    return read_only(columns.pop(name)) if shape_fits and values is not None and values.dtype == dtype else None


def _read_sweep(component: _Component, spans: Int64Array, k: int) -> LidarFrame:
    rays = _read_rays(component, spans, k)
    columns = rays.columns
    rings = _taken(columns, "ring", np.uint16)
    elements = columns.get("model_element")
    if rings is None and elements is not None and elements.ndim == 2:
        rings = read_only(elements[:, 0], np.uint16)
    intensities = None
    if "intensity" in columns and columns["intensity"].ndim == 1:
        shares = columns["intensity"].astype(np.float64)
        intensities = np.clip(np.rint(np.nan_to_num(shares) * 255.0), 0, 255).astype(np.uint8)
        if np.array_equal(np.float32(intensities / 255.0), np.float32(shares)):
            del columns["intensity"]
    colors, seen = _taken(columns, "rgb", np.uint8, 3), _taken(columns, "camera_index", np.uint8)
    points = LidarPoints(
        read_only(rays.positions),
        None if intensities is None else read_only(intensities),
        colors,
        rays.timestamps_ns,
        rings,
        seen,
        MappingProxyType({name: read_only(values) for name, values in columns.items()}),
    )
    return LidarFrame(int(spans[k, 0]) * _MICROSECOND, points, MappingProxyType(rays.extras))


def _read_cycle(component: _Component, spans: Int64Array, k: int) -> RadarFrame:
    rays = _read_rays(component, spans, k)
    directions = lengths = None
    speeds = rays.columns.get("radial_velocity")
    if speeds is not None and speeds.ndim == 1 and speeds.dtype.kind == "f":
        del rays.columns["radial_velocity"]
        directions = read_only(rays.directions * np.where(speeds < 0, -1, 1)[:, None], np.float32)
        lengths = read_only(np.abs(speeds), np.float32)
    extras = MappingProxyType({name: read_only(values) for name, values in rays.columns.items()})
    points = RadarPoints(read_only(rays.positions), directions, lengths, rays.timestamps_ns, extras)
    return RadarFrame(int(spans[k, 0]) * _MICROSECOND, points, MappingProxyType(rays.extras))


# writing

_IMAGES = ("copy", "png")
_DEFAULT = "default"
_SOURCES = ("AUTOLABEL", "EXTERNAL", "GT_SYNTHETIC", "GT_ANNOTATION")
_MODELS = ("pinhole", "brown_conrady", "fisheye", "ftheta_skewed")
_KINDS: tuple[tuple[type[Any], str], ...] = (
    (CameraSensor, "cameras"),
    (LidarSensor, "lidars"),
    (RadarSensor, "radars"),
)
_OURS = frozenset({_ENTRY, "sceneloom"})


def write_ncore(
    scene: Scene, path: Path, *, overwrite: bool = False, images: str = "copy", trajectory: str | None = None
) -> LossReport:
    """Write a scene as one component store; frames are read, written and released one by one.

    Args:
        overwrite: replace the file.
        images: "copy" copies JPEG and PNG files, and writes others as JPEG; "png" writes those as PNG.
        trajectory: name of the ego's, as of `ego_in_world`.

    Raises:
        OptionError: an option is none of these.
        PoseError: the trajectory cannot be taken.
        CalibrationError: a camera model cannot be computed with.
        DataError: what the scene is read from is damaged, or a time is below 0.
    """
    if images not in _IMAGES:
        raise OptionError(f"images {images!r}; NCore takes {', '.join(_IMAGES)}")
    losses = Losses(loss for loss in field_losses(scene, SUPPORTS) if loss.support is Support.DROPPED)
    unknown = sorted(set(scene.metadata) - _OURS)
    if unknown:
        losses.dropped("metadata", f"there is no field for {', '.join(unknown)}", count=len(unknown))
    inexact = [one.camera.model for one in scene.cameras if not _written_exactly(one.camera)]
    keep = tuple(name for name in _MODELS if name not in inexact)
    scene = with_pinholes(scene, losses, keep=keep)
    ego_path = ego_trajectory(scene) if trajectory is None else None
    if ego_path is None:
        ego, reported = ego_in_world(scene, name=trajectory)
        ego_path = ego.path
        losses.extend(reported)
    check_one_ego(scene, None if ego_path.static else ego_path)
    others = max(len(scene.trajectories) - 1, 0)
    losses.dropped("trajectories", "left out: there is one ego trajectory", count=others)
    with replacing(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        writer = _Writer(scene, StoreWriter(file), ego_path, losses, as_png=images == "png")
        writer.write(path.name.removesuffix(".zarr.itar").removesuffix(".ncore4"))
    return LossReport.of(losses.all)


def _microseconds(timestamps_ns: Int64Array) -> Int64Array:
    """Times in whole microseconds, halves to the later one."""
    return (timestamps_ns + _MICROSECOND // 2) // _MICROSECOND


class _Writer:
    """Writes one scene into one store."""

    def __init__(self, scene: Scene, store: StoreWriter, ego_path: Poses, losses: Losses, *, as_png: bool) -> None:
        self.scene, self.store, self.ego_path, self.losses, self.as_png = scene, store, ego_path, losses, as_png
        self.first_us, self.last_us = _LATEST_US, -1
        self.names: dict[str, None] = {}

    def write(self, name: str) -> None:
        """Write all components, and last what is stated of the sequence."""
        written: list[tuple[str, Any, RigidTransform]] = []
        for kind, group in _KINDS:
            sensors = [sensor for sensor in self.scene.sensors if isinstance(sensor, kind)]
            if sensors:
                self.store.group(group)
            for sensor in sensors:
                mount, reported = mounting(sensor, None if self.ego_path.static else self.ego_path)
                self.losses.extend(reported)
                field = f"sensors.{group[:-1]}"
                if mount is None:
                    what = f"{sensor.id!r}: not known; written as if it were where the ego is"
                    self.losses.approximated(f"{field}.mount", what)
                own = self._name(sensor.id, field)
                self._write_sensor(f"{group}/{own}", sensor, mount or RigidTransform.identity(), field)
                written.append((own, sensor, mount or RigidTransform.identity()))
        boxes = self._observations()
        if boxes:
            self._component("cuboids", _DEFAULT)
            self.store.group(f"cuboids/{_DEFAULT}/cuboids", {"cuboid_track_observations": boxes})
        self._write_intrinsics(written)
        self._write_poses([(own, mount) for own, _, mount in written])
        stated = self.scene.metadata.get(_ENTRY)
        about = stated if isinstance(stated, Mapping) else {}
        generic = about.get("generic_meta_data")
        self.store.group(
            "",
            {
                "sequence_id": str(about.get("sequence_id") or name),
                "sequence_timestamp_interval_us": {"start": self.first_us, "stop": self.last_us + 1},
                "generic_meta_data": dict(generic) if isinstance(generic, Mapping) else {},
                "version": _VERSION,
                "component_group_name": "",
            },
        )
        self.store.finish()

    def _name(self, sensor_id: Any, field: str) -> str:
        """The name of a sensor's component, which is a part of paths and of the names of transforms."""
        plain = "".join(c if c.isalnum() or c in "_-.:" else "_" for c in str(sensor_id)) or "sensor"
        name = plain
        while name in self.names or name in {_RIG, _WORLD}:
            name = f"{plain}_{len(self.names)}"
        self.names[name] = None
        if name != sensor_id:
            self.losses.converted(f"{field}.id", f"{sensor_id!r} becomes {name!r}")
        return name

    def _component(self, kind: str, name: str) -> None:
        """Put the group of the only component of a type."""
        self.store.group(kind)
        self._instance(f"{kind}/{name}")

    def _instance(self, key: str) -> None:
        kind, _, name = key.partition("/")
        about = {"component_name": kind, "component_instance_name": name, "component_version": "v1"}
        self.store.group(key, {**about, "generic_meta_data": {}})

    def _covered(self, times_us: Iterable[int]) -> None:
        """Let the interval of the sequence cover times."""
        for time in times_us:
            if not 0 <= time <= _LATEST_US:
                raise DataError(self.scene.source, "", f"a time of {time} µs; NCore holds times from 0 to {_LATEST_US}")
            self.first_us, self.last_us = min(self.first_us, time), max(self.last_us, time)

    # poses and intrinsics

    def _write_poses(self, mounts: Sequence[tuple[str, RigidTransform]]) -> None:
        path = self.ego_path
        field = "trajectories.positions"
        if self.last_us < 0:
            self._covered(_microseconds(path.timestamps_ns).tolist() if not path.static else [0])
        self.last_us = max(self.last_us, self.first_us + 1)
        own_us = _microseconds(path.timestamps_ns)
        if path.static:
            times_us = np.array([self.first_us, self.last_us], np.int64)
        else:
            inside = (own_us >= self.first_us) & (own_us <= self.last_us)
            what = "poses before the first and after the last frame are left out"
            self.losses.dropped(field, what, count=int((~inside).sum()))
            times_us = np.unique(np.concatenate([own_us[inside], [self.first_us, self.last_us]]))
            beyond = int(self.first_us < own_us[0]) + int(self.last_us > own_us[-1])
            self.losses.approximated(field, "end poses hold from the first frame to the last", count=beyond)
        # poses at their own times, to the nanosecond, wherever there are some
        known = dict(zip(own_us.tolist(), path.timestamps_ns.tolist(), strict=True))
        times_ns = np.array([known.get(time, time * _MICROSECOND) for time in times_us.tolist()], np.int64)
        held = path.held(times_ns)
        matrices = np.tile(np.eye(4), (len(times_us), 1, 1))
        matrices[:, :3, :3], matrices[:, :3, 3] = matrix_from_quaternion(held.quaternions_xyzw), held.positions
        key = f"poses/{_DEFAULT}"
        self._component("poses", _DEFAULT)
        static = {str((name, _RIG)): _pose_row(mount.matrix) for name, mount in mounts}
        self.store.group(f"{key}/static_poses", static)
        row = {"poses": matrices.tolist(), "timestamps_us": times_us.tolist(), "dtype": "float64"}
        self.store.group(f"{key}/dynamic_poses", {str((_RIG, _WORLD)): row})

    def _write_intrinsics(self, written: Sequence[tuple[str, Any, RigidTransform]]) -> None:
        key = f"intrinsics/{_DEFAULT}"
        self._component("intrinsics", _DEFAULT)
        for kind, group in ((CameraSensor, "cameras"), (LidarSensor, "lidars")):
            self.store.group(f"{key}/{group}")
            for name, sensor, _ in written:
                if isinstance(sensor, kind):
                    stated = _stated_intrinsics(sensor)
                    if stated:
                        self.store.group(f"{key}/{group}/{name}", stated)

    # frames

    def _write_sensor(self, key: str, sensor: Any, mount: RigidTransform, field: str) -> None:
        self._instance(key)
        spans: list[tuple[int, int]] = []
        is_camera = isinstance(sensor, CameraSensor)
        part = f"{field}.{'images' if is_camera else 'frames'}"
        frames = sensor.images if is_camera else sensor.frames
        for frame in frames:
            if is_camera:
                span = _span_of_image(frame)
                rays = None
            else:
                rays = self._rays(sensor, frame, mount, part)
                span = rays.span
            if spans and not (span[0] > spans[-1][0] and span[1] > spans[-1][1]):
                self.losses.dropped(part, "frames that neither begin nor end after the one before are left out")
                continue
            self._covered(span)
            spans.append(span)
            here = f"{key}/frames/{span[1]}"
            self.store.group(here)
            off = abs(frame.timestamp_ns - (sum(span) * (_MICROSECOND // 2) if is_camera else span[0] * _MICROSECOND))
            self.losses.converted(
                f"{part}.timestamp_ns", "rounded, or moved to a point's time [ns]", count=int(off > 0), error=float(off)
            )
            if rays is None:
                self._write_image(here, sensor, frame)
            else:
                self._write_rays(here, rays)
            unknown = sorted(set(frame.extras) - {_SPAN, "generic_data", "generic_meta_data"})
            if unknown:
                self.losses.dropped(f"{part}.extras", f"there is no field for {', '.join(unknown)}")
        self.store.group(f"{key}/frames", {"frames_timestamps_us": [*map(list, spans)]})

    def _write_image(self, key: str, sensor: CameraSensor, image: CameraImage) -> None:
        source = image.decode
        if isinstance(source, _StoredImage):
            content, form = source.store.blob(source.key)
        elif image.encoded is not None and not self.as_png:
            content, form = image.encoded(), "jpeg"
        elif isinstance(source, ImageFile) and source.path.suffix.lower() == ".png":
            content, form = source.encoded(), "png"
        elif self.as_png:
            content, form = encode_png(image.rgb), "png"
        else:
            content, form = encode_jpeg(image.rgb), "jpeg"
            self.losses.approximated("sensors.camera.images.rgb", "encoded as JPEG")
        if image.camera != sensor.camera:
            self.losses.dropped("sensors.camera.images.camera", "a camera has one camera model for all images")
        self.store.group(f"{key}/generic_data", {})
        self.store.blob(f"{key}/image", content, form)

    def _rays(self, sensor: Any, frame: Any, mount: RigidTransform, part: str) -> "_WrittenRays":
        points = frame.points
        positions = np.asarray(points.positions, np.float64)
        if sensor.points_frame is not PointsFrame.SENSOR:
            ego = self.ego_path.held(np.array([frame.timestamp_ns], np.int64))
            world_from_ego = RigidTransform.from_quaternion(ego.positions[0], ego.quaternions_xyzw[0])
            here = mount if sensor.points_frame is PointsFrame.EGO else world_from_ego @ mount
            positions = here.inverse().apply(positions)
        finite = finite_rows(positions)
        self.losses.dropped(
            f"{part}.points", "points without a finite location are left out", count=int((~finite).sum())
        )
        distances = np.linalg.norm(positions[finite], axis=1)
        directions = np.tile([1.0, 0.0, 0.0], (len(distances), 1))
        away = distances > 0
        directions[away] = positions[finite][away] / distances[away, None]
        start = stop = int(_microseconds(np.array([frame.timestamp_ns]))[0])
        stated = _stated_span(frame)
        if points.timestamps_ns is None or not finite.any():
            times_us = np.full(len(distances), start, np.int64)
        else:
            times_us = _microseconds(points.timestamps_ns[finite])
            start, stop = min(start, int(times_us.min())), max(stop, int(times_us.max()))
        if stated is not None and (stated == (start, stop) or (stated[0] <= start and stop <= stated[1])):
            start, stop = stated if points.timestamps_ns is not None else (start, stop)
        columns = {name: values[finite] for name, values in points.extras.items() if _is_plain(values, len(finite))}
        others = len(points.extras) - len(columns)
        self.losses.dropped(f"{part}.points.extras", "columns that are no arrays of numbers are left out", count=others)
        returns: dict[str, AnyArray] = {"distance_m": distances.astype(np.float32)[None]}
        if isinstance(frame, LidarFrame):
            returns["intensity"] = self._intensities(frame.points, finite, columns)
            for name, values in (("ring", points.rings), ("rgb", points.colors), ("camera_index", points.camera_index)):
                if values is not None and not (name == "ring" and "model_element" in columns):
                    columns[name] = values[finite]
        elif points.directions is not None and points.lengths is not None:
            velocities = points.directions[finite].astype(np.float64) * points.lengths[finite, None]
            speeds = np.einsum("ij,ij->i", directions, velocities)
            across = np.linalg.norm(velocities - speeds[:, None] * directions, axis=1)
            columns["radial_velocity"] = speeds.astype(np.float32)
            what = "velocities across the ray are left out [m/s]"
            self.losses.approximated(
                f"{part}.points.directions", what, count=int((across > 1e-4).sum()), error=float(across.max(initial=0))
            )
        generic = frame.extras.get("generic_data")
        others_data = {n: np.asarray(v) for n, v in generic.items()} if isinstance(generic, Mapping) else {}
        about = frame.extras.get("generic_meta_data")
        return _WrittenRays(
            (start, stop),
            directions.astype(np.float32),
            times_us,
            returns,
            columns,
            others_data,
            dict(about) if isinstance(about, Mapping) else {},
        )

    def _intensities(self, points: LidarPoints, finite: AnyArray, columns: dict[str, AnyArray]) -> AnyArray:
        own = columns.get("intensity")
        if own is not None and own.ndim == 1 and own.dtype.kind == "f" and ((own >= 0) & (own <= 1)).all():
            del columns["intensity"]
            return own.astype(np.float32)[None]
        if points.intensities is None:
            what = "not known: written as 0"
            self.losses.approximated("sensors.lidar.frames.points.intensities", what, count=int(finite.sum()))
            return np.zeros((1, int(finite.sum())), np.float32)
        return (points.intensities[finite] / 255.0).astype(np.float32)[None]

    def _write_rays(self, key: str, rays: "_WrittenRays") -> None:
        count = len(rays.directions)
        self.store.group(f"{key}/generic_data", rays.about)
        elements = rays.columns.pop("model_element", None)
        for name, values in (rays.others | rays.columns).items():
            self.store.array(f"{key}/generic_data/{name}", values)
        self.store.group(f"{key}/ray_bundle", {"n_rays": count})
        self.store.array(f"{key}/ray_bundle/direction", rays.directions)
        self.store.array(f"{key}/ray_bundle/timestamp_us", rays.times_us.astype(np.uint64))
        if elements is not None and elements.shape[1:] == (2,):
            self.store.array(f"{key}/ray_bundle/model_element", elements.astype(np.uint16))
        self.store.group(f"{key}/ray_bundle_returns", {"n_returns": 1})
        for name, values in rays.returns.items():
            self.store.array(f"{key}/ray_bundle_returns/{name}", values, chunks=(1, count))
        valid = np.packbits(np.ones(count, np.bool_))
        stated = {"n_returns": 1, "n_rays": count}
        self.store.array(f"{key}/ray_bundle_returns_valid_mask_packed", valid, attributes=stated)

    # boxes

    def _observations(self) -> list[dict[str, Any]]:
        angles, kind = CuboidAngles.of(self.scene), "annotations.cuboid"
        rows: list[dict[str, Any]] = []
        for one in self.scene.annotations:
            if not isinstance(one, CuboidAnnotation):
                continue
            times_ns = one.path.timestamps_ns
            boxes = cuboid_poses(one, times_ns, angles=angles)
            finite = finite_rows(np.hstack([boxes.centers_world, boxes.sizes_lwh, boxes.quaternions_xyzw]))
            self.losses.dropped(
                f"{kind}.path", "boxes that are no finite numbers are left out", count=int((~finite).sum())
            )
            euler = _BOX_RADIANS.from_quaternions(
                np.where(finite[:, None], boxes.quaternions_xyzw, [0.0, 0.0, 0.0, 1.0])
            )
            times_us = _microseconds(times_ns)
            sources = next((path for path in one.attributes if path.name == "source"), None)
            stated = (
                {int(t): v for t, v in zip(sources.timestamps_ns.tolist(), sources.values, strict=False)}
                if sources is not None and sources.timestamps_ns is not None
                else {}
            )
            self._report_cuboid(one, kind)
            for k in np.flatnonzero(finite).tolist():
                time, source = int(times_us[k]), stated.get(int(times_ns[k]))
                self._covered([time])
                rows.append(
                    {
                        "track_id": str(one.id),
                        "class_id": one.label or "unknown",
                        "timestamp_us": time,
                        "reference_frame_id": _WORLD,
                        "reference_frame_timestamp_us": time,
                        "bbox3": {
                            "centroid": boxes.centers_world[k].tolist(),
                            "dim": boxes.sizes_lwh[k].tolist(),
                            "rot": euler[k].tolist(),
                        },
                        "source": source if source in _SOURCES else "EXTERNAL",
                        "source_version": None,
                    }
                )
        return rows

    def _report_cuboid(self, one: CuboidAnnotation, kind: str) -> None:
        others = sum(path.name != "source" for path in one.attributes)
        self.losses.dropped(f"{kind}.attributes", "attributes are left out", count=others)
        for name in ("activations", "projections", "extras"):
            self.losses.dropped(f"{kind}.{name}", "left out", count=len(getattr(one, name)))
        for name in ("parent_id", "stationary"):
            self.losses.dropped(f"{kind}.{name}", "left out", count=int(getattr(one, name) is not None))
        self.losses.dropped(f"{kind}.path.extras", "left out", count=len(one.path.extras))


@dataclass(frozen=True, slots=True, eq=False)
class _WrittenRays:
    span: tuple[int, int]  # [µs]
    directions: AnyArray
    times_us: Int64Array
    returns: dict[str, AnyArray]
    columns: dict[str, AnyArray]  # per ray
    others: dict[str, AnyArray]
    about: dict[str, Any]


def _pose_row(matrix: Float64Array) -> dict[str, Any]:
    return {"pose": matrix.tolist(), "dtype": "float64"}


def _stated_span(frame: Any) -> tuple[int, int] | None:
    """Start and end of a frame that was read from NCore [µs]."""
    span = frame.extras.get(_SPAN)
    if isinstance(span, list | tuple) and len(span) == 2 and all(type(n) is int for n in span) and span[0] <= span[1]:
        return span[0], span[1]
    return None


def _span_of_image(image: CameraImage) -> tuple[int, int]:
    stated = _stated_span(image)
    if stated is not None and sum(stated) * (_MICROSECOND // 2) == image.timestamp_ns:
        return stated
    time = int(_microseconds(np.array([image.timestamp_ns]))[0])
    return time, time


def _is_plain(values: Any, count: int) -> bool:
    return isinstance(values, np.ndarray) and values.dtype.kind in "fiub" and values.ndim > 0 and len(values) == count


def _stated_intrinsics(sensor: CameraSensor | LidarSensor) -> dict[str, Any]:
    """Intrinsics as they were read, where they still are those of the camera; else stated anew."""
    kept = sensor.extras.get(_ENTRY)
    stated = dict(kept) if isinstance(kept, Mapping) else {}
    if isinstance(sensor, LidarSensor):
        return stated
    parameters = stated.get("camera_model_parameters")
    if isinstance(parameters, Mapping):
        try:
            if camera_of(str(stated.get("camera_model_type")), parameters)[0] == sensor.camera:
                return stated
        except CalibrationError:
            pass  # they are not those of this camera
    kind, made = parameters_of(sensor.camera)
    return {"camera_model_type": kind, "camera_model_parameters": made}
