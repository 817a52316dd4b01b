"""What the nuScenes schema offers to the table of formats."""

from pathlib import Path

from sceneloom.formats.folder_form import FolderFormat
from sceneloom.formats.nuscenes.holdings import HOLDS
from sceneloom.formats.nuscenes.place import near_miss, table_folders
from sceneloom.formats.nuscenes.scene_from_tables import open_nuscenes
from sceneloom.formats.nuscenes.selection import scene_names
from sceneloom.formats.nuscenes.writing import write_nuscenes


def _has_tables(path: Path) -> bool:
    """Whether a path is a folder with the tables of a data set, or the folder of the tables itself."""
    return bool(table_folders(path))


FORMAT = FolderFormat(
    name="nuscenes",
    called="nuScenes",
    looks_like="a folder with v1.0-mini/sample_data.json and the other tables of the nuScenes schema",
    recogniser=_has_tables,
    missing=near_miss,
    reader=open_nuscenes,
    drives=scene_names,
    reading_options=("lenient", "sequence", "keyframes"),
    writer=write_nuscenes,
    writing_options=("version", "keyframe_rate_hz", "pictures", "channel", "trajectory"),
    along_trajectory=True,
    holds=HOLDS,
)
"""The nuScenes schema as one of the formats."""
