"""What KITTI's odometry folders offer to the table of formats."""

from sceneloom.formats.folder_form import FolderFormat
from sceneloom.formats.kitti.odometry import place
from sceneloom.formats.kitti.odometry.reading import open_odometry
from sceneloom.formats.kitti.odometry.writing import write_odometry
from sceneloom.formats.kitti.written.holdings import ODOMETRY

FORMAT = FolderFormat(
    name="kitti-odometry",
    called="KITTI's odometry benchmark",
    looks_like=(
        "sequences of KITTI's odometry benchmark (sequences/00, poses/00.txt), with SemanticKITTI's labels"
    ),
    recogniser=place.recognises,
    missing=place.near_miss,
    reader=open_odometry,
    drives=lambda path: tuple(place.sequences_of(path).values()),
    reading_options=("sequence", "labels", "lenient"),
    writer=write_odometry,
    writing_options=("sequence",),
    holds=ODOMETRY,
)
