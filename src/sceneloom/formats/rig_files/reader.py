"""Reads files of mountings and camera models: URDF, Kalibr, OpenCV, ROS, Autoware, basalt, `tf_static`, `rig.toml`."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import MODEL_ALIASES, OPENCV_LENGTHS, Camera, from_opencv
from sceneloom.cameras.projection import check_camera
from sceneloom.errors import CalibrationError, DataError, OptionError, UnknownFormatError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import LARGEST_SETTINGS, read_bytes, why_no_file
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.spec import first_bytes
from sceneloom.formats.base.xml_files import xml_root
from sceneloom.formats.base.yaml_files import read_yaml
from sceneloom.geometry.rigid import GREATEST_ERROR, SILENT_ERROR, RigidTransform, normalise_quaternion
from sceneloom.lazy import imported
from sceneloom.warnings import WarningKind


@dataclass(frozen=True, slots=True, eq=False)
class RigTransform:
    """Where a frame is in its parent: `parent_from_child`, and where that is stated."""

    parent: str
    child: str
    parent_from_child: RigidTransform
    location: str


@dataclass(frozen=True, slots=True, eq=False)
class RigCamera:
    """The camera model of a camera.

    Attributes:
        names: what the camera is called: its frame, its own name, the file's.
        camera: the camera model, for the images of the calibration.
        location: where it is stated.
        topic: of its images; "" where it is not stated.
    """

    names: tuple[str, ...]
    camera: Camera
    location: str
    topic: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """What some files state together.

    Attributes:
        files: by name, for messages.
        transforms: between frames, in the order of the files.
        cameras: camera models.
        topics: the topic of a frame's sensor, by the frame.
        optical: frames of cameras that look along z, as their kind of file has it; those that are matched are added.
        stated: frame or camera name by the id of a sensor, or by "ego", as a person stated it.
        ledger: what was assumed or left out.
    """

    files: tuple[str, ...]
    transforms: tuple[RigTransform, ...] = ()
    cameras: tuple[RigCamera, ...] = ()
    topics: Mapping[str, str] = field(default_factory=dict)
    optical: set[str] = field(default_factory=set)
    stated: Mapping[str, str] = field(default_factory=dict)
    ledger: Ledger = field(default_factory=lambda: Ledger(lenient=False))

    @property
    def frames(self) -> list[str]:
        """All frames, each once."""
        return [*dict.fromkeys(name for one in self.transforms for name in (one.parent, one.child))]


def read_rig(files: Any, names: Any = None) -> Rig:
    """Read files of a rig.

    Args:
        files: a path, or several.
        names: what the files call a sensor (its frame or camera) by the sensor's id, and the ego's frame by "ego"; or
            texts such as "lidar=velodyne".

    Raises:
        DataError: a file is missing, of no known kind, or states something impossible.
        OptionError: a name is not stated as SENSOR=NAME.
        MissingExtraError: what reads a file is not installed.
    """
    paths = [Path(one) for one in ([files] if isinstance(files, str | Path) else files)]
    stated = (
        dict(names)
        if isinstance(names, Mapping)
        else dict(map(_pair, [names] if isinstance(names, str) else names or ()))
    )
    drafts = [_Draft(path) for path in paths]
    for draft in drafts:
        _read(draft)
    first = Rig(tuple(path.name for path in paths), stated=MappingProxyType(stated))
    for draft in drafts:
        for code, message in draft.notes:
            first.ledger.note(WarningKind.SKIPPED, code, draft.path.name, message)
    return replace(
        first,
        transforms=tuple(one for draft in drafts for one in draft.transforms),
        cameras=tuple(one for draft in drafts for one in draft.cameras),
        topics=MappingProxyType({frame: topic for draft in drafts for frame, topic in draft.topics.items()}),
        optical={frame for draft in drafts for frame in draft.optical},
    )


def _pair(text: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not (name and sign and value):
        raise OptionError(f"rig name {text!r}; expected SENSOR=NAME, as in lidar=velodyne")
    return name, value


@dataclass(slots=True)
class _Draft:
    """What one file states, as far as it is read."""

    path: Path
    transforms: list[RigTransform] = field(default_factory=list)
    cameras: list[RigCamera] = field(default_factory=list)
    topics: dict[str, str] = field(default_factory=dict)
    optical: set[str] = field(default_factory=set)
    notes: list[tuple[str, str]] = field(default_factory=list)

    def mount(self, parent: str, child: str, pose: RigidTransform, location: str) -> None:
        """Add a transform."""
        if parent == child:
            raise DataError(self.path, location, f"from frame {parent!r} to itself; expected two frames")
        self.transforms.append(RigTransform(parent, child, pose, f"{self.path.name}: {location}"))


_KINDS = (
    "URDF, Kalibr's camchain, a camera of OpenCV, VINS or ROS (camera_info), Autoware's sensor_kit_calibration.yaml, "
    "basalt's calibration.json, a bag with tf_static, or rig.toml"
)
_BAGS = (b"#ROSBAG V", b"SQLite format 3\x00", b"\x89MCAP0\r\n")


def _read(draft: _Draft) -> None:
    path = draft.path
    begins = first_bytes(path, 256)
    if path.is_dir() or begins.startswith(_BAGS):
        return _read_bag(draft)
    if not path.is_file():
        raise DataError(path, "", f"{why_no_file(path)}; expected {_KINDS}")
    try:
        size = path.stat().st_size
        if size > LARGEST_SETTINGS:
            raise DataError(path, "", f"{size} bytes; expected {_KINDS}")
        start = begins.removeprefix(b"\xef\xbb\xbf").lstrip()[:1]
        if path.suffix.lower() == ".toml":
            return _read_manifest(draft)
        if start == b"<":
            return _read_urdf(draft)
        if start == b"{":
            return _read_basalt(draft)
        return _read_yaml_file(draft)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error


# Values of files with their locations


@dataclass(frozen=True, slots=True)
class _Value:
    """A value of a file, and where it stands."""

    path: Path
    location: str
    value: Any

    def fault(self, problem: str) -> DataError:
        return DataError(self.path, self.location, problem)

    def __contains__(self, name: str) -> bool:
        return isinstance(self.value, dict) and name in self.value

    def __getitem__(self, name: str) -> "_Value":
        if not isinstance(self.value, dict):
            raise self.fault(f"{_shown(self.value)}; expected a mapping with {name!r}")
        if name not in self.value:
            raise self.fault(f"no {name!r}; it has {', '.join(map(str, self.value)) or 'nothing'}")
        return _Value(self.path, f"{self.location}.{name}".lstrip("."), self.value[name])

    def first_of(self, names: Iterable[str]) -> "_Value":
        """The value of the first of some names that is there; the first is asked for where none is."""
        names = tuple(names)
        return self[next((name for name in names if name in self), names[0])]

    def items(self) -> Iterator[tuple[str, "_Value"]]:
        """The names of a mapping, with their values."""
        if not isinstance(self.value, dict):
            raise self.fault(f"{_shown(self.value)}; expected a mapping")
        return (
            (str(name), _Value(self.path, f"{self.location}.{name}".lstrip("."), inner))
            for name, inner in self.value.items()
        )

    def elements(self) -> list["_Value"]:
        """The elements of a list."""
        if not isinstance(self.value, list):
            raise self.fault(f"{_shown(self.value)}; expected a list")
        return [_Value(self.path, f"{self.location}[{k}]", inner) for k, inner in enumerate(self.value)]

    def numbers(self, *counts: int) -> list[float]:
        """The numbers of lists, one in another or not, or of a matrix with data; as many as one of some counts."""
        value = self.value["data"] if "data" in self else self.value
        found: list[float] = []
        waiting = [value]
        while waiting:
            one = waiting.pop()
            if isinstance(one, list):
                waiting += reversed(one)
            elif isinstance(one, int | float) and not isinstance(one, bool) and abs(one) < _GREATEST:
                found.append(float(one))
            else:
                raise self.fault(f"{_shown(one)}; expected numbers within {_GREATEST:g}")
        if counts and len(found) not in counts:
            raise self.fault(f"{len(found)} numbers; expected {' or '.join(map(str, counts))}")
        return found

    def number(self) -> float:
        return self.numbers(1)[0]

    def text(self) -> str:
        if not isinstance(self.value, str) or not self.value:
            raise self.fault(f"{_shown(self.value)}; expected a text")
        return self.value

    def transform(self, notes: list[tuple[str, str]]) -> RigidTransform:
        """The transform of a 4x4 or 3x4 matrix, by rows."""
        matrix = np.array(self.numbers(16, 12)).reshape(-1, 4)
        try:
            with np.errstate(all="ignore"):  # files hold numbers that are none
                transform, error = RigidTransform.nearest(matrix)
        except CalibrationError as fault:
            raise self.fault(str(fault)) from None
        if not error <= GREATEST_ERROR:
            found = "mirrored or singular" if error == math.inf else f"off by {error:.2g} (max abs of R Rᵀ - I)"
            raise self.fault(f"rotation {found}; expected an orthonormal right-handed one within {GREATEST_ERROR:g}")
        if error > SILENT_ERROR:
            notes.append(
                ("rotation-normalised", f"{self.location}: rotation off by {error:.2g}; the nearest was taken")
            )
        return transform


_GREATEST = 1e6


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


# URDF

_JOINTS = ("fixed", "revolute", "continuous", "prismatic", "floating", "planar")
_XACRO = re.compile(rb"<xacro:|\$\{|\$\(")


def _read_urdf(draft: _Draft) -> None:
    """Read the joints of a robot.

    Source: "URDF XML specification", joint, of the ROS documentation; `quat_xyzw` is of URDF 1.1.
    """
    path, content = draft.path, read_bytes(draft.path)
    if _XACRO.search(content):
        raise DataError(path, "", f"is xacro with macros; expand them first: xacro {path.name} > rig.urdf")
    root = xml_root(path, content)
    if root.tag != "robot":
        raise DataError(path, "", f"root element {root.tag!r}; expected <robot> of a URDF")
    moving, parents = [], dict[str, str]()
    for number, joint in enumerate(root.findall("joint"), 1):
        name = joint.get("name") or f"number {number}"
        location = f"joint {name!r}"
        kind = joint.get("type")
        if kind not in _JOINTS:
            raise DataError(path, location, f"type {kind!r}; expected one of {', '.join(_JOINTS)}")
        parent, child = (_link(draft, joint, location, role) for role in ("parent", "child"))
        if child in parents:
            raise DataError(
                path, location, f"child link {child!r} is also that of {parents[child]}; expected one parent"
            )
        parents[child] = location
        if kind == "fixed":
            draft.mount(parent, child, _origin(draft, joint.find("origin"), location), location)
        else:
            moving.append(f"{name} ({parent} to {child})")
    if not parents:
        raise DataError(path, "", "no joints; expected fixed ones between the frames of the sensors")
    if moving:
        draft.notes.append(("moving-joints", f"{len(moving)} joints move and are not used: {', '.join(moving)}"))


def _link(draft: _Draft, joint: ET.Element, location: str, role: str) -> str:
    element = joint.find(role)
    link = None if element is None else element.get("link")
    if not link:
        raise DataError(draft.path, location, f'no <{role} link="…">')
    return link


def _origin(draft: _Draft, origin: ET.Element | None, location: str) -> RigidTransform:
    if origin is None:
        return RigidTransform.identity()
    if origin.get("rpy") is not None and origin.get("quat_xyzw") is not None:
        raise DataError(draft.path, f"{location} origin", "rpy beside quat_xyzw; expected one of them")

    def numbers(name: str, default: str, count: int) -> list[float]:
        where = f"{location} origin {name}"
        text = origin.get(name, default)
        try:
            found: list[Any] = [float(word) for word in text.split()]
        except ValueError:
            found = [text]
        return _Value(draft.path, where, found).numbers(count)

    position = np.array(numbers("xyz", "0 0 0", 3))
    if origin.get("quat_xyzw") is None:
        return RigidTransform.from_quaternion(position, quaternion_of_rpy(*numbers("rpy", "0 0 0", 3)))
    return _of_quaternion(_Value(draft.path, f"{location} origin quat_xyzw", numbers("quat_xyzw", "", 4)), position)


def _of_quaternion(value: _Value, position: Float64Array) -> RigidTransform:
    quaternion = np.array(value.numbers(4))
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 0.01:
        raise value.fault(f"quaternion {quaternion.tolist()} of length {norm:.4g}; expected 1 within 0.01")
    # as transforms of messages are read
    return RigidTransform.from_quaternion(position, normalise_quaternion(quaternion))


def quaternion_of_rpy(roll: float, pitch: float, yaw: float) -> Float64Array:
    """Give the (4,) quaternion x y z w of Rz(yaw) Ry(pitch) Rx(roll), angles in radians.

    Source: `Rotation::setFromRPY` of urdfdom_headers, by which publishers of a URDF's frames go.
    """
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(angle / 2.0), math.cos(angle / 2.0)) for angle in (roll, pitch, yaw))
    quaternion = [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
    return normalise_quaternion(np.array(quaternion))


# Bags and manifests


def _read_bag(draft: _Draft) -> None:
    """Read the fixed transforms of a bag."""
    from sceneloom.formats.base.registry import find_format

    path = draft.path
    if path.is_dir() and (path / "rig.toml").is_file():
        draft.path = path / "rig.toml"
        _read_manifest(draft)
        return
    try:
        form = find_format(path).name
    except UnknownFormatError as error:
        raise DataError(path, "", f"{error.problem}; expected {_KINDS}") from error
    opener = {"ros1": "ros", "ros2": "ros", "mcap": "mcap"}.get(form)
    if opener is None:
        raise DataError(path, "", f"is a drive of format {form}; expected {_KINDS}")
    log = imported(f"sceneloom.formats.messages.{opener}:open_log")(path, Ledger(lenient=False))
    try:
        fixed, moving = imported("sceneloom.formats.messages.reader:fixed_transforms")(log)
    finally:
        log.close()
    if not fixed:
        others = f"; frames that move, or may: {', '.join(moving)}" if moving else ""
        raise DataError(path, "", f"no transforms on tf_static{others}; expected those of the sensors")
    for parent, child, pose in fixed:
        draft.mount(parent, child, pose, f"tf_static {parent!r} to {child!r}")
    if moving:
        draft.notes.append(("moving-frames", f"frames that are not on tf_static are not used: {', '.join(moving)}"))


def _read_manifest(draft: _Draft) -> None:
    edges, cameras = imported("sceneloom.formats.rig.reader:read_frames_and_cameras")(draft.path)
    for source, target, pose, location in edges:
        draft.mount(target, source, pose, location)
        draft.optical |= {target, source}  # a camera's frame is optical in a manifest
    for name, frame, camera, location in cameras:
        draft.cameras.append(RigCamera(tuple(dict.fromkeys((name, frame))), camera, f"{draft.path.name}: {location}"))
        draft.optical.add(frame)
    if not (draft.transforms or draft.cameras):
        raise DataError(
            draft.path, "", "no transforms and no camera models; expected `[[transforms]]` or `[[sensors]]`"
        )


# YAML

_CAMERA, _IMU = re.compile(r"cam\d+"), re.compile(r"imu\d+")
_ANGLES = ("x", "y", "z", "roll", "pitch", "yaw")
_BODY = "imu0"  # the frame of Kalibr's first IMU, which VINS and basalt call body and imu
_MATRICES = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_COEFFICIENTS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D")


def _read_yaml_file(draft: _Draft) -> None:
    root = _Value(draft.path, "", read_yaml(draft.path))
    if not isinstance(root.value, dict):
        raise root.fault(f"{_shown(root.value)}; expected {_KINDS}")
    names = list(map(str, root.value))
    cameras = sorted((name for name in names if _CAMERA.fullmatch(name)), key=lambda name: int(name[3:]))
    imus = [name for name in names if _IMU.fullmatch(name)]
    if cameras:
        _read_camchain(draft, root, cameras)
    elif imus and any("T_i_b" in root[name] for name in imus):
        _read_imu_chain(draft, root, imus)
    elif any(name.startswith("body_T_cam") or name == "extrinsicRotation" for name in names):
        _read_vins(draft, root)
    elif "model_type" in root or any(name in root for name in _MATRICES):
        draft.cameras.append(_read_camera_file(draft, root))
    elif any(
        all(letter in mounted for letter in "xyz")
        for _, kit in root.items()
        if isinstance(kit.value, dict)
        for _, mounted in kit.items()
    ):
        for parent, kit in root.items():
            for child, mounted in kit.items():
                x, y, z, *rpy = (mounted[name].number() for name in _ANGLES)
                pose = RigidTransform.from_quaternion(np.array([x, y, z]), quaternion_of_rpy(*rpy))
                draft.mount(parent, child, pose, f"{parent}.{child}")
    else:
        raise root.fault(f"has {', '.join(names[:8]) or 'nothing'}; expected {_KINDS}")


def _read_camchain(draft: _Draft, root: _Value, cameras: Sequence[str]) -> None:
    """Read a chain of cameras. Source: "YAML formats" of Kalibr's documentation; T_imu_cam is what OpenVINS writes."""
    for k, name in enumerate(cameras):
        value = root[name]
        draft.optical.add(name)
        if "T_cam_imu" in value:
            draft.mount(_BODY, name, value["T_cam_imu"].transform(draft.notes).inverse(), f"{name}.T_cam_imu")
        elif "T_imu_cam" in value:
            draft.mount(_BODY, name, value["T_imu_cam"].transform(draft.notes), f"{name}.T_imu_cam")
        if "T_cn_cnm1" in value and k:
            pose = value["T_cn_cnm1"].transform(draft.notes).inverse()
            draft.mount(cameras[k - 1], name, pose, f"{name}.T_cn_cnm1")
        topic = value["rostopic"].text() if "rostopic" in value else ""
        if topic:
            draft.topics[name] = topic
        if "intrinsics" in value:
            width, height = value["resolution"].numbers(2)
            model = value["camera_model"].text()
            distortion = value["distortion_model"].text() if "distortion_model" in value else "none"
            coefficients = value["distortion_coeffs"].numbers() if "distortion_coeffs" in value else []
            numbers = _Numbers(draft, value, (width, height), coefficients)
            camera = numbers.of_model(model, distortion, value["intrinsics"].numbers())
            draft.cameras.append(RigCamera((name,), camera, f"{draft.path.name}: {name}", topic))
        if "timeshift_cam_imu" in value and (shift := value["timeshift_cam_imu"].number()):
            draft.notes.append(("time-shift-not-applied", f"{name}.timeshift_cam_imu {shift:g} s is not applied"))


def _read_imu_chain(draft: _Draft, root: _Value, imus: Sequence[str]) -> None:
    for name in imus:
        value = root[name]
        if "rostopic" in value:
            draft.topics[name] = value["rostopic"].text()
        if "T_i_b" in value and name != _BODY:
            draft.mount(_BODY, name, value["T_i_b"].transform(draft.notes).inverse(), f"{name}.T_i_b")
    if not draft.topics and not draft.transforms:
        raise root.fault(f"no rostopic of {_BODY} and no other IMU; expected one of them")


def _read_vins(draft: _Draft, root: _Value) -> None:
    """Read a configuration of VINS, whose matrices take points of a camera into the body's frame."""
    if "imu_topic" in root:
        draft.topics[_BODY] = root["imu_topic"].text()
    cameras = [(name, name.removeprefix("body_T_")) for name, _ in root.items() if name.startswith("body_T_cam")]
    value = root
    if not cameras:
        # VINS-Mono and LVI-SAM have one camera, in two matrices
        blocks = root["extrinsicRotation"].numbers(9), root["extrinsicTranslation"].numbers(3)
        matrix = np.hstack([np.array(blocks[0]).reshape(3, 3), np.array(blocks[1])[:, None]])
        value = _Value(draft.path, "", {"extrinsicRotation": matrix.tolist()})
        cameras = [("extrinsicRotation", root["camera_name"].text() if "camera_name" in root else "cam0")]
    for name, frame in cameras:
        draft.optical.add(frame)
        draft.mount(_BODY, frame, value[name].transform(draft.notes), name)
        topic_key, file_key = (
            ("image_topic", "") if value is not root else (f"image{frame[3:]}_topic", f"{frame}_calib")
        )
        topic = root[topic_key].text() if topic_key in root else ""
        if topic:
            draft.topics[frame] = topic
        held = root if value is not root and "model_type" in root else None
        if file_key in root:
            file = draft.path.parent / root[file_key].text()
            if file.is_file():
                held = _Value(file, "", read_yaml(file))
            else:
                draft.notes.append(
                    ("camera-file-missing", f"{file_key} {root[file_key].value!r}: no such file beside it")
                )
        if held is not None:
            one = _read_camera_file(draft, held)
            draft.cameras.append(replace(one, names=tuple(dict.fromkeys((frame, *one.names))), topic=topic))


def _read_camera_file(draft: _Draft, root: _Value) -> RigCamera:
    """Read one camera: of OpenCV's calibration, of ROS (camera_info), or of camodocal, which VINS uses."""
    names = [root["camera_name"].text()] if "camera_name" in root else []
    size = tuple(
        root.first_of((f"image_{axis}", f"image_{axis.title()}", axis)).number() for axis in ("width", "height")
    )
    if "model_type" in root:
        camera = _camodocal(draft, root, size)
    else:
        k = root.first_of(_MATRICES).numbers(9)
        if abs(k[1]) > _SKEW * abs(k[0]) or max(map(abs, (k[3], k[6], k[7], k[8] - 1.0))) > _SKEW:
            raise root.first_of(_MATRICES).fault(f"{k}; expected [fx 0 cx; 0 fy cy; 0 0 1], row by row")
        distortion = root["distortion_model"].text() if "distortion_model" in root else "opencv"
        if "fisheye_model" in root and root["fisheye_model"].number():
            distortion = "fisheye"
        held = any(name in root for name in _COEFFICIENTS)
        coefficients = root.first_of(_COEFFICIENTS).numbers() if held else []
        camera = _Numbers(draft, root, size, coefficients).of_model("pinhole", distortion, [k[0], k[4], k[2], k[5]])
    return RigCamera(tuple(dict.fromkeys((*names, root.path.stem))), camera, root.path.name)


_SKEW = 1e-3


def _camodocal(draft: _Draft, root: _Value, size: tuple[float, ...]) -> Camera:
    """Read a camera of camodocal. Source: its `CataCamera`, `PinholeCamera` and `EquidistantCamera`."""

    def several(group: str, names: str) -> list[float]:
        return [root[group][name].number() for name in names.split()]

    kind = root["model_type"].text().upper()
    if kind == "KANNALA_BRANDT":
        coefficients = several("projection_parameters", "k2 k3 k4 k5")
        numbers = several("projection_parameters", "mu mv u0 v0")
        return _Numbers(draft, root, size, coefficients).of_model("pinhole", "equidistant", numbers)
    if kind not in {"PINHOLE", "MEI"}:
        raise root["model_type"].fault(f"{kind!r}; expected PINHOLE, MEI or KANNALA_BRANDT")
    read = _Numbers(draft, root, size, several("distortion_parameters", "k1 k2 p1 p2"))
    if kind == "PINHOLE":
        return read.of_model("pinhole", "radtan", several("projection_parameters", "fx fy cx cy"))
    xi, plane = root["mirror_parameters"]["xi"].number(), several("projection_parameters", "gamma1 gamma2 u0 v0")
    return read.of_model("omni", "radtan", [xi, *plane])


def _read_basalt(draft: _Draft) -> None:
    """Read a calibration of basalt. Source: `calibration.hpp` of its headers, as cereal writes it."""
    content: Any = read_json(draft.path, object)
    root = _Value(draft.path, "", content)
    if "value0" not in root or "T_imu_cam" not in root["value0"]:
        raise root.fault(f"has {', '.join(map(str, list(content)[:8])) or 'nothing'}; expected {_KINDS}")
    root = root["value0"]
    mounted, models = root["T_imu_cam"].elements(), root["intrinsics"].elements()
    sizes = root["resolution"].elements()
    if not len(mounted) == len(models) == len(sizes):
        problem = f"{len(mounted)} poses, {len(models)} intrinsics, {len(sizes)} resolutions; expected as many of each"
        raise root.fault(problem)
    for k, (pose, model, size) in enumerate(zip(mounted, models, sizes, strict=True)):
        name = f"cam{k}"
        position = np.array([pose[axis].number() for axis in ("px", "py", "pz")])
        quaternion = _Value(draft.path, pose.location, [pose[axis].number() for axis in ("qx", "qy", "qz", "qw")])
        draft.optical.add(name)
        draft.mount(_BODY, name, _of_quaternion(quaternion, position), pose.location)
        width, height = size.numbers(2)
        camera = _basalt_camera(draft, model, (width, height))
        draft.cameras.append(RigCamera((name,), camera, f"{draft.path.name}: {model.location}"))


_BASALT: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {
        **{model: (model, "none", "") for model in ("pinhole", "ds", "eucm", "ucm")},
        "pinhole-radtan8": ("pinhole", "radtan", "k1 k2 p1 p2 k3 k4 k5 k6"),
        "kb4": ("pinhole", "equidistant", "k1 k2 k3 k4"),
        "fov": ("pinhole", "fov", "w"),
    }
)
"""By the name of a model: what `of_model` calls it and its distortion, and the numbers of that."""


def _basalt_camera(draft: _Draft, value: _Value, size: tuple[float, ...]) -> Camera:
    kind = value["camera_type"].text()
    if kind not in _BASALT:
        raise value["camera_type"].fault(f"{kind!r}; expected one of {', '.join(_BASALT)}")
    model, distortion, names = _BASALT[kind]
    numbers = [value["intrinsics"][name].number() for name in (*_OWN_NUMBERS[model].split(), "fx", "fy", "cx", "cy")]
    coefficients = [value["intrinsics"][name].number() for name in names.split()]
    return _Numbers(draft, value, size, coefficients).of_model(model, distortion, numbers)


# Camera models

_DISTORTIONS: Mapping[str, str] = MappingProxyType(
    {name: model for name, model in MODEL_ALIASES.items() if model in {"brown_conrady", "fisheye"}}
    | {"fisheye": "fisheye", "none": "pinhole", "": "pinhole", "fov": "fov"}
)
_LENGTHS = {"brown_conrady": OPENCV_LENGTHS, "fisheye": (4,), "pinhole": (0,), "fov": (1,)}
_OWN_NUMBERS = {"pinhole": "", "omni": "xi", "ds": "xi alpha", "eucm": "alpha beta", "ucm": "alpha"}
_POLYNOMIAL, _FITTED_ANGLES, _FITTED_POWERS = "fisheye_rad_tan_prism", 400, 7

_Radius = Callable[[Float64Array], Float64Array]


@dataclass(frozen=True, slots=True)
class _Numbers:
    """What is known of a camera beside its model: where it stands, its image size and its distortion."""

    draft: _Draft
    value: _Value
    size: tuple[float, ...]
    coefficients: list[float]

    def of_model(self, model: str, distortion: str, numbers: list[float]) -> Camera:
        """Build the camera model; one that we do not have becomes one that we have, with a warning of the difference.

        Args:
            model: as Kalibr calls it.
            distortion: as Kalibr, ROS or OpenCV call it.
            numbers: the model's own, then focal lengths and principal point.
        """
        if model not in _OWN_NUMBERS:
            raise self.value.fault(f"camera model {model!r}; expected one of {', '.join(_OWN_NUMBERS)}")
        kind = _DISTORTIONS.get(distortion.lower().replace("-", "_"))
        if kind is None or (model != "pinhole" and kind not in {"pinhole", "brown_conrady"}):
            raise self.value.fault(
                f"distortion {distortion!r} of {model}; expected one of {', '.join(filter(None, _DISTORTIONS))}"
            )
        coefficients = self.coefficients
        while kind in {"brown_conrady", "pinhole"} and coefficients and not any(coefficients):
            coefficients = []
        lengths = _LENGTHS[kind] if model == "pinhole" else (0, 4) if model == "omni" else (0,)
        if len(coefficients) not in lengths:
            expected = " or ".join(map(str, lengths))
            raise self.value.fault(f"{len(coefficients)} coefficients of {distortion}; expected {expected}")
        own = _OWN_NUMBERS[model].split()
        if len(numbers) != len(own) + 4:
            raise self.value.fault(f"{len(numbers)} intrinsics of {model}; expected {' '.join((*own, 'fx fy cx cy'))}")
        *first, fx, fy, cx, cy = numbers
        if model == "pinhole" and kind == "fov":
            (w,) = coefficients
            if not 0.0 < w < math.pi:
                raise self.value.fault(f"w {w:g} of fov; expected more than 0 and less than π")
            return self._fitted("fov", partial(_field_of_view, w), fx, fy, cx, cy)
        if model == "pinhole":
            coefficients = [*from_opencv(coefficients)]
            return self._camera(kind if coefficients else "pinhole", fx, fy, cx, cy, coefficients)
        if model == "ucm" and 0.0 <= first[0] < 1.0:
            # the unified model is that of a mirror without distortion, with xi = α / (1 - α)
            rest = 1.0 - first[0]
            return self._camera("omnidir", fx / rest, fy / rest, cx, cy, [0.0, 0.0, 0.0, first[0] / rest, 0.0, 0.0])
        if model == "omni":
            k1, k2, p1, p2 = coefficients or [0.0] * 4
            return self._camera("omnidir", fx, fy, cx, cy, [k1, k2, 0.0, first[0], p1, p2])
        if not 0.0 <= first[-1 if model == "ds" else 0] <= 1.0:
            raise self.value.fault(f"alpha {first[-1 if model == 'ds' else 0]:g} of {model}; expected 0 to 1")
        return self._fitted(model, partial(_RADII[model], *first), fx, fy, cx, cy)

    def _camera(self, model: str, fx: float, fy: float, cx: float, cy: float, coefficients: Sequence[float]) -> Camera:
        width, height = self.size
        if width != int(width) or height != int(height):
            raise self.value.fault(f"image size {width}x{height}; expected whole numbers of pixels")
        try:
            camera = Camera(model, int(width), int(height), fx, fy, cx, cy, tuple(coefficients))
            check_camera(camera)
        except CalibrationError as error:
            raise self.value.fault(str(error)) from None
        return camera

    def _fitted(self, model: str, radius: _Radius, fx: float, fy: float, cx: float, cy: float) -> Camera:
        """The nearest polynomial in the angle off the axis, by least squares over what the image shows."""
        if not (min(*self.size, fx, fy) > 0):
            raise self.value.fault(f"image size {self.size}, focal lengths {fx}, {fy}; expected positive numbers")
        width, height = self.size
        corner = math.hypot(max(cx + 0.5, width - 0.5 - cx) / fx, max(cy + 0.5, height - 0.5 - cy) / fy)
        angles = np.linspace(0.0, math.pi, 20_001)[1:-1]
        with np.errstate(all="ignore"):
            radii = radius(angles)
        sound = np.isfinite(radii) & (radii < corner) & (np.diff(radii, prepend=0.0) > 0)
        count = int(np.argmin(sound)) if not sound.all() else len(sound)
        if count < _FITTED_ANGLES:
            raise self.value.fault(
                f"{model} camera model that sees less than {count * math.pi / 20_000:.2g} rad off its axis"
            )
        rows = np.linspace(0, count - 1, _FITTED_ANGLES).astype(np.int64)
        powers = angles[rows, None] ** (2 * np.arange(_FITTED_POWERS) + 1)
        scale = powers.max(axis=0)
        found = np.linalg.lstsq(powers / scale, radii[rows], rcond=None)[0] / scale
        off = float(np.abs(powers @ found - radii[rows]).max()) * max(fx, fy)
        message = f"{self.value.location}: {model} camera model as {_POLYNOMIAL}, off by up to {off:.2g} px"
        self.draft.notes.append(("camera-model-fitted", message.removeprefix(": ")))
        slope, *rest = found.tolist()
        coefficients = [*(one / slope for one in rest), *(0.0,) * 6]
        return self._camera(_POLYNOMIAL, fx * slope, fy * slope, cx, cy, coefficients)


def _double_sphere(xi: float, alpha: float, angles: Float64Array) -> Float64Array:
    depth = xi + np.cos(angles)
    radii: Float64Array = np.sin(angles) / (alpha * np.hypot(np.sin(angles), depth) + (1.0 - alpha) * depth)
    return radii


def _unified(alpha: float, beta: float, angles: Float64Array) -> Float64Array:
    sine, cosine = np.sin(angles), np.cos(angles)
    radii: Float64Array = sine / (alpha * np.sqrt(beta * sine**2 + cosine**2) + (1.0 - alpha) * cosine)
    return radii


def _field_of_view(w: float, angles: Float64Array) -> Float64Array:
    radii: Float64Array = np.arctan2(2.0 * np.sin(angles) * math.tan(w / 2.0), np.cos(angles)) / w
    return radii


_RADII: Mapping[str, Callable[..., Float64Array]] = MappingProxyType(
    {"ds": _double_sphere, "eucm": _unified, "ucm": lambda alpha, angles: _unified(alpha, 1.0, angles)}
)
"""How far from the principal point, in focal lengths, a model puts what is an angle [rad] off its axis.

Source: Usenko and others 2018, "The Double Sphere Camera Model", for UCM, EUCM and DS; Devernay and Faugeras 2001 for
the field-of-view model.
"""
