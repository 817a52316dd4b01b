"""What KITTI's object folders offer to the table of formats."""

from sceneloom.formats.folder_form import FolderFormat
from sceneloom.formats.kitti.object import place
from sceneloom.formats.kitti.object.reading import open_object
from sceneloom.formats.kitti.object.writing import write_object
from sceneloom.formats.kitti.written.holdings import OBJECT

FORMAT = FolderFormat(
    name="kitti-object",
    called="KITTI's object benchmark",
    looks_like="frames of KITTI's object benchmark (velodyne, image_2, calib, label_2)",
    recogniser=place.recognises,
    missing=place.near_miss,
    reader=open_object,
    reading_options=("lenient",),
    writer=write_object,
    holds=OBJECT,
)
