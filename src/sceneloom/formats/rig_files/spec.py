"""URDF, Kalibr's camchain and ROS's camera_info of a drive's rig: supported fields. Written; read with `--rig`."""

from types import MappingProxyType

from sceneloom.formats.base.losses import KEPT, Supports, approximated, converted, dropped
from sceneloom.formats.base.spec import FormatSpec

_RIG_ONLY = dropped("left out: the target holds a rig, and no data")
_INSTEAD = "{} holds no drive; state it beside one with `--rig FILE`"
_KINDS = ("lidar", "radar", "camera", "depth_camera", "gnss")
_CAMERAS = ("camera", "depth_camera")
_MODEL = approximated("the nearest of the target's camera models, exact for its own")


def _of(kinds: tuple[str, ...], *fields: str) -> Supports:
    known = {"id": KEPT, "mount": converted("a transform from the frame base_link"), "camera": _MODEL}
    mounted = {f"sensors.{kind}.{name}": known[name] for kind in kinds for name in fields}
    return MappingProxyType({"": _RIG_ONLY, **mounted})


URDF = FormatSpec(
    name="urdf",
    title="a URDF",
    looks_like="an XML file of a robot, with a fixed joint for each sensor",
    suffixes=(".urdf",),
    writer="sceneloom.formats.rig_files.writer:write_urdf",
    supports=_of(_KINDS, "id", "mount"),
    instead=_INSTEAD.format("a URDF"),
)
KALIBR = FormatSpec(
    name="kalibr",
    title="Kalibr's camchain",
    looks_like="a YAML file with cam0, cam1 and so on, their intrinsics and T_cn_cnm1",
    suffixes=("-camchain.yaml",),
    writer="sceneloom.formats.rig_files.writer:write_kalibr",
    supports=_of(_CAMERAS, "id", "mount", "camera"),
    instead=_INSTEAD.format("a camchain"),
)
CAMERA_INFO = FormatSpec(
    name="camera-info",
    title="ROS's camera_info",
    looks_like="a folder with a YAML file for each camera, as ROS's camera_calibration writes them",
    suffixes=(".camera_info",),
    writer="sceneloom.formats.rig_files.writer:write_camera_info",
    supports=_of(_CAMERAS, "id", "camera"),
    instead=_INSTEAD.format("a folder of camera_info"),
)
