"""Folders of Scale's lidar toolkit: clouds, poses and cameras. Only read."""

from pathlib import Path

from sceneloom.formats.base.spec import FormatSpec

CLOUDS = (".ply", ".pcd")


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


FORMAT = FormatSpec(
    name="scale-toolkit",
    title="a folder of Scale's lidar toolkit",
    looks_like="a folder with pointcloud/1.ply, poses/1.json and cameras/NAME/extrinsics.json",
    suffixes=(".scale-toolkit",),
    sniff=_recognises,
    near_miss=_near_miss,
    reader="sceneloom.formats.scale_toolkit.reader:open_scale_toolkit",
    read_options=("lenient", "rate_hz"),
    instead="folders of Scale's lidar toolkit are only read; write a scene file (drive.sfs), which Scale's own library "
    "reads with --profile scale",
)
