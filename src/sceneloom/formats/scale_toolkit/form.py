"""What folders of Scale's lidar toolkit offer to the table of formats."""

from pathlib import Path

from sceneloom.formats.folder_form import FolderFormat
from sceneloom.formats.scale_toolkit.scene_from_folder import open_scale_toolkit
from sceneloom.formats.scale_toolkit.sensors import CLOUDS


def _recognises(path: Path) -> bool:
    """Whether a path is a folder with clouds, and with poses or cameras beside them."""
    return _has_clouds(path) and (
        any((path / "poses").glob("*.json")) or any((path / "cameras").glob("*/extrinsics.json"))
    )


def _near_miss(path: Path) -> str | None:
    if path.is_dir() and any((path / "cameras").glob("*/extrinsics.json")):
        return "it has cameras/*/extrinsics.json, but no pointcloud/*.ply or *.pcd"
    return None


def _has_clouds(path: Path) -> bool:
    folder = path / "pointcloud"
    return folder.is_dir() and any(file.suffix.lower() in CLOUDS for file in folder.iterdir())


FORMAT = FolderFormat(
    name="scale-toolkit",
    called="a folder of Scale's lidar toolkit",
    looks_like="a folder with pointcloud/1.ply, poses/1.json and cameras/NAME/extrinsics.json",
    suffixes=(".scale-toolkit",),
    recogniser=_recognises,
    missing=_near_miss,
    reader=open_scale_toolkit,
    reading_options=("lenient", "rate_hz"),
    refusal="folders of Scale's lidar toolkit are only read; write a scene file (drive.sfs), which Scale's own library "
    "reads with --profile scale",
)
"""Folders of Scale's lidar toolkit as one of the formats."""
