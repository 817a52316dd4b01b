"""The table of fields of a `rig.toml`: what each is called, what it holds, in which unit, and what it is for.

It serves reading, messages and the page of documentation alike. A field that is not in it is a fault.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from sceneloom.formats.clouds.points import UNITS_NS
from sceneloom.geometry.euler import ORDERS


class Kind(StrEnum):
    """What a field holds, in words for messages."""

    TEXT = "text in quotes"
    TEXTS = "text in quotes, or a list of such texts"
    CHOICE = "one of a few words"
    FLAG = "true or false"
    INTEGER = "a whole number"
    NUMBER = "a number"
    SECONDS = "seconds as a number"
    VECTOR = "a list of numbers"
    MATRIX = "a list of rows of numbers"
    NUMBERS = "a list of numbers, or a table of numbers by name"
    NAMES = "a table of texts"
    AXES = "a word, three axes in one text, or a table of right, down, forward"
    RECORD = "a table"
    RECORDS = "a list of tables"


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a record.

    Attributes:
        name: as in the file.
        kind: what it holds.
        about: what it says, for people.
        required: whether a manifest without it is at fault.
        unit: "m", "px", "s", …
        record: the record of a RECORD or RECORDS.
        choices: the words of a CHOICE.
        shapes: the lengths of a VECTOR, as (3,), or the sizes of a MATRIX, as (4, 4).
        positive: whether a number has to be above zero.
    """

    name: str
    kind: Kind
    about: str
    required: bool = False
    unit: str = ""
    record: str = ""
    choices: tuple[str, ...] = ()
    shapes: tuple[tuple[int, ...], ...] = ()
    positive: bool = False


SENSOR_TYPES = ("lidar", "camera", "imu", "gnss")
TIMESTAMPS = ("start", "middle", "end")
UNITS = tuple(UNITS_NS)

_ID = Field("id", Kind.TEXT, "name of the sensor in the scene; no other has it", required=True)
_TYPE = Field("type", Kind.CHOICE, "what it measures", required=True, choices=SENSOR_TYPES)
_FRAME = Field("frame", Kind.TEXT, "name of the sensor's own frame; left out: its id")
_EXTRINSIC = Field(
    "extrinsic", Kind.RECORD, "where the sensor is, instead of a `[[transforms]]`", record="extrinsic"
)
_ROOT = Field(
    "root", Kind.TEXT, "folder of the files, seen from the manifest; left out: the manifest's `root`"
)
_OFFSET = Field("time_offset_s", Kind.SECONDS, "added to every timestamp of the sensor", unit="s")
_UNIT = Field("unit", Kind.CHOICE, "unit of the numbers", choices=UNITS)
_TIMES = Field("times", Kind.RECORD, "where the timestamps come from", required=True, record="times")
_FILES = Field(
    "files", Kind.TEXTS, "pattern of the files below `root`: `lidar/*.pcd`, `**/*.bin`, or a list of patterns"
)
_CSV_FILE = Field("file", Kind.TEXT, "the CSV file below `root`", required=True)
_COLUMNS = Field("columns", Kind.NAMES, "column of the file by what it is, where its name does not report")
_MOUNTED = (_ID, _TYPE, _FRAME, _EXTRINSIC, _ROOT, _OFFSET)

_ROTATIONS = (
    Field("translation", Kind.VECTOR, "origin of `from` seen in `to`", unit="m", shapes=((3,),)),
    Field("quaternion_xyzw", Kind.VECTOR, "rotation, scalar last", shapes=((4,),)),
    Field("quaternion_wxyz", Kind.VECTOR, "rotation, scalar first", shapes=((4,),)),
    Field("rotation_matrix", Kind.MATRIX, "rotation, row by row", shapes=((3, 3),)),
    Field("euler_deg", Kind.VECTOR, "angles about x, y and z, whatever the order", unit="°", shapes=((3,),)),
    Field("euler_order", Kind.CHOICE, "order of the product: zyx is Rz·Ry·Rx", choices=ORDERS),
    Field("matrix", Kind.MATRIX, "all in one: [R t; 0 0 0 1], row by row", unit="m", shapes=((4, 4), (3, 4))),
)

RECORDS: Mapping[str, tuple[Field, ...]] = MappingProxyType(
    {
        "rig": (
            Field("ego", Kind.TEXT, "the frame that the trajectory moves through the world; left out: base"),
            Field(
                "root",
                Kind.TEXT,
                "folder of all files, absolute or seen from the manifest; left out: the manifest's",
            ),
            Field("name", Kind.TEXT, "what the drive is called, for people"),
            Field("transforms", Kind.RECORDS, "how the frames stand to each other", record="transform"),
            Field("sensors", Kind.RECORDS, "the sensors", required=True, record="sensor"),
            Field(
                "trajectories", Kind.RECORDS, "ways through the world, the default first", record="trajectory"
            ),
        ),
        "transform": (
            Field("from", Kind.TEXT, "frame whose points go in", required=True),
            Field(
                "to", Kind.TEXT, "frame that they come out in: p_to = R·p_from + translation", required=True
            ),
            *_ROTATIONS,
        ),
        "extrinsic": (
            Field(
                "to",
                Kind.TEXT,
                "takes points of the sensor's frame into this frame: p_to = R·p + translation",
            ),
            Field("from", Kind.TEXT, "instead of `to`: takes points of this frame into the sensor's frame"),
            *_ROTATIONS,
        ),
        "sensor lidar": (
            *_MOUNTED,
            Field(_FILES.name, _FILES.kind, _FILES.about, required=True),
            _TIMES,
            Field(
                "timestamp",
                Kind.CHOICE,
                "what of a sweep the timestamp means; left out: start",
                choices=TIMESTAMPS,
            ),
            Field(
                "sweep_s",
                Kind.SECONDS,
                "how long a sweep takes; left out: the median interval",
                unit="s",
                positive=True,
            ),
            Field(
                "deskewed",
                Kind.FLAG,
                "true: all points are placed as at the timestamp, their times are not used",
            ),
            Field("points_in", Kind.TEXT, "frame of the points, or `world`; left out: the sensor's own"),
            Field("point_times", Kind.RECORD, "what the times of single points mean", record="point_times"),
            Field(
                "fields", Kind.TEXTS, "columns of `.bin`, or of rows in `.npz`: `x`, `ring:uint16`, `_:uint8`"
            ),
            Field("dtype", Kind.TEXT, "type of the `fields` that name none; left out: float32"),
            Field(
                "use",
                Kind.NAMES,
                "column by what it is: x y z intensity ring red green blue, where names do not report",
            ),
            Field(
                "intensity_max",
                Kind.NUMBER,
                "brightness that becomes 255; left out: seen in the first file",
                positive=True,
            ),
            Field("model", Kind.TEXT, "name of the device"),
        ),
        "sensor camera": (
            *_MOUNTED,
            _FILES,
            Field("video", Kind.TEXT, "a video below `root`, instead of `files`"),
            _TIMES,
            Field("axes", Kind.AXES, "how the axes of the camera's frame lie; left out: optical"),
            Field(
                "shutter_roll_s",
                Kind.SECONDS,
                "how long a rolling shutter takes from the first row to the last; left out: all at once",
                unit="s",
                positive=True,
            ),
            Field("shutter_left_to_right", Kind.FLAG, "true: it takes columns from the left, not rows"),
            Field("camera_model", Kind.RECORD, "the intrinsics", required=True, record="camera_model"),
        ),
        "sensor imu": (
            *_MOUNTED,
            _CSV_FILE,
            _COLUMNS,
            _UNIT,
            Field("gyroscope_unit", Kind.CHOICE, "left out: rad/s", choices=("rad/s", "deg/s")),
            Field("accelerometer_unit", Kind.CHOICE, "left out: m/s2", choices=("m/s2", "g")),
        ),
        "sensor gnss": (*_MOUNTED, _CSV_FILE, _COLUMNS, _UNIT),
        "times": (
            Field(
                "pattern",
                Kind.TEXT,
                "timestamps in the file names: `{ns}`, `{s}_{ns}`, `*_{us}`, `{index}` with a rate",
            ),
            Field("csv", Kind.TEXT, "timestamps in a CSV file below `root`"),
            Field(
                "column", Kind.TEXT, "column of the timestamps in the CSV; left out: timestamp, time, t, …"
            ),
            Field(
                "file_column",
                Kind.TEXT,
                "column of the file names in the CSV; left out: file, filename, … if any",
            ),
            Field(
                "lines",
                Kind.TEXT,
                "timestamps in a text file below `root`, one line per file: numbers or dates",
            ),
            Field("rate_hz", Kind.NUMBER, "files come evenly, so many a second", unit="1/s", positive=True),
            Field(
                "start_s",
                Kind.SECONDS,
                "timestamp of index 0, or of a video's first image; left out: 0",
                unit="s",
            ),
            Field("container", Kind.FLAG, "true: the times that the video itself has"),
            _UNIT,
        ),
        "point_times": (
            Field("field", Kind.TEXT, "column of the times; left out: time, t, timestamp, …"),
            Field("unit", Kind.CHOICE, "unit of the column", required=True, choices=UNITS),
            Field(
                "relative_to",
                Kind.CHOICE,
                "what they count from: the file's timestamp, the sweep's start, or the clock's zero; left out: "
                "timestamp",
                choices=("timestamp", "start", "clock"),
            ),
        ),
        "camera_model": (
            Field(
                "model", Kind.TEXT, "projection model; left out: pinhole, or brown_conrady with coefficients"
            ),
            Field(
                "width",
                Kind.INTEGER,
                "image size that the numbers hold for; left out: the images'",
                unit="px",
                positive=True,
            ),
            Field("height", Kind.INTEGER, "the same", unit="px", positive=True),
            Field("fx", Kind.NUMBER, "focal length", unit="px", positive=True),
            Field("fy", Kind.NUMBER, "focal length; left out: fx", unit="px", positive=True),
            Field("cx", Kind.NUMBER, "principal point; (0, 0) is the centre of the first pixel", unit="px"),
            Field("cy", Kind.NUMBER, "the same", unit="px"),
            Field("K", Kind.MATRIX, "instead of fx fy cx cy", unit="px", shapes=((3, 3),)),
            Field(
                "P",
                Kind.MATRIX,
                "instead of them: K·[I t], as KITTI and ROS give it",
                unit="px",
                shapes=((3, 4),),
            ),
            Field("coefficients", Kind.NUMBERS, "distortion: a list in OpenCV's order, or by name"),
            Field(
                "undistorted", Kind.FLAG, "true: the images are rectified, so the coefficients are not used"
            ),
        ),
        "trajectory": (
            Field("name", Kind.TEXT, "what it is called; left out: pose"),
            Field("file", Kind.TEXT, "the file below `root`", required=True),
            Field("form", Kind.CHOICE, "how it is written", required=True, choices=("tum", "kitti", "csv")),
            Field("frame", Kind.TEXT, "the frame whose trajectory it is; left out: the ego's"),
            Field(
                "world_axes", Kind.CHOICE, "axes of its world; left out: z_up", choices=("z_up", "optical")
            ),
            Field("times", Kind.TEXT, "timestamps of a kitti file: a text file, one line per pose"),
            _COLUMNS,
            _UNIT,
            _ROOT,
            _OFFSET,
        ),
    }
)
"""Every record by name, its fields in the order in which they are explained."""


def fields_of(record: str) -> Mapping[str, Field]:
    """The fields of a record by name."""
    return MappingProxyType({field.name: field for field in RECORDS[record]})


def inner_records(record: str) -> Mapping[str, str]:
    """The record of each field of a record that holds one, by the field's name."""
    return MappingProxyType(
        {field.name: field.record for field in RECORDS[record] if field.record in RECORDS}
    )
