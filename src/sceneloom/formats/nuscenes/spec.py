"""The nuScenes schema and its dialect T4: a data set as a folder of tables, and the files of its sensors."""

from pathlib import Path
from types import MappingProxyType

from sceneloom.formats.base.losses import KEPT, Supports, converted, dropped
from sceneloom.formats.base.spec import FormatSpec

_MARKS = ("sample_data", "ego_pose", "calibrated_sensor")
"""Tables that only nuScenes has; a folder with one of them is taken as (perhaps incomplete) nuScenes data."""

T4 = "annotation"
"""The folder of the tables of T4, which stands in that of the data set or in one of its versions (`0`, `1`)."""


def table_folders(path: Path) -> list[Path]:
    """The folders with tables: those of a data set, or the path itself."""
    if not path.is_dir():
        return []
    if _has_tables(path):
        return [path]
    children = [*sorted(path.glob("v[0-9]*")), path / T4, *sorted(path.glob(f"[0-9]*/{T4}"))]
    return [child for child in children if child.is_dir() and _has_tables(child)]


def _has_tables(folder: Path) -> bool:
    return any((folder / f"{name}.json").is_file() for name in _MARKS)


def _near_miss(path: Path) -> str | None:
    if path.is_dir() and (path / "samples").is_dir() and not table_folders(path):
        return "it has samples/ as nuScenes has, but no folder of tables (v1.0-mini/sample_data.json …)"
    return None


def _scene_names(path: Path) -> tuple[str, ...]:
    from sceneloom.formats.nuscenes.reader import scene_names

    return scene_names(path)


_NO_POSITION = dropped("the tables have no field for it")
_NEW = converted("the tables state it anew, what nuScenes has no such fields for is dropped")
_MICROSECONDS = converted("whole microseconds, halves to the even one")
_POSES = converted("the ego's pose at each frame, and the mounting")
_WORLD = converted("poses lead into the world")
_OWN_FRAME = converted("points are in the sensor's own frame")
_POSED = ("sensors.lidar", "sensors.radar", "sensors.camera")
_SWEPT = ("sensors.lidar", "sensors.radar")
_OF_POSES = ("timestamps_ns", "positions", "quaternions_xyzw")

SUPPORTS: Supports = MappingProxyType(
    {
        "": _NO_POSITION,
        "sensors.order": converted("lidars, radars, cameras, each by name"),
        **{f"{kind}.id": converted("names are texts") for kind in _POSED},
        **{f"{kind}.poses": _POSES for kind in _POSED},
        **{f"{kind}.coordinates": _WORLD for kind in _POSED},
        **{f"{kind}.mount": converted("quaternion and translation") for kind in _POSED},
        **{f"{kind}.extras": _NEW for kind in _POSED},
        **{f"{kind}.points_frame": _OWN_FRAME for kind in _SWEPT},
        **{f"{kind}.frames.timestamp_ns": _MICROSECONDS for kind in _SWEPT},
        **{f"{kind}.frames.extras": _NEW for kind in _SWEPT},
        **{f"{kind}.frames.points.positions": converted("in the sensor's own frame, float32") for kind in _SWEPT},
        "sensors.lidar.frames.points.intensities": KEPT,
        "sensors.lidar.frames.points.rings": KEPT,
        "sensors.radar.frames.points.directions": converted("with the lengths, as vx and vy"),
        "sensors.radar.frames.points.lengths": converted("with the directions, as vx and vy"),
        "sensors.radar.frames.points.extras": converted("the columns of nuScenes' radars, in their types"),
        "sensors.camera.camera": KEPT,
        "sensors.camera.video": converted("decoded, a file for each image"),
        "sensors.camera.images.timestamp_ns": _MICROSECONDS,
        "sensors.camera.images.camera": converted("a row of camera model and mounting for each that an image has"),
        "sensors.camera.images.mount": converted("quaternion and translation"),
        "sensors.camera.images.rgb": KEPT,
        "sensors.camera.images.encoded": KEPT,
        "sensors.camera.images.extras": _NEW,
        "annotations.order": converted("cuboids, then classes of points"),
        "annotations.cuboid.id": converted("tokens are texts"),
        "annotations.cuboid.label": converted("a category; of objects without a class `unknown`"),
        "annotations.cuboid.path.timestamps_ns": converted("boxes are reported at the samples"),
        "annotations.cuboid.path.values": converted("boxes at the samples, rotated by quaternions"),
        "annotations.cuboid.path.extras": _NEW,
        "annotations.cuboid.attributes": converted("names, visibility and numbers of points, reported at the samples"),
        "annotations.labeled_points": converted("a file of classes for each key frame"),
        "annotations.labeled_points.id": converted("`lidarseg:` and the name of the class"),
        "annotations.labeled_points.label": converted("a category"),
        "annotations.labeled_points.extras": converted("the number of the class"),
        "annotations.labeled_points.attributes": _NO_POSITION,
        "annotations.labeled_points.parent_id": _NO_POSITION,
        "annotations.labeled_points.type": converted("`labeled_points`"),
        "trajectories.name": converted("it is `pose`"),
        **{f"trajectories.{name}": converted("a pose at each frame") for name in _OF_POSES},
        "metadata": converted("what was read from such tables is written again"),
    }
)

FORMAT = FormatSpec(
    name="nuscenes",
    title="nuScenes",
    looks_like="a folder with v1.0-mini/sample_data.json and the other tables of nuScenes, or T4's annotation/",
    sniff=lambda path: bool(table_folders(path)),
    near_miss=_near_miss,
    drives=_scene_names,
    reader="sceneloom.formats.nuscenes.reader:open_nuscenes",
    read_options=("lenient", "sequence", "keyframes"),
    writer="sceneloom.formats.nuscenes.writer:write_nuscenes",
    write_options=("version", "keyframe_rate_hz", "images", "channel", "trajectory"),
    supports=SUPPORTS,
    along_trajectory=True,
)
