"""Tasks of tools that label point clouds: how they are recognised, their options and supported fields."""

import re
from collections.abc import Mapping
from functools import partial
from itertools import islice
from pathlib import Path
from types import MappingProxyType

from sceneloom.formats.base.losses import KEPT, Holding, Supports, approximated, converted, dropped
from sceneloom.formats.base.spec import FormatSpec, any_drive, drives_in, first_bytes

_ROOM = "sceneloom.formats.cloud_labelling"

_NONE = dropped("left out: a task of labels has no field for it")
_TIMES = converted("names of files are times in nanoseconds")

_OF_TASKS: Mapping[str, Holding] = MappingProxyType(
    {
        "": _NONE,
        "sensors.order": converted("the lidar, then cameras by name"),
        "sensors.lidar.id": converted("`lidar`"),
        "sensors.lidar.poses": converted("the frame of each cloud, as far as the tool has poses"),
        "sensors.lidar.coordinates": converted("poses lead into the world"),
        "sensors.lidar.mount": approximated("the ego is where the cloud's frame is"),
        "sensors.lidar.points_frame": converted("the sensor's, or the world where that is asked for or usual"),
        "sensors.lidar.extras": converted("the scale of the brightness is seen in the files; others are dropped"),
        "sensors.lidar.frames.timestamp_ns": _TIMES,
        "sensors.lidar.frames.extras": converted("names of files are given anew; others are dropped"),
        "sensors.lidar.frames.points.positions": converted("in the frame of the cloud, float32"),
        "sensors.lidar.frames.points.intensities": converted("float32 of 0 to 1"),
        "sensors.lidar.frames.points.colors": KEPT,
        "sensors.lidar.frames.points.rings": KEPT,
        "sensors.lidar.frames.points.camera_index": KEPT,
        "sensors.lidar.frames.points.timestamps_ns": dropped("left out: labels hold for the whole cloud"),
        "sensors.lidar.frames.points.extras": converted("columns, if they are numbers with a row per point"),
        "sensors.camera.id": converted("names are texts"),
        "sensors.camera.camera": KEPT,
        "sensors.camera.poses": approximated("the camera in the frame of the nearest cloud, at its time"),
        "sensors.camera.coordinates": converted("poses lead into the world"),
        "sensors.camera.mount": converted("the camera in the frame of the nearest cloud, for each image"),
        "sensors.camera.video": converted("decoded, a file for each image"),
        "sensors.camera.images.timestamp_ns": KEPT,
        "sensors.camera.images.camera": KEPT,
        "sensors.camera.images.mount": converted("the camera in the frame of the nearest cloud, for each image"),
        "sensors.camera.images.rgb": KEPT,
        "sensors.camera.images.encoded": KEPT,
        "sensors.camera.images.extras": converted("names of files are given anew; others are dropped"),
        "annotations.order": converted("cuboids, then labelled points"),
        "annotations.cuboid.id": KEPT,
        "annotations.cuboid.label": KEPT,
        "annotations.cuboid.path.timestamps_ns": converted("boxes are stated in frames"),
        "annotations.cuboid.path.values": converted("boxes in frames"),
        "annotations.cuboid.activations": converted("boxes are in the frames in which the lidar sees them"),
        "annotations.cuboid.attributes": converted("stated in frames"),
    }
)

_LABELED_POINTS: Mapping[str, Holding] = MappingProxyType(
    {
        "annotations.labeled_points.id": KEPT,
        "annotations.labeled_points.label": KEPT,
        "annotations.labeled_points.is_instance": converted("each is taken for one object"),
        "annotations.labeled_points.type": converted("`labeled_points`"),
        "annotations.labeled_points.labeled_points.sensor_id": KEPT,
        "annotations.labeled_points.labeled_points.point_ids": KEPT,
        "annotations.labeled_points.labeled_points.sensor_frame": KEPT,
    }
)

_OPTIONS = ("lidar", "points_frame", "trajectory")


# Supervisely


def _is_dataset(path: Path) -> bool:
    """Whether a folder is a dataset of point clouds: of an episode, or of single clouds with labels."""
    if (path / "annotation.json").is_file() and (path / "frame_pointcloud_map.json").is_file():
        return True
    return (path / "pointcloud").is_dir() and any((path / "ann").glob("*.pcd.json"))


def supervisely_datasets(path: Path) -> list[Path]:
    """The datasets of a project, each below its `meta.json`; or the one that a folder is."""
    if not path.is_dir():
        return []
    if _is_dataset(path) and not (path / "meta.json").is_file():
        return drives_in(path, _is_dataset) if (path.resolve().parent / "meta.json").is_file() else []
    if not (path / "meta.json").is_file():
        return []
    return [child for child in sorted(path.iterdir()) if child.is_dir() and _is_dataset(child)]


def _supervisely_near_miss(path: Path) -> str | None:
    if path.is_dir() and _is_dataset(path):
        return "it is a dataset of Supervisely, but meta.json of the project is not above it"
    return None


SUPERVISELY_SUPPORTS: Supports = MappingProxyType(
    {
        **_OF_TASKS,
        **_LABELED_POINTS,
        "annotations.cuboid.id": converted("a key where it is one, else a tag of the object"),
        "annotations.cuboid.attributes": converted("tags of objects, in ranges of frames"),
        "annotations.labeled_points.id": converted("a key where it is one, else a tag of the object"),
        "attributes": converted("tags of the dataset, in ranges of frames"),
        "metadata": converted("what was read from such a project is written again"),
    }
)

SUPERVISELY = FormatSpec(
    name="supervisely",
    title="a project of Supervisely",
    looks_like="a folder with meta.json and DATASET/annotation.json, frame_pointcloud_map.json, pointcloud/, or "
    "DATASET/ann/, pointcloud/",
    suffixes=(".supervisely",),
    sniff=lambda path: bool(supervisely_datasets(path)),
    near_miss=_supervisely_near_miss,
    drives=supervisely_datasets,
    reader=f"{_ROOM}.supervisely:open_supervisely",
    read_options=("lenient", "rate_hz", "sequence"),
    writer=f"{_ROOM}.supervisely:write_supervisely",
    write_options=("project", "dataset", *_OPTIONS),
    supports=SUPERVISELY_SUPPORTS,
    along_trajectory=True,
)


# Segments.ai

_BEGINNING = 1 << 20
_MOST_LOOKED_AT = 20
_SEGMENTS_TASK = re.compile(rb'"task_type"\s*:\s*"(pointcloud-(cuboid|segmentation)(-sequence)?|multisensor-sequence)"')


def segments_release(path: Path) -> Path | None:
    """The JSON file of a release with point clouds: the path, or the only one in a folder; None where there is none."""
    if path.is_dir():
        found = [*islice(path.glob("*.json"), 2)]
        return segments_release(found[0]) if len(found) == 1 else None
    if path.suffix.lower() != ".json":
        return None
    start = first_bytes(path, _BEGINNING)
    return path if b'"dataset"' in start and _SEGMENTS_TASK.search(start) else None


def _sample_names(path: Path) -> tuple[str, ...]:
    from sceneloom.formats.cloud_labelling.segments import sample_names

    return sample_names(path)


SEGMENTS_SUPPORTS: Supports = MappingProxyType(
    {
        **_OF_TASKS,
        **_LABELED_POINTS,
        "sensors.lidar.poses": converted("the pose of each cloud, `ego_pose`"),
        "annotations.cuboid.id": converted("a number, or an attribute beside a number"),
        "annotations.cuboid.attributes": converted("texts, whole numbers, true or false, in each frame"),
        "annotations.cuboid.path.values": converted("boxes in frames, with yaw and quaternion"),
        "annotations.labeled_points.id": converted("a number, or an attribute beside a number"),
        "trajectories.name": converted("it is `pose`"),
        **{
            f"trajectories.{name}": converted("the pose of each cloud")
            for name in ("timestamps_ns", "positions", "quaternions_xyzw")
        },
    }
)

SEGMENTS = FormatSpec(
    name="segments",
    title="a release of Segments.ai",
    looks_like="a .json file with a dataset whose task_type is pointcloud-cuboid-sequence or the like, or its folder "
    "(built to the description)",
    suffixes=(".segments",),
    sniff=lambda path: segments_release(path) is not None,
    drives=_sample_names,
    reader=f"{_ROOM}.segments:open_segments",
    read_options=("labelset", "lenient", "rate_hz", "sequence"),
    writer=f"{_ROOM}.segments:write_segments",
    write_options=("task", *_OPTIONS),
    supports=SEGMENTS_SUPPORTS,
    along_trajectory=True,
)


# Scale


def scale_frames(path: Path) -> list[Path]:
    """The files of a task's frames, by name."""
    folder = path / "frames"
    return sorted(folder.glob("*.json")) if folder.is_dir() else []


def _is_scale_task(path: Path) -> bool:
    """Whether a folder has frames with a device and points; the first one is looked into."""
    first = next(iter(scale_frames(path)), None) if path.is_dir() else None
    if first is None:
        return False
    start = first_bytes(first, _BEGINNING)
    return b'"device_position"' in start or (b'"points"' in start and (path / "annotations.json").is_file())


SCALE_SUPPORTS: Supports = MappingProxyType(
    {
        **_OF_TASKS,
        "sensors.lidar.poses": converted("position and heading of the device in each frame"),
        "sensors.lidar.points_frame": converted("the world"),
        "sensors.lidar.extras": _NONE,
        "sensors.lidar.frames.timestamp_ns": KEPT,
        "sensors.lidar.frames.points.positions": converted("in the world, to 0.01 mm"),
        "sensors.lidar.frames.points.intensities": converted("0 to 1"),
        "sensors.lidar.frames.points.timestamps_ns": converted("`t` of each point"),
        **{f"sensors.lidar.frames.points.{name}": _NONE for name in ("colors", "rings", "camera_index", "extras")},
        "annotations.order": converted("by frames"),
        "annotations.cuboid.id": converted("texts; those of whole numbers are read as these"),
        "annotations.cuboid.stationary": converted("stated in each frame"),
        "annotations.cuboid.path.values": converted("position, dimensions and yaw in frames"),
        "trajectories.name": converted("it is `pose`"),
        **{
            f"trajectories.{name}": converted("where the device is in each frame")
            for name in ("timestamps_ns", "positions", "quaternions_xyzw")
        },
    }
)

SCALE_TASK = FormatSpec(
    name="scale-task",
    title="a lidar task of Scale",
    looks_like="a folder with frames/*.json of points and device_position, task.json, annotations.json (built to the "
    "description)",
    suffixes=(".scale-task",),
    sniff=_is_scale_task,
    reader=f"{_ROOM}.scale:open_scale_task",
    read_options=("lenient", "rate_hz"),
    writer=f"{_ROOM}.scale:write_scale_task",
    write_options=("lidar", "trajectory"),
    supports=SCALE_SUPPORTS,
    along_trajectory=True,
)


# SUSTechPOINTS

SUSTECH_CLOUDS = (".pcd", ".bin")


def _is_sustech(path: Path) -> bool:
    """Whether a folder has clouds in lidar/, and labels, camera images or calibrations of the tool beside it."""
    lidar = path / "lidar"
    if not lidar.is_dir() or not any((path / name).is_dir() for name in ("label", "camera", "calib")):
        return False
    clouds = any(one.suffix.lower() in SUSTECH_CLOUDS for one in islice(lidar.iterdir(), _MOST_LOOKED_AT))
    labels = next(iter((path / "label").glob("*.json")), None)
    labelled = labels is not None and (b'"psr"' in first_bytes(labels, _BEGINNING) or labels.stat().st_size < _FEW)
    return clouds and (labelled or any((path / "calib").glob("camera/*.json")) or not (path / "label").is_dir())


_FEW = 32  # bytes of a file without boxes

sustech_scenes = partial(drives_in, is_drive=_is_sustech)
"""The scenes of a folder."""

SUSTECH_SUPPORTS: Supports = MappingProxyType(
    {
        **_OF_TASKS,
        "sensors.lidar.poses": converted("the pose of each cloud, lidar_pose/"),
        "sensors.camera.images.timestamp_ns": approximated("images have the time of their cloud"),
        "annotations.cuboid.id": converted("texts; those of whole numbers are read as these"),
        "annotations.cuboid.attributes": converted("`obj_attr` in each frame"),
        "trajectories.name": converted("it is `pose`"),
        **{
            f"trajectories.{name}": converted("the pose of each cloud, lidar_pose/")
            for name in ("timestamps_ns", "positions", "quaternions_xyzw")
        },
    }
)

SUSTECHPOINTS = FormatSpec(
    name="sustechpoints",
    title="a scene of SUSTechPOINTS",
    looks_like="a folder with lidar/*.pcd, and label/*.json, camera/NAME/*.jpg, calib/camera/NAME.json (built to the "
    "description)",
    suffixes=(".sustechpoints",),
    sniff=partial(any_drive, is_drive=_is_sustech),
    drives=sustech_scenes,
    reader=f"{_ROOM}.sustechpoints:open_sustechpoints",
    read_options=("lenient", "rate_hz", "sequence"),
    writer=f"{_ROOM}.sustechpoints:write_sustechpoints",
    write_options=_OPTIONS,
    supports=SUSTECH_SUPPORTS,
    along_trajectory=True,
)
