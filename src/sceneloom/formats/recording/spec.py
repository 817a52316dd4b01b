"""The recording format of Spectacular AI: a folder of JSON lines, videos, a calibration and lidar binaries."""

from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.losses import KEPT, converted, dropped
from sceneloom.formats.base.spec import FormatSpec

DATA_FILE = "data.jsonl"
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_LONGEST_FIRST_LINE = 1 << 18
_LEADING_LINES = 20


def _sniff(path: Path) -> bool:
    """Whether a path is a folder with a `data.jsonl`, or a file of such lines."""
    if path.is_dir():
        return (path / DATA_FILE).is_file()
    return path.is_file() and (path.name == DATA_FILE or _is_log(path))


def _is_log(path: Path) -> bool:
    """Whether a file is lines of JSON as a recording or the output of a method has them: one of the first is known."""
    try:
        with open_file(path) as file:
            for _ in range(_LEADING_LINES):
                line = _object(file.readline(_LONGEST_FIRST_LINE).removeprefix(_BYTE_ORDER_MARK))
                if line is None or _is_known(line):
                    return line is not None
    except OSError:
        pass
    return False


def _object(text: bytes) -> dict[str, Any] | None:
    """A line's object, {} for a blank one; None where it is none, so that files of other kinds are not read on."""
    if not text.startswith((b"{", b" ", b"\t", b"\r", b"\n")):
        return None
    try:
        line = msgspec.json.decode(text) if text.strip() else {}
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None
    return line if isinstance(line, dict) else None


def _is_known(line: dict[str, Any]) -> bool:
    if "time" not in line:
        return False
    from sceneloom.formats.recording.contents import RECORD_KEYS

    values = (line, *line.values())
    is_pose = any(isinstance(value, dict) and isinstance(value.get("position"), dict) for value in values)
    return is_pose or bool(RECORD_KEYS & line.keys())


def _near_miss(path: Path) -> str | None:
    """Report what keeps a path from being a recording, where it nearly is one; None where it is something else."""
    if not path.is_dir():
        return None
    names = sorted(entry.name for entry in path.iterdir())
    packed = [name for name in names if name.lower().startswith(DATA_FILE + ".")]
    if packed:
        return f"there is {packed[0]}: unpack it to {DATA_FILE}"
    logs = [name for name in names if name.lower().endswith(".jsonl")]
    return f"there is {logs[0]}: is it the recording's {DATA_FILE}?" if logs else None


_NO_POSITION = dropped("the format has none")
_MOUNTED = ("lidar", "camera", "depth_camera")
_STREAMS = ("accelerometer", "gyroscope", "magnetometer", "other")
_SUPPORTS = {
    "": KEPT,
    "sensors.radar": _NO_POSITION,
    "sensors.points": _NO_POSITION,
    "sensors.plain": _NO_POSITION,
    **{f"sensors.{kind}.parent_id": _NO_POSITION for kind in (*_MOUNTED, "odometry", "imu", "gnss")},
    "sensors.lidar.frames.points.colors": _NO_POSITION,
    "sensors.lidar.frames.points.camera_index": _NO_POSITION,
    **{
        f"sensors.{kind}.coordinates": converted("locations are reported by the mounting and the ego trajectory")
        for kind in _MOUNTED
    },
    "sensors.camera.video": converted("packets are copied into a file of another kind"),
    "sensors.camera.images.encoded": dropped("images are written as a video, or as PNG"),
    "sensors.depth_camera.video": converted("encoded anew as FFV1, which loses nothing"),
    **{
        f"{kind}.file_seconds": converted("written anew where they do not state the exact times")
        for kind in (*(f"sensors.imu.streams.{name}" for name in _STREAMS), "sensors.gnss", "trajectories")
    },
    "sensors.odometry.id": converted("the name of a trajectory"),
    "sensors.odometry.poses": converted("written as a trajectory"),
    "annotations": _NO_POSITION,
    "trajectories.covariances": _NO_POSITION,
    "attributes": _NO_POSITION,
    "time_offset_ns": converted("times are written whole"),
}

FORMAT = FormatSpec(
    name="recording",
    title="a recording",
    looks_like="a folder with a data.jsonl, or a file of such lines",
    sniff=_sniff,
    near_miss=_near_miss,
    reader="sceneloom.formats.recording.reader:open_recording",
    read_options=("lenient", "altitude", "camera_shift", "image_index"),
    examiner="sceneloom.formats.recording.reader:examine_recording",
    writer="sceneloom.formats.recording.writer:write_recording",
    write_options=("images",),
    output_check="sceneloom.formats.recording.writer:check_outside_recordings",
    supports=MappingProxyType(_SUPPORTS),
)
