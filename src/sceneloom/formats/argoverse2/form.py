"""What Argoverse 2 offers to the table of formats."""

from sceneloom.formats.argoverse2 import place
from sceneloom.formats.argoverse2.scene_from_log import open_argoverse2
from sceneloom.formats.folder_form import FolderFormat

FORMAT = FolderFormat(
    name="argoverse2",
    called="Argoverse 2",
    looks_like=f"a folder with {place.POSES}, calibration/ and sensors/lidar/*.feather",
    suffixes=(".argoverse2",),
    recogniser=place.recognises,
    missing=place.near_miss,
    reader=open_argoverse2,
    drives=place.logs_in,
    reading_options=("lenient", "sequence", "one_lidar", "distorted"),
    refusal="Argoverse 2 is only read; write a scene file (drive.sfs) or a recording (a folder) in its place",
)
"""Logs of Argoverse 2 as one of the formats."""
