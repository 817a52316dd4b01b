"""What PandaSet offers to the table of formats."""

from sceneloom.formats.folder_form import FolderFormat
from sceneloom.formats.pandaset import place
from sceneloom.formats.pandaset.scene_from_folder import open_pandaset

FORMAT = FolderFormat(
    name="pandaset",
    called="PandaSet",
    looks_like="a folder with lidar/00.pkl.gz, lidar/poses.json and camera/",
    suffixes=(".pandaset",),
    recogniser=place.recognises,
    missing=place.near_miss,
    reader=open_pandaset,
    drives=place.drives_in,
    reading_options=("lenient", "sequence"),
    refusal="PandaSet is only read; write a scene file (drive.sfs) or a recording (a folder) in its place",
)
"""Drives of PandaSet as one of the formats."""
