"""Rules about the lines and files of a recording: what it has, `frames` and `lidar` lines, `vio_config.yaml`."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.checks.faults import as_read, warnings_of_code
from sceneloom.checks.recordings.calibration import stereo_pairs
from sceneloom.checks.recordings.times import Kind, streams_of, streams_of_kind
from sceneloom.checks.rule import HINT, WARNING, Find, FrameInHand, Hit, Rule, Subject, frames_spread
from sceneloom.formats.recording.calibration import CALIBRATION_FILE
from sceneloom.formats.recording.lines import FrameColumns, time_order, view
from sceneloom.formats.recording.reader import VIO_CONFIG_FILE
from sceneloom.formats.recording.vio_config import KNOWN_KEYS, VioConfig, read_vio_config, repeated_keys, similar_key
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.scene import Scene

_IMU = (Kind.ACCELEROMETER, Kind.GYROSCOPE)


def _without_imu(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None or subject.recording.alone or not streams_of(subject):
        return
    there = {stream.kind for stream in streams_of_kind(subject, *_IMU)}
    lacking = [kind.value for kind in _IMU if kind not in there]
    if lacking:
        yield Hit(subject.recording.data_name, f"no {' and no '.join(lacking)} lines")


def _without_calibration(subject: Subject) -> Iterator[Hit]:
    """A recording without the file; where that leaves cameras out, these are reported instead."""
    if subject.recording is None or subject.recording.alone or subject.recording.calibration.path.exists():
        return
    if not any(fault.code == "cameras-without-calibration" for fault in subject.faults):
        yield Hit(CALIBRATION_FILE, "there is none")


# fmt: off
PRESENCE_RULES: tuple[Rule, ...] = (
    Rule("imu-there", WARNING, "A recording has an accelerometer and a gyroscope.",
         "Record them; software for visual-inertial odometry, the vendor's too, gives nothing without.",
         find=_without_imu),
    Rule("calibration-there", WARNING, "A recording has a `calibration.json`.",
         "Write one, though its list of cameras be empty: the format asks for it.", find=_without_calibration),
    Rule("json-plain", WARNING,
         "Files of JSON begin without a byte order mark, and `data.jsonl` ends without blank lines.",
         "Write them without: other programs stop at them; `--fix` does.",
         find=warnings_of_code("byte-order-mark", "blank-lines-at-end"), fix=as_read),
    Rule("poses-without-orientation", WARNING, "Either all poses of a trajectory have an orientation, or none.",
         "See why some lack it; they are left out of the trajectory, and their lines are kept.",
         find=warnings_of_code("poses-without-orientation")),
)
# fmt: on


def _counted_anew(scene: Scene) -> Scene:
    """Let `frames` lines be numbered from 0."""
    return _with_notes(scene, lambda notes: {**notes, "first": 0})


def _with_all_cameras(scene: Scene) -> Scene:
    """Let lines that lack images report it of every camera."""
    cameras = {
        int(found[1])
        for sensor in scene.sensors
        if isinstance(sensor, CameraSensor | DepthCameraSensor)
        and (found := re.fullmatch(r"camera(\d+)", str(sensor.id)))
    }

    def listed(text: str) -> str:
        line = msgspec.json.decode(text)
        entries = line.get("frames")
        if not isinstance(entries, list):
            return text
        missing = sorted(cameras - {entry["cameraInd"] for entry in entries})
        more = [{"cameraInd": index, "missingBitmap": True} for index in missing]
        return msgspec.json.encode({**line, "frames": [*entries, *more]}).decode()

    return _with_notes(scene, lambda notes: {**notes, "texts": [listed(text) for text in notes.get("texts", [])]})


def _with_notes(scene: Scene, change: Callable[[Mapping[str, Any]], dict[str, Any]]) -> Scene:
    """Change what is kept of `frames` lines; the same scene where that changes nothing."""
    kept = scene.metadata.get("recording")
    notes = kept.get("frame_lines") if isinstance(kept, Mapping) else None
    if not isinstance(kept, Mapping) or not isinstance(notes, Mapping) or change(notes) == notes:
        return scene
    recording = MappingProxyType({**kept, "frame_lines": change(notes)})
    return replace(scene, metadata=MappingProxyType({**scene.metadata, "recording": recording}))


IN_STEP = 0.002
"""Images of a stereo pair are taken within this time [s]."""

_NO_STEP = 0.1  # taken for the time from line to line [s] where the lines show none


def _over_frames(judge: Callable[[FrameColumns], Iterator[Hit]]) -> Find:
    """A rule over the `frames` lines of a recording, in the order of the file, where there are any."""

    def find(subject: Subject) -> Iterator[Hit]:
        frames = None if subject.recording is None else subject.recording.columns.frames
        return judge(frames) if frames is not None and len(frames.numbers) else iter(())

    return find


def _by_time(frames: FrameColumns) -> tuple[Int64Array, Int64Array]:
    """Numbers, and the lines that they stand in, in the order of time."""
    order = time_order(view(frames.seconds))
    return np.asarray(frames.numbers, np.int64)[order], np.asarray(frames.lines, np.int64)[order]


def _at(line: int) -> str:
    return f"data.jsonl: line {line}"


def _begin(frames: FrameColumns) -> Iterator[Hit]:
    numbers, lines = _by_time(frames)
    if numbers.min() != 0:
        row = int(numbers.argmin())
        yield Hit(_at(lines[row]), f"number: the first is {numbers[row]}; expected 0")


def _order(frames: FrameColumns) -> Iterator[Hit]:
    numbers, lines = _by_time(frames)
    for row in np.flatnonzero(np.diff(numbers) <= 0).tolist():
        reported = f"number: {numbers[row + 1]} after {numbers[row]}; expected {numbers[row] + 1}"
        yield Hit(_at(lines[row + 1]), reported)


def _gaps(frames: FrameColumns) -> Iterator[Hit]:
    numbers, lines = _by_time(frames)
    for row in np.flatnonzero(np.diff(numbers) > 1).tolist():
        before, after = int(numbers[row]), int(numbers[row + 1])
        missing = str(before + 1) if after == before + 2 else f"{before + 1} to {after - 1}"
        yield Hit(_at(lines[row + 1]), f"number: {after} after {before}; {missing} missing", after - before - 1)


def _without_cameras(frames: FrameColumns) -> Iterator[Hit]:
    """Lines that lack a camera which other lines have."""
    if not frames.cameras:
        yield Hit(_at(frames.lines[0]), "frames: no line names a camera; expected one entry each", len(frames.lines))
    for index, camera in sorted(frames.cameras.items()):
        has_it = np.zeros(len(frames.lines), np.bool_)
        has_it[np.asarray(camera.rows, np.int64)] = True
        lacking = np.flatnonzero(~has_it)
        if len(lacking):
            reported = f"frames: cameraInd {index} is missing in {len(lacking)} of {len(frames.lines)} lines"
            yield Hit(_at(frames.lines[int(lacking[0])]), reported, len(lacking))


def _entry_times(frames: FrameColumns) -> Iterator[Hit]:
    line_seconds = view(frames.seconds)
    steps = np.diff(np.sort(line_seconds))
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else _NO_STEP
    for index, camera in sorted(frames.cameras.items()):
        rows = np.asarray(camera.rows, np.int64)
        off = view(camera.seconds) - line_seconds[rows]
        wrong = np.flatnonzero(np.abs(off) > 0.5 * period)
        if len(wrong):
            worst = int(wrong[np.abs(off[wrong]).argmax()])
            reported = (
                f"frames[].time of camera {index} is up to {off[worst]:+.3f} s off its line's time in {len(wrong)} of "
                f"{len(rows)} lines; expected less than half a period of {period:.3f} s"
            )
            yield Hit(_at(frames.lines[rows[worst]]), reported, len(wrong))


def _out_of_step(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None:
        return
    frames = subject.recording.columns.frames
    for pair in stereo_pairs(subject):
        rows, apart = _apart(frames, pair.first, pair.second)
        wrong = np.flatnonzero(np.abs(apart) > IN_STEP)
        if len(wrong):
            reported = (
                f"images of cameras {pair.first} and {pair.second}, which look the same way, are "
                f"{np.median(np.abs(apart[wrong])) * 1e3:.1f} ms apart in {len(wrong)} of {len(rows)} lines; "
                f"expected at most {IN_STEP * 1e3:g} ms"
            )
            yield Hit(_at(frames.lines[rows[wrong[0]]]), reported, len(wrong))


def _apart(frames: FrameColumns, first: int, second: int) -> tuple[Int64Array, Float64Array]:
    """Rows of lines that have both cameras, and how much later the second camera's image is [s]."""
    if first not in frames.cameras or second not in frames.cameras:
        return np.zeros(0, np.int64), np.zeros(0)
    a, b = frames.cameras[first], frames.cameras[second]
    rows, in_a, in_b = np.intersect1d(
        np.asarray(a.rows, np.int64), np.asarray(b.rows, np.int64), assume_unique=True, return_indices=True
    )
    return rows.astype(np.int64), view(b.seconds)[in_b] - view(a.seconds)[in_a]


# fmt: off
FRAME_LINE_RULES: tuple[Rule, ...] = (
    Rule("frame-numbers-begin", HINT, "`number` of the first `frames` line is 0.",
         "Count from 0: what counts from elsewhere takes other images of the video in some programs.",
         find=_over_frames(_begin), fix=_counted_anew),
    Rule("frame-numbers-increasing", WARNING,
         "`number` grows from `frames` line to `frames` line, in the order of their times.",
         "See which image each line means: it is known by its number; `--fix` numbers them by time, and the video "
         "with them.", find=_over_frames(_order), fix=_counted_anew),
    Rule("frame-numbers-gaps", WARNING, "`number` grows by one from `frames` line to `frames` line.",
         "See whether frames were dropped; `--fix` numbers the lines anew and takes images without a line out.",
         find=_over_frames(_gaps), fix=_counted_anew),
    Rule("frames-without-camera", WARNING, "Every `frames` line names every camera.",
         "Add the camera, with `missingBitmap` where it has no image: the vendor's software refuses other lines.",
         find=_over_frames(_without_cameras), fix=_with_all_cameras),
    Rule("frames-missing-bitmap", HINT, "No entry of a `frames` line says `missingBitmap`.",
         "See whether the camera dropped images.", find=warnings_of_code("missing-bitmaps")),
    Rule("frame-entry-times", WARNING, "`frames[].time` lies within half a period of its line's time.",
         "Write the time at which the image was taken, on the clock of the other lines.",
         find=_over_frames(_entry_times)),
    Rule("stereo-in-step", WARNING,
         f"Cameras that look the same way take their images within {IN_STEP * 1e3:g} ms.",
         "Trigger both together, or give them lines of their own: a pair is taken for one moment.",
         find=_out_of_step),
)
# fmt: on

FARTHEST, NEAREST = 400.0, 0.5
"""Half of a sweep's points lie nearer than the first, and farther than the second [m]."""

_LOOKED_AT = 16
_FEWEST = 20


def _doubled(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None:
        return
    lidars = subject.recording.columns.lidars
    counts = Counter(name for lidar in lidars.values() for name in lidar.texts)
    seen: dict[str, int] = {}
    for lidar in lidars.values():
        for name, line in zip(lidar.texts, lidar.lines, strict=True):
            if counts[name] > 1 and name in seen:
                reported = f"lidar.dataFile: {name!r} is that of line {seen[name]}, too; expected one of its own"
                yield Hit(f"data.jsonl: line {line}", reported)
            seen.setdefault(name, line)


def _ranges(subject: Subject) -> dict[str, list[float]]:
    """Median distances of the points of some sweeps of each lidar [m]."""
    return subject.table("median ranges of lidars", lambda _: {})


def _look(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Take the median distance of some sweeps; what they show is reported at the end."""
    sweep, lidar = frame.frame, frame.sensor
    if subject.recording is not None and isinstance(lidar, LidarSensor) and isinstance(sweep, LidarFrame):
        found = _ranges(subject).setdefault(frame.sensor_path, [])
        if frame.number in frames_spread(len(lidar.frames), _LOOKED_AT):
            distances = np.linalg.norm(sweep.points.positions.astype(np.float64), axis=1)
            distances = distances[np.isfinite(distances) & (distances > 0)]
            found += [float(np.median(distances))] if len(distances) >= _FEWEST else []
    return iter(())


def _absurd(subject: Subject) -> Iterator[Hit]:
    for path, found in _ranges(subject).items():
        middle = float(np.median(found)) if found else 1.0
        if NEAREST <= middle <= FARTHEST:
            continue
        meant = "probably millimetres or centimetres" if middle > FARTHEST else "probably kilometres, or noise"
        reported = f"half of the points are farther than {middle:.3g} m; expected {NEAREST:g} to {FARTHEST:g}: {meant}"
        yield Hit(f"{path}.frames[].points.positions", reported, len(found))


# fmt: off
LIDAR_LINE_RULES: tuple[Rule, ...] = (
    Rule("lidar-file-repeated", WARNING, "No two `lidar` lines name one file.",
         "Give each sweep its own file; see whether a file was overwritten.", find=_doubled),
    Rule("lidar-range", WARNING, f"The middle distance of a lidar's points is {NEAREST:g} to {FARTHEST:g} m.",
         "Write metres.", look=_look, conclude=_absurd),
)
# fmt: on


def _text(subject: Subject) -> str:
    """The text of the settings; "" where there are none, and for what is no recording."""
    kept = None if subject.recording is None else subject.scene.metadata.get("recording")
    text = kept.get("vio_config") if isinstance(kept, Mapping) else None
    return text if isinstance(text, str) else ""


def _config(subject: Subject) -> VioConfig:
    return read_vio_config(_text(subject))


def _unknown(subject: Subject) -> Iterator[Hit]:
    for setting in _config(subject).settings:
        if setting.key not in KNOWN_KEYS:
            near = similar_key(setting.key)
            meant = "" if near is None else f"; is {near!r} meant?"
            yield Hit(f"{VIO_CONFIG_FILE}: line {setting.line}", f"{setting.key!r} is not publicly known{meant}")


def _repeated(subject: Subject) -> Iterator[Hit]:
    for key in repeated_keys(_text(subject)):
        lines = [str(s.line) for s in _config(subject).settings if s.key == key]
        yield Hit(f"{VIO_CONFIG_FILE}: line {lines[1]}", f"{key!r} stands in lines {', '.join(lines)}; expected once")


def _strange(subject: Subject) -> Iterator[Hit]:
    for number, line in _config(subject).strange.items():
        yield Hit(f"{VIO_CONFIG_FILE}: line {number}", f"{line[:60]!r}; expected a setting, `key: value`")


# fmt: off
CONFIGURATION_RULES: tuple[Rule, ...] = (
    Rule("config-keys-known", WARNING, "Every setting of `vio_config.yaml` has a name that is publicly known.",
         "See whether it is misspelt: the vendor's software stops at settings that it does not know.",
         find=_unknown),
    Rule("config-keys-unique", WARNING, "No setting of `vio_config.yaml` stands there twice.",
         "Leave one of them out.", find=_repeated),
    Rule("config-lines-settings", WARNING,
         "Every line of `vio_config.yaml` is a setting, `key: value`, or belongs to the one above it.",
         "Write a blank behind the colon, indent what belongs to a setting, or mark the line as a comment with `#`.",
         find=_strange),
)
# fmt: on
"""Rules that read the settings as they are kept."""
