"""Lines taken one after the other into columns: the usual ones fast, all others with all that they state."""

from array import array
from collections.abc import Iterator, Sequence
from math import nan
from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

from sceneloom.formats.recording.columns import (
    SEVERAL,
    TEXT,
    PoseColumns,
    RecordingColumns,
    SharedLine,
)
from sceneloom.formats.recording.json_faults import DECODER_FAULTS, json_problem, quote
from sceneloom.formats.recording.line_shapes import (
    RECORD_KEYS,
    ROOT_KEYS,
    ExactLine,
    ExactQuaternion,
    FrequentLine,
    Line,
)
from sceneloom.formats.recording.line_taking import ParsedLines, UnfitLineError, take_frames, take_line
from sceneloom.formats.recording.old_forms import has_old_frame, with_frames
from sceneloom.formats.recording.other_records import is_pressure, other_fixes, other_poses

_decode_frequent = msgspec.json.Decoder(FrequentLine).decode
_decode_exact = msgspec.json.Decoder(ExactLine).decode
_decode_open = msgspec.json.Decoder(Line).decode
_decode_any = msgspec.json.Decoder().decode

_GROUND_TRUTH = ("groundTruth", "groundTruth")

BLANK = "blank-lines"
"""The code of a line that is blank: a fault, but at the end of the file."""
BLANK_LINE = "blank; expected a JSON object"

_NO_SUBJECT = {"time", "number"}


_NO_ROTATION = ExactQuaternion(nan, nan, nan, nan)


class _BlankLineError(UnfitLineError):
    """A line holds nothing."""


_Bound = tuple["array[float]", "array[float]", int, int]


class LineReader:
    """Takes lines apart into columns; what is wrong with them is noted, not raised.

    Attributes:
        columns: what was read so far.
        faults: code, number of the line and problem of each line that nothing was taken from.
    """

    def __init__(self) -> None:
        """Begin with no lines."""
        self.columns = RecordingColumns()
        self.faults: list[tuple[str, int, str]] = []
        self._bound: dict[str, _Bound] = {}
        self._truth: PoseColumns | None = None
        self._lines: Sequence[bytes] = ()
        self._first, self._reached, self._offset = 0, 0, 0

    def read(self, lines: Sequence[bytes], offset: int) -> None:
        """Take the next lines of the file.

        Args:
            lines: without their line feeds.
            offset: byte at which the first one begins.
        """
        if len(self._bound) != len(self.columns.sensors):
            self.bind()
        codes = self.columns.log.codes
        self._lines, self._first, self._reached, self._offset = lines, len(codes), 0, offset
        decoded = map(_decode_frequent, lines)
        while True:
            try:
                self._take_frequent(decoded)
            except DECODER_FAULTS:
                self._take_infrequent()
            else:
                return

    def bind(self) -> None:
        """Have the usual lines put right into the columns; called anew whenever these were put instead of others."""
        for name, stream in self.columns.sensors.items():
            self._bound[name] = (stream.seconds, stream.values, stream.width, stream.code)
        self._truth = self.columns.poses.get(_GROUND_TRUTH)

    def _take_frequent(self, decoded: Iterator[FrequentLine]) -> None:
        """Take lines until one is of another kind; nearly all of the time of reading goes by in here."""
        codes, bound = self.columns.log.codes, self._bound
        take_truth, take_images = self._take_truth, self._take_images
        for line in decoded:
            sample = line.sensor
            if sample is not UNSET:
                # nothing but a sample: asking for each of the others takes less time than counting
                if line.groundTruth is line.frames is line.number is UNSET:
                    stream = bound.get(sample.type)
                    numbers = sample.values
                    if stream is not None and len(numbers) == stream[2]:
                        stream[0].append(line.time)
                        stream[1].fromlist(numbers)
                        codes.append(stream[3])
                        continue
            elif line.groundTruth is not UNSET:
                if line.frames is line.number is UNSET:
                    take_truth(line)
                    continue
            elif line.frames is not UNSET:
                take_images(line)
                continue
            self._take_exact(line)

    def _take_truth(self, line: FrequentLine) -> None:
        """Take a line that is a pose of the ground truth alone."""
        trajectory, pose = self._truth, line.groundTruth
        if trajectory is None or pose is UNSET:
            self._take_exact(line)
            return
        position, rotation = pose.position, pose.orientation
        if isinstance(rotation, UnsetType):
            rotation = _NO_ROTATION
        samples, codes = trajectory.samples, self.columns.log.codes
        samples.seconds.append(line.time)
        samples.values.fromlist(
            [position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w]
        )
        codes.append(samples.code)
        trajectory.lines.append(len(codes))

    def _take_images(self, line: FrequentLine) -> None:
        """Take a line that reports images alone, without camera models and mountings of their own."""
        entries, number, frames = line.frames, line.number, self.columns.frames
        if number is UNSET or not frames.code or entries is UNSET:
            self._take_exact(line)
            return
        for entry in entries:
            if entry.cameraParameters or entry.imuToCamera or entry.missingBitmap is not UNSET:
                self._take_exact(line)
                return
        codes = self.columns.log.codes
        try:
            take_frames(self.columns, line.time, entries, number, line=len(codes) + 1)
        except UnfitLineError as error:
            self._fault("unfit-lines", str(error))
        else:
            codes.append(frames.code)

    @property
    def _text(self) -> bytes:
        return self._lines[len(self.columns.log.codes) - self._first]

    @property
    def _number(self) -> int:
        return len(self.columns.log.codes) + 1

    def _begin(self) -> int:
        """Byte at which the line begins."""
        location = len(self.columns.log.codes) - self._first
        self._offset += sum(map(len, self._lines[self._reached : location])) + location - self._reached
        self._reached = location
        return self._offset

    def _take_infrequent(self) -> None:
        try:
            line = _decode_exact(self._text)
        except DECODER_FAULTS:
            self._take_inexact(self._text)
        else:
            self._take_exact(line)

    def _take_exact(self, line: FrequentLine) -> None:
        """Take a line that says nothing but what the columns hold, or several such things."""
        try:
            offset = self._begin if line.frames is not UNSET and _says_more(line, self._text) else None
            parsed_lines = take_line(self.columns, line, self._number, offset=offset)
        except UnfitLineError as error:
            self._fault("unfit-lines", str(error))
        except UnicodeDecodeError as error:
            self._fault("broken-lines", json_problem(error, self._text))
        else:
            self._note(parsed_lines, says_more=parsed_lines.leftover)

    def _take_inexact(self, text: bytes) -> None:
        """Take a line that is broken, wrong, or says more than the exact shapes hold."""
        try:
            self._take_open(text, _decode_object(text))
        except _BlankLineError as error:
            self._fault(BLANK, str(error))
        except UnfitLineError as error:
            self._fault("unfit-lines", str(error))
        except msgspec.ValidationError as error:
            self._fault("unfit-lines", json_problem(error, text))
        except DECODER_FAULTS as error:
            self._fault("broken-lines", json_problem(error, text))

    def _take_open(self, text: bytes, content: dict[str, Any]) -> None:
        if has_old_frame(content):
            content = with_frames(content)
            text = msgspec.json.encode(content)
        poses, fixes = other_poses(content), other_fixes(content)
        own = {origin[0] for origin, _, _ in fixes} & ROOT_KEYS
        if not is_pressure(content.get("barometer")):
            own |= {"barometer"} & content.keys()
        if own:
            text = msgspec.json.encode({key: value for key, value in content.items() if key not in own})
        line = _decode_open(text)
        if not poses and not fixes and all(getattr(line, key) is None for key in RECORD_KEYS):
            self._keep_text(line.time, next((key for key in content if key not in _NO_SUBJECT), ""))
            return
        parsed_lines = take_line(
            self.columns,
            line,
            self._number,
            poses=[(origin, pose) for origin, pose, _ in poses],
            fixes=[(origin, fix) for origin, fix, _ in fixes],
            offset=self._begin,
        )
        simple = [*poses, *fixes]
        self._note(parsed_lines, says_more=not (len(simple) == 1 and simple[0][2]))

    def _note(self, parsed_lines: ParsedLines, *, says_more: bool) -> None:
        """Note which streams took a line, and keep its text where it says more than one of them holds."""
        log, streams = self.columns.log, parsed_lines.streams
        if any(len(stream) == 1 for stream in streams):  # the next ones are taken fast
            self.bind()
        if not streams and not parsed_lines.frames:
            self._keep_text(parsed_lines.seconds, "" if not parsed_lines.leftover else "sensor")
        elif len(streams) + parsed_lines.frames > 1:
            rows = [(stream.code, len(stream) - 1) for stream in streams]
            log.shared[self._number] = SharedLine(self._text.decode(), rows)
            log.codes.append(SEVERAL)
        elif parsed_lines.frames:
            log.codes.append(self.columns.frames.code)
        else:
            stream = streams[0]
            if says_more:
                stream.further[len(stream) - 1] = self._text.decode()
            log.codes.append(stream.code)

    def _keep_text(self, seconds: float | None, key: str) -> None:
        columns = self.columns
        columns.other_lines.append(self._text.decode().strip())
        columns.other_seconds.append(nan if seconds is None else seconds)
        columns.other_keys[key] = columns.other_keys.get(key, 0) + 1
        columns.log.codes.append(TEXT)

    def _fault(self, code: str, problem: str) -> None:
        self.faults.append((code, self._number, problem))
        self.columns.log.codes.append(0)


def _says_more(line: FrequentLine, text: bytes) -> bool:
    """Whether a line of images says what its columns do not hold.

    Raises:
        UnicodeDecodeError: it is no text; the decoder leaves out what it only copies.
    """
    text.decode()
    beside = (getattr(line, key, UNSET) for key in RECORD_KEYS if key != "frames")
    entries = () if line.frames is UNSET else line.frames
    return any(value is not UNSET for value in beside) or any(
        entry.missingBitmap is not UNSET for entry in entries
    )


def _decode_object(text: bytes) -> dict[str, Any]:
    if not text.strip():
        raise _BlankLineError(BLANK_LINE)
    text.decode()
    content = _decode_any(text)
    if not isinstance(content, dict):
        raise UnfitLineError(f"{quote(text)}: expected a JSON object")
    return content
