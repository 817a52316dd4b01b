"""What a file or a folder holds, as numbers that do not depend on texts: the measure of "nothing has changed".

Files are read by other programs than the one under test wherever there are any: JSON and arrays of scene files by the
few lines below, images by Pillow, videos by PyAV, bags by rosbags, MCAP by mcap, LAS by laspy.
"""

import gzip
import hashlib
import io
import json
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from tests.behaviour.commands import renamed

Found = dict[str, Any]
"""Of one location in what was written: how many values, a digest of their bytes, sums to compare within rounding."""

_SILENT = frozenset(
    {"seconds", "stages", "took", "elapsed", "size_bytes", "bytes", "peak_memory", "memory", "cpu_seconds"}
    | {"path", "paths", "file", "files", "source", "target", "output", "outputs", "url", "host", "python", "platform"}
    | {"warnings", "message", "messages", "summary", "text", "texts", "title", "description", "version", "generator"}
    | {"address", "port", "pid", "per_second", "mtime_ns", "processors", "stated"}
    | {"created", "modified", "progress", "started", "finished"}
)
SILENT = _SILENT | {renamed(name) for name in _SILENT}
"""Fields of JSON whose values depend on the machine, on the moment, or are sentences."""

_TEXTS = 12
_CODE = re.compile(r"^[\w./:+-]{0,64}$")


class Digest:
    """Values of one location, taken one after the other.

    Numbers are counted, hashed as they are, and summed with weights that follow their order, so that two runs whose
    bytes differ can still be shown to agree within rounding. A few texts are kept as they are.
    """

    def __init__(self) -> None:
        self.count = 0
        self.bytes = hashlib.sha256()
        self.sums = np.zeros(3)
        self.texts: set[str] | None = set()

    def take(self, values: Any) -> None:
        """Take an array, a number, a flag or a short text."""
        if isinstance(values, str | bytes):
            content = values.encode() if isinstance(values, str) else values
            self.count += 1
            self.bytes.update(len(content).to_bytes(8, "little") + content)
            self.texts = self.texts if isinstance(values, str) else None
            if self.texts is not None and len(self.texts) <= _TEXTS:
                self.texts.add(values)
            return
        self.texts = None
        array = np.ascontiguousarray(values)
        self.count += array.size
        self.bytes.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
        if array.dtype.kind in "biuf" and array.size:
            with np.errstate(invalid="ignore"):
                flat = array.astype(np.float64).ravel()
            flat = np.where(np.isfinite(flat), flat, 0.0)
            weights = 1.0 + np.arange(flat.size) % 97 / 97.0
            self.sums += flat.sum(), np.abs(flat).sum(), float(flat @ weights)

    def found(self) -> Found:
        """Give what was taken as plain values."""
        if self.texts and len(self.texts) <= _TEXTS and sum(map(len, self.texts)) <= 400:
            return {"n": self.count, "texts": sorted(self.texts)}
        sums = [float(f"{value:.12g}") for value in self.sums]
        return {"n": self.count, "sha": self.bytes.hexdigest()[:16]} | ({"sums": sums} if any(sums) else {})


def contents(root: Path) -> dict[str, Found]:
    """Read everything below a path.

    Returns:
        by location (the file's name with digits as `#`, then the field inside it with indices as `[]`): what is there.
    """
    digests: dict[str, Digest] = {}
    for file in sorted(file for file in root.rglob("*") if file.is_file()):
        name = re.sub(r"[0-9a-f]{8,}|[0-9]+", "#", str(file.relative_to(root)))
        for location, value in _values(file):
            digests.setdefault(f"{name}:{location}", Digest()).take(value)
    return {location: digest.found() for location, digest in sorted(digests.items())}


def fields(value: Any, location: str = "") -> Iterator[tuple[str, Any]]:
    """Go through JSON, and give numbers, flags and words of a single piece with their locations."""
    if isinstance(value, Mapping):
        for key in sorted(value, key=str):
            name = str(key)
            if name not in SILENT:
                yield from fields(value[key], f"{location}.{re.sub(r'[0-9a-f]{8,}|[0-9]+', '#', name)}")
    elif isinstance(value, list):
        if value and all(type(one) in (int, float) for one in value):
            yield f"{location}[]", np.array(value, np.float64)
        else:
            for one in value:
                yield from fields(one, f"{location}[]")
    elif isinstance(value, str):
        if _CODE.match(value) and "/" not in value and "tmp" not in value:
            yield location, value
    elif value is not None:
        yield location, float(value) if isinstance(value, int | float) else value


def _values(file: Path) -> Iterable[tuple[str, Any]]:
    name = file.name.lower()
    for endings, read in _READERS:
        if name.endswith(endings):
            try:
                return list(read(file))
            except (ValueError, KeyError):
                break
    return [("bytes", file.read_bytes())]


def _scene(file: Path) -> Iterator[tuple[str, Any]]:
    """Read the header, which ends at the first NUL, and the arrays that its `$items` names."""
    content = file.read_bytes()
    end = content.index(b"\0")
    header = json.loads(content[:end])
    items = header.pop("$items", [])
    yield from fields(header)
    for item in items:
        keys = ".".join("[]" if isinstance(key, int) else str(key) for key in item["keys"])
        data = memoryview(content)[end + item["offset"] : end + item["offset"] + item["length"]]
        dtype = item.get("dtype", "uint8")
        try:
            values: Any = np.frombuffer(data, dtype)
        except (TypeError, ValueError):
            values = bytes(data)
        yield f".{keys} {dtype}", values


def _json(file: Path) -> Iterator[tuple[str, Any]]:
    yield from fields(json.loads(file.read_text()))


def _json_lines(file: Path) -> Iterator[tuple[str, Any]]:
    for line in file.read_text().splitlines():
        yield from fields(json.loads(line))


def _text(file: Path) -> Iterator[tuple[str, Any]]:
    for line in file.read_text(errors="replace").splitlines():
        if not line.lstrip().startswith(("#", "//")):
            for word in re.split(r"[\s,;]+", line.strip()):
                try:
                    yield "numbers", float(word)
                except ValueError:
                    yield "words", word


def _image(file: Path) -> Iterator[tuple[str, Any]]:
    from PIL import Image

    with Image.open(file) as image:
        yield f"pixels {image.mode}", np.asarray(image)


def _video(file: Path) -> Iterator[tuple[str, Any]]:
    import av

    with av.open(file) as container:
        for frame in container.decode(video=0):
            yield "times", int(frame.pts)
            yield "pixels", frame.to_ndarray(format="gray")[::8, ::8]


def _mcap(file: Path) -> Iterator[tuple[str, Any]]:
    from mcap.reader import make_reader

    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            name = schema.name if schema else "unknown"
            yield f"{channel.topic} {name} times", message.log_time
            yield f"{channel.topic} {name} data", message.data


def _bag(file: Path) -> Iterator[tuple[str, Any]]:
    from rosbags.rosbag1 import Reader

    with Reader(file) as reader:
        for connection, time_ns, content in reader.messages():
            yield f"{connection.topic} {connection.msgtype} times", time_ns
            yield f"{connection.topic} {connection.msgtype} data", bytes(content)


def _sqlite_bag(file: Path) -> Iterator[tuple[str, Any]]:
    import sqlite3

    with closing(sqlite3.connect(file)) as tables:
        columns = "name, type, timestamp, data"
        rows = tables.execute(
            f"SELECT {columns} FROM messages JOIN topics ON topic_id = topics.id ORDER BY messages.id"
        )
        for topic, kind, time_ns, content in rows:
            yield f"{topic} {kind} times", time_ns
            yield f"{topic} {kind} data", content


def _las(file: Path) -> Iterator[tuple[str, Any]]:
    import laspy

    points = laspy.read(file)
    for name in points.point_format.dimension_names:
        yield name, np.asarray(points[name])
    yield "scales", np.asarray(points.header.scales)
    yield "offsets", np.asarray(points.header.offsets)


def _after(mark: bytes) -> Any:
    def read(file: Path) -> Iterator[tuple[str, Any]]:
        head, found, body = file.read_bytes().partition(mark)
        lines = [line for line in head.decode(errors="replace").splitlines() if not line.startswith(("comment", "#"))]
        yield "header", "\n".join(lines)
        yield "body", found + body

    return read


def _arrays(file: Path) -> Iterator[tuple[str, Any]]:
    with zipfile.ZipFile(file) as members:
        for name in sorted(members.namelist()):
            if name.endswith(".npy"):
                yield name.removesuffix(".npy"), np.load(io.BytesIO(members.read(name)), allow_pickle=False)


def _floats(file: Path) -> Iterator[tuple[str, Any]]:
    content = file.read_bytes()
    yield (
        "floats" if len(content) % 4 == 0 else "bytes",
        np.frombuffer(content, "<f4" if len(content) % 4 == 0 else "u1"),
    )


def _table(file: Path) -> Iterator[tuple[str, Any]]:
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(file)
    yield from fields({name: table[name].to_pylist() for name in table.column_names})


def _nothing(file: Path) -> Iterator[tuple[str, Any]]:
    yield "is written", file.stat().st_size > 0


def _unpacked(file: Path) -> Iterator[tuple[str, Any]]:
    yield "bytes", gzip.decompress(file.read_bytes())


_READERS: tuple[tuple[tuple[str, ...], Any], ...] = (
    ((".sfs",), _scene),
    ((".json", ".template"), _json),
    ((".jsonl",), _json_lines),
    ((".png", ".jpg", ".jpeg"), _image),
    ((".mkv", ".mp4"), _video),
    ((".mcap",), _mcap),
    ((".bag",), _bag),
    ((".db3",), _sqlite_bag),
    ((".las", ".laz"), _las),
    ((".ply",), _after(b"end_header\n")),
    ((".pcd",), _after(b"\nDATA ")),
    ((".npz",), _arrays),
    ((".bin",), _floats),
    ((".parquet",), _table),
    ((".txt", ".csv", ".tum", ".kitti", ".toml"), _text),
    ((".gz",), _unpacked),
    ((".html", ".rrd", ".yaml", ".svg", ".duckdb", ".db", ".md"), _nothing),
)
