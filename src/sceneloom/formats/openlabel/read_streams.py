"""The streams of a file as sensors, whose frames are elsewhere."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.openlabel.camera_models import read_camera_model
from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.openlabel.systems import Systems
from sceneloom.formats.openlabel.words import OURS, SENSOR_TYPES
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import Identifier
from sceneloom.scene.warnings import WarningKind


def nothing_to_read(number: int) -> NoReturn:
    """Refuse to read a frame: there are none.

    Raises:
        OptionError: always.
    """
    raise OptionError(f"frame {number}: an OpenLABEL file holds no frames of sensors")


def _no_frames() -> LazyFrames[Any]:
    return LazyFrames(np.zeros(0, np.int64), nothing_to_read)


def read_streams(document: Part, systems: Systems, ledger: Ledger) -> tuple[Sensor, ...]:
    """Read all streams, placed by the coordinate systems of their names.

    Raises:
        DataError: one is wrong.
    """
    found = tuple(_sensor(name, stream, systems, ledger) for name, stream in document.each("streams"))
    if found:
        reported = "OpenLABEL names sensors and holds what is stated for their frames, but not the frames"
        ledger.note(
            WarningKind.SKIPPED,
            "frames-elsewhere",
            f"{document.file}: openlabel.streams",
            reported,
            count=len(found),
        )
    return found


def _sensor(name: str, stream: Part, systems: Systems, ledger: Ledger) -> Sensor:
    kind = "other" if stream.get("type") is None else stream.need("type").text()
    if kind not in SENSOR_TYPES:
        raise stream.need("type").fault(f"one of {', '.join(SENSOR_TYPES)}")
    properties = stream.get("stream_properties") or Part(
        stream.file, f"{stream.location}.stream_properties", {}
    )
    ours = properties.members().get(OURS)
    ours = ours if isinstance(ours, dict) else {}
    sensor_id: Identifier = ours["id"] if isinstance(ours.get("id"), int | str) else name
    stated = ours.get("type")
    further = {
        key: value for key, value in stream.members().items() if key not in {"type", "stream_properties"}
    }
    rest = {
        key: value for key, value in properties.members().items() if key not in {OURS, "intrinsics_pinhole"}
    }
    if kind != "camera" and rest:
        further["stream_properties"] = rest
    placed = _placed(name, systems)
    extras = MappingProxyType(further)
    build = _BUILDERS.get(
        stated if isinstance(stated, str) and stated in _BUILDERS else _DEFAULTS.get(kind, kind)
    )
    camera_model = read_camera_model(properties) if kind == "camera" else None
    if kind == "camera" and camera_model is not None:
        return CameraSensor(sensor_id, camera_model, _no_frames(), extras=extras, **placed)
    if build is not None and kind != "camera":
        return build(sensor_id, placed, extras)
    if kind == "camera":
        reported = "its camera model is not stated, or of a model that is not known; kept as it stands"
        ledger.note(
            WarningKind.SKIPPED, "camera-model-not-read", f"{stream.file}: {stream.location}", reported
        )
    return PlainSensor(sensor_id, f"openlabel_{kind}", MappingProxyType(dict(stream.members())))


def _placed(name: str, systems: Systems) -> dict[str, Any]:
    """The poses of a sensor in the root, and its mounting on the ego where there is one."""
    if name not in systems.names:
        return {}
    chain, ego = systems.chain(name), systems.ego
    found: dict[str, Any] = {"poses": systems.path_to(name, chain[-1])}
    if ego is None and len(chain) > 1:
        # nothing moves: the root may be the vehicle as well as the world
        ego = chain[-1]
    mount = None if ego is None or ego == name else systems.path_to(name, ego)
    if mount is not None and mount.static:
        found["mount"] = RigidTransform.from_quaternion(mount.positions[0], mount.quaternions_xyzw[0])
    if len(chain) == 1:
        del found["poses"]
    return found


def _lidar(sensor_id: Identifier, placed: dict[str, Any], extras: Mapping[str, Any]) -> Sensor:
    return LidarSensor(sensor_id, _no_frames(), extras=extras, **placed)


def _radar(sensor_id: Identifier, placed: dict[str, Any], extras: Mapping[str, Any]) -> Sensor:
    return RadarSensor(sensor_id, _no_frames(), extras=extras, **placed)


def _imu(sensor_id: Identifier, placed: dict[str, Any], extras: Mapping[str, Any]) -> Sensor:
    del placed
    return ImuSensor(sensor_id, {}, extras=extras)


def _gnss(sensor_id: Identifier, placed: dict[str, Any], extras: Mapping[str, Any]) -> Sensor:
    none = np.zeros(0)
    return GnssSensor(
        sensor_id,
        np.zeros(0, np.int64),
        np.zeros((0, 3)),
        none,
        none,
        mount=placed.get("mount"),
        extras=extras,
    )


_BUILDERS: Mapping[str, Callable[[Identifier, dict[str, Any], Mapping[str, Any]], Sensor]] = MappingProxyType(
    {"lidar": _lidar, "radar": _radar, "imu": _imu, "gnss": _gnss}
)
"""By the types of our model."""

_DEFAULTS = {"gps_imu": "gnss"}
"""Types of our model by those of streams, where they differ."""


def ego_path(systems: Systems) -> tuple[str, Poses] | None:
    """The name and the ego trajectory in its root; None where nothing moves."""
    ego = systems.ego
    if ego is None:
        return None
    path = systems.path_to(ego, systems.chain(ego)[-1])
    return None if path is None else (ego, path)
