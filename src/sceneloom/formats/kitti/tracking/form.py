"""What KITTI's tracking folders offer to the table of formats."""

from sceneloom.formats.folder_form import FolderFormat
from sceneloom.formats.kitti.tracking import place
from sceneloom.formats.kitti.tracking.reading import open_tracking
from sceneloom.formats.kitti.tracking.writing import write_tracking
from sceneloom.formats.kitti.written.holdings import TRACKING

FORMAT = FolderFormat(
    name="kitti-tracking",
    called="KITTI's tracking benchmark",
    looks_like="sequences of KITTI's tracking benchmark (velodyne/0000, image_02/0000, label_02, calib)",
    recogniser=place.recognises,
    missing=place.near_miss,
    reader=open_tracking,
    drives=place.drives_of,
    reading_options=("sequence", "lenient"),
    writer=write_tracking,
    writing_options=("sequence",),
    holds=TRACKING,
)
