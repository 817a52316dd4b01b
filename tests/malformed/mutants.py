"""Mutants of whole drives: each is read to its end, reported and validated in a process of its own with little memory.

A mutant is a drive with one file changed, and is known by the name of the drive and a number, so that each can be made
again: `python -m tests.malformed.mutants NAME NUMBER` shows what becomes of one, with its traceback.
`python -m tests.malformed.mutants NAME --count 2000` tries the first of them, `--count 2000 120`
for two minutes at most, and says how many there were of each outcome, how long they took and the most memory.
Mutants with negative numbers have a named pipe, a device, a folder, a socket or a file of 200 GB without content in
the position of a file, or a file that is named by a number beyond 64 bits, or has values nested 100,000 deep.

What may become of a mutant is a scene, or a `SceneloomError`. Any other exception, a process that dies, takes more
memory than `MEMORY`, or longer than `SECONDS`, is a failure.
"""

import json
import os
import re
import resource
import select
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

SECONDS = 40.0
"""How long one mutant may take; a sound drive takes a fraction of a second, a busy machine ten times as long."""
MEMORY = 2 << 30
"""How much more memory than a sound drive has asked for before a mutant may ask for [bytes of address space]."""

_ROOT = Path(__file__).parents[2]
_HEAD = 400
_TEXTS = ("", "NaN", "-1", "0", "1e999", "-1e308", "99999999999999999999999", "9223372036854775808", "null", "true",
          '"a"', "[]", "{}", "[[[]]]", "1e-320", "Infinity", "\u00e9", "0x10", "-0", "1_0", "\x00")  # fmt: skip
_DEEP = ("[" * 100_000, "[" * 100_000 + "]" * 100_000, '{"a":' * 100_000, "<a>" * 100_000)
_NUMBERS = tuple(
    struct.pack(kind, value)
    for kind, values in (
        ("<b", (0, -1, 127, -128)),
        ("<h", (0, -1, 32767, -32768)),
        ("<i", (0, -1, 2**31 - 1, -(2**31), 2**28)),
        ("<q", (0, -1, 2**63 - 1, -(2**63), 2**40)),
        ("<f", (float("nan"), float("inf"), 3e38, 1e-40)),
        ("<d", (float("nan"), float("-inf"), 1e308, 1e-310, 0.0)),
        (">i", (2**31 - 1, 2**28)),
    )
    for value in values
)


def sound_scene() -> Any:
    """A small drive with sweeps, images, boxes, an IMU and a trajectory."""
    from sceneloom.cameras.camera import Camera
    from sceneloom.simulate import CameraSpec, ImuSpec, LidarSpec, camera_mount, simulate_street

    camera = CameraSpec(Camera("pinhole", 48, 16, 30.0, 30.0, 23.5, 7.5), camera_mount())
    lidar, imu = LidarSpec(beams=4, steps=60), ImuSpec(rate_hz=20.0)
    return simulate_street(5, frames=2, lidar=lidar, cameras=(camera,), imu=imu).scene


def _written(name: str, location: str, **options: Any) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        from sceneloom.formats import write_scene

        write_scene(sound_scene(), folder / location, format=name, **options)
        return folder / location

    return write


def _by_test(module: str, function: str, location: str = "drive") -> Callable[[Path], Path]:
    """A drive of a format that is only read, made by the writer in the tests of that format."""

    def write(folder: Path) -> Path:
        (folder / location).mkdir(exist_ok=True)
        written: Path = getattr(import_module(f"tests.unit.formats.{module}"), function)(folder / location)
        return written

    return write


def _street(folder: Path) -> Path:
    """A folder of the nuScenes schema."""
    from tests.unit.formats.nuscenes.schema_folder import street
    from tests.unit.formats.nuscenes.test_writer import with_classes

    written: Path = with_classes(street(folder / "drive")).write()
    return written


def _without_checksums(folder: Path) -> Path:
    """Write an MCAP file with packed chunks and without checksums, so that what is changed in it is looked at."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    sound = _written("mcap", "sound.mcap")(folder)
    target = folder / "drive.mcap"
    with sound.open("rb") as source, target.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_crcs=False)
        writer.start(profile="", library="another")
        known: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.id not in known:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(known[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    sound.unlink()
    return target


def _packed_bag(folder: Path) -> Path:
    """Write a bag of ROS 1 whose chunks are compressed."""
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag1 import Writer

    sound = _written("ros1", "sound.bag")(folder)
    bag = Writer(folder / "drive.bag")
    bag.set_compression(Writer.CompressionFormat.LZ4)
    with AnyReader([sound]) as reader, bag:
        known = {
            one.id: bag.add_connection(one.topic, one.msgtype, typestore=reader.typestore) for one in reader.connections
        }
        for connection, time_ns, content in reader.messages():
            bag.write(known[connection.id], time_ns, content)
    sound.unlink()
    return folder / "drive.bag"


def _copied(location: str) -> Callable[[Path], Path]:
    """A file of someone else, out of the folder of real data."""

    def copy(folder: Path) -> Path:
        data = os.environ.get("SCENELOOM_DATA", _ROOT.parent / "shared" / "data")
        source = Path(data, "real", "strangers", location)
        return Path(shutil.copyfile(source, folder / source.name))

    return copy


DRIVES: dict[str, Callable[[Path], Path]] = {
    "openlabel": _written("openlabel", "drive.json"),
    "kitti-raw": _written("kitti-raw", "drive"),
    "kitti-object": _written("kitti-object", "drive"),
    "laz": _written("laz", "drive"),
    "las": _written("las", "drive"),
    "pcd": _written("pcd", "drive"),
    "ply": _written("ply", "drive"),
    "npz": _written("npz", "drive"),
    "mcap": _written("mcap", "drive.mcap"),
    "mcap lz4": _written("mcap", "drive.mcap", compression="lz4"),
    "mcap zstd unchecked": _without_checksums,
    "ros1": _written("ros1", "drive.bag", images="raw"),
    "ros1 lz4": _packed_bag,
    "ros2": _written("ros2", "drive"),
    "ros2 sqlite": _written("ros2", "drive", storage="sqlite3"),
}
"""Writers of sound drives, by their format and what else reports them apart.

Each takes an empty folder and gives the path of the drive in it, a file or a folder.
"""

STRANGERS: dict[str, Callable[[Path], Path]] = {
    "mcap stranger": _copied("mcap/custom-camera-model.mcap"),
    "ros1 stranger lz4": _copied("ros1_bags/example-lz4.bag"),
    "ros1 stranger tf": _copied("tf_bags/tf_example.bag"),
    "ros2 stranger tf": _copied("tf_bags/tf_example.db3"),
    "ros2 stranger radar": _copied("radar_bag/ars548/1708578204.db3"),
}
"""The same with files of others."""

OTHER_DRIVES: dict[str, Callable[[Path], Path]] = {
    "sfs": _written("sfs", "drive.sfs"),
    "recording": _written("recording", "drive"),
    "rig": _by_test("rig.conftest", "write_folder"),
    "kitti-tracking": _written("kitti-tracking", "drive"),
    "kitti-odometry": _written("kitti-odometry", "drive"),
    "kitti-bin": _written("kitti-bin", "drive"),
    "nuscenes-bin": _written("nuscenes-bin", "drive"),
    "nuscenes": _street,
    "argoverse2": _by_test("argoverse2.test_read", "write_log"),
    "pandaset": _by_test("pandaset.test_read", "write_drive"),
    "scale-toolkit": _by_test("scale_toolkit.test_read", "write_folder"),
    "euroc-mav": _by_test("euroc_mav.test_euroc_mav", "write_drive", "."),
}
"""Those of the formats whose mutants are tried elsewhere."""

ALL_DRIVES = DRIVES | OTHER_DRIVES | STRANGERS


def mutant_of(content: bytes, chance: np.random.Generator) -> bytes:
    """Change a file in one of many ways; its beginning more often than the rest."""
    return _TRAJECTORIES[int(chance.integers(len(_TRAJECTORIES)))](content, chance)


def _location(content: bytes, chance: np.random.Generator) -> int:
    reach = len(content) if chance.random() < 0.5 else min(_HEAD, len(content))
    return int(chance.integers(reach + 1))


def _span(content: bytes, chance: np.random.Generator) -> tuple[int, int]:
    start = _location(content, chance)
    return start, start + int(chance.integers(1, 65))


def _flipped(content: bytes, chance: np.random.Generator) -> bytes:
    changed = bytearray(content)
    for _ in range(int(chance.integers(1, 4))):
        if changed:
            changed[min(_location(content, chance), len(changed) - 1)] ^= 1 << int(chance.integers(8))
    return bytes(changed)


def _set(content: bytes, chance: np.random.Generator) -> bytes:
    location = _location(content, chance)
    return content[:location] + chance.bytes(1) + content[location + 1 :]


def _cut(content: bytes, chance: np.random.Generator) -> bytes:
    return content[: _location(content, chance)]


def _doubled(content: bytes, chance: np.random.Generator) -> bytes:
    start, stop = _span(content, chance)
    return content[:stop] + content[start:stop] * int(chance.integers(1, 4)) + content[stop:]


def _removed(content: bytes, chance: np.random.Generator) -> bytes:
    start, stop = _span(content, chance)
    return content[:start] + content[stop:]


def _inserted(content: bytes, chance: np.random.Generator) -> bytes:
    location = _location(content, chance)
    return content[:location] + chance.bytes(int(chance.integers(1, 17))) + content[location:]


def _numbered(content: bytes, chance: np.random.Generator) -> bytes:
    location, number = _location(content, chance), _NUMBERS[int(chance.integers(len(_NUMBERS)))]
    if chance.random() < 0.5:
        location -= location % len(number)
    return content[:location] + number + content[location + len(number) :]


def _replaced(content: bytes, chance: np.random.Generator) -> bytes:
    """Put something else for a number or a word of a text; where there is no text, for a number of bytes."""
    if b"\x00" in content[:_HEAD]:
        return _numbered(content, chance)
    tokens = list(re.finditer(rb"-?\d[\d.eE+-]*|\"[^\"]*\"|[A-Za-z_]+", content))
    if not tokens:
        return _inserted(content, chance)
    token = tokens[int(chance.integers(len(tokens)))]
    texts = _DEEP if chance.random() < 0.03 else _TEXTS
    text = texts[int(chance.integers(len(texts)))].encode()
    return content[: token.start()] + text + content[token.end() :]


def _relined(content: bytes, chance: np.random.Generator) -> bytes:
    """Leave a line out, or state it twice, or somewhere else."""
    lines = content.split(b"\n")
    taken = lines.pop(int(chance.integers(len(lines))))
    for _ in range(int(chance.integers(3))):
        lines.insert(int(chance.integers(len(lines) + 1)), taken)
    return b"\n".join(lines)


_TRAJECTORIES = (_flipped, _set, _cut, _doubled, _removed, _inserted, _numbered, _numbered, _replaced,
    _replaced, _replaced,
         _relined)  # fmt: skip


@dataclass(frozen=True)
class Failure:
    """What should not have become of a mutant.

    Attributes:
        number: which mutant.
        reported: the traceback, or what became of the process.
    """

    number: int
    reported: str

    @property
    def kind(self) -> str:
        """The same for failures of one cause: where the exception came from, or what became of the process."""
        locations = re.findall(r'File "[^"]*/(sceneloom/[^"]*)", line (\d+)', self.reported)
        last = self.reported.strip().splitlines()[-1][:120]
        return f"{':'.join(locations[-1])}: {last}" if locations else last


class Tried:
    """What became of many mutants."""

    def __init__(self) -> None:
        self.outcomes: Counter[str] = Counter()
        self.failures: list[Failure] = []

    def __str__(self) -> str:
        counts = ", ".join(f"{count} {name}" for name, count in sorted(self.outcomes.items()))
        kinds: dict[str, list[Failure]] = {}
        for failure in self.failures:
            kinds.setdefault(failure.kind, []).append(failure)
        lines = [f"  {len(found)} x {kind} (such as mutant {found[0].number})" for kind, found in kinds.items()]
        return "\n".join([counts, *lines])


def try_mutants(name: str, numbers: range | None, *, seconds: float = float("inf")) -> Tried:
    """Make mutants of a drive and see what becomes of them.

    Args:
        name: of `ALL_DRIVES`.
        numbers: of the mutants; None for those of `impostors_of`.
        seconds: begin no further mutant after this time.
    """
    tried, stop = Tried(), time.monotonic() + seconds
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        sound = Path(folder, "sound")
        sound.mkdir()
        ALL_DRIVES[name](sound)
        waiting = list(reversed(impostors_of(next(sound.iterdir())) if numbers is None else numbers))
        while waiting and time.monotonic() < stop:
            _work_off(name, Path(folder), waiting, tried, stop)
    return tried


def _work_off(name: str, folder: Path, waiting: list[int], tried: Tried, stop: float) -> None:
    """Give mutants to one worker until it dies or none is left."""
    with _worker(name, folder) as worker:
        reported = _answer(worker, 300.0)
        if reported is None or reported["outcome"] != "scene":
            raise AssertionError(f"the sound drive {name!r} cannot be read: {reported}")
        while waiting and time.monotonic() < stop:
            number = waiting.pop()
            worker.stdin.write(f"{number}\n".encode())
            worker.stdin.flush()
            # a video is looked through for ten seconds each time that it is opened
            reported = _answer(worker, SECONDS if number >= 0 else 3 * SECONDS)
            if reported is None:
                worker.kill()
                code = worker.wait()
                support = "was killed: it took too long" if code == -9 else f"died: exit code {code}"
                tried.outcomes["failed"] += 1
                tried.failures.append(Failure(number, f"the process {support}"))
                return
            tried.outcomes[reported["outcome"]] += 1
            if reported["outcome"] == "failed":
                tried.failures.append(Failure(number, reported["reported"]))


@contextmanager
def _worker(name: str, folder: Path) -> Iterator[Any]:
    command = [sys.executable, "-m", "tests.malformed.mutants", "--worker", name, str(folder)]
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    worker = subprocess.Popen(
        command,
        cwd=_ROOT,
        env={**os.environ, **threads},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield worker
    finally:
        worker.kill()
        worker.wait()
        for stream in (worker.stdin, worker.stdout):
            with suppress(OSError):
                stream.close()


def _answer(worker: Any, seconds: float) -> dict[str, Any] | None:
    """The next line of a worker, or None if it dies or takes too long."""
    found, stop = b"", time.monotonic() + seconds
    while not found.endswith(b"\n"):
        ready, _, _ = select.select([worker.stdout], [], [], max(stop - time.monotonic(), 0.0))
        piece = os.read(worker.stdout.fileno(), 1 << 20) if ready else b""
        if not piece:
            return None
        found += piece
    answer: dict[str, Any] = json.loads(found)
    return answer


def _work(name: str, folder: Path) -> None:
    """Be a worker: read numbers from the standard input, answer with a line each."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    sound = next((folder / "sound").iterdir())
    with tempfile.TemporaryDirectory(dir=folder) as own:
        drive = Path(own, sound.name)
        (shutil.copytree if sound.is_dir() else shutil.copy)(sound, drive)
        outcome = [_use(drive, name, step) for step in range(len(_STEPS))]
        answers.write(json.dumps({"outcome": outcome[0][0] if len(set(outcome)) == 1 else str(outcome)}) + "\n")
        pages = int(Path("/proc/self/statm").read_text("ascii").split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        for line in sys.stdin:
            number = int(line)
            file, content = change(drive, name, number)
            outcome, reported = _use(drive, name, number)
            _restore(file, content)
            answers.write(json.dumps({"outcome": outcome, "reported": reported}) + "\n")


def change(drive: Path, name: str, number: int) -> tuple[Path, bytes]:
    """Make a mutant of a drive in place; gives the file that was changed and what it was before."""
    chance = np.random.default_rng([abs(number), *name.encode()])
    kinds = _kinds_of_files(drive)
    if number < 0:
        file = kinds[(-number - 1) // len(IMPOSTORS)][0]
        content = file.read_bytes()
        file.unlink()
        os.chdir(file.parent)
        list(IMPOSTORS.values())[(-number - 1) % len(IMPOSTORS)](file.name, content)
        return file, content
    files = kinds[int(chance.integers(len(kinds)))]
    file = files[int(chance.integers(len(files)))]
    content = file.read_bytes()
    file.write_bytes(mutant_of(content, chance))
    return file, content


def _kinds_of_files(drive: Path) -> list[list[Path]]:
    """All files of a drive, those of one ending in one folder together, unless each has a name of its own."""
    kinds: dict[Any, list[Path]] = {}
    for file in sorted(file for file in drive.rglob("*") if file.is_file()) if drive.is_dir() else [drive]:
        stem = re.sub(r"\d+", "0", file.stem)
        kinds.setdefault((file.parent, stem, file.suffix), []).append(file)
    return list(kinds.values())


def _restore(file: Path, content: bytes) -> None:
    if file.is_dir():
        file.rmdir()
    for there in (file, file.with_name(f"{_LARGE}{file.suffix}")):
        there.unlink(missing_ok=True)
    file.write_bytes(content)


def _make_socket(name: str, content: bytes) -> None:
    del content
    with socket.socket(socket.AF_UNIX) as there:
        there.bind(name)


def _make_sparse(name: str, content: bytes) -> None:
    Path(name).write_bytes(content)
    os.truncate(name, SPARSE)


def _make_number(name: str, content: bytes) -> None:
    """Name a file by a number that 64 bits with a sign do not hold."""
    Path(f"{_LARGE}{Path(name).suffix}").write_bytes(content)


def _nest(name: str, content: bytes) -> None:
    """Put lists in lists, or elements in elements, into the position of the first value, or of all that there is."""
    opened, closed = (b"<a>", b"</a>") if name.endswith(".xml") else (b"[", b"]")
    if name.endswith((".xml", ".json", ".jsonl", ".toml", ".yaml", ".yml")):
        first = re.search(rb"(?<=: )[^\s,{}\[\]]+|(?<=\":)[^\s,{}\[\]]+|(?<= = )[^\s,{}\[\]]+", content)
        start, stop = first.span() if first and opened == b"[" else (0, len(content))
        content = content[:start] + opened * _DEPTH + closed * _DEPTH + content[stop:]
    Path(name).write_bytes(content)


_LARGE, _DEPTH = "9999999999999999999", 100_000

SPARSE = 200_000_000_000 // 55_200 * 55_200
"""Length of files without content [bytes]: a whole number of points of every kind."""

IMPOSTORS: dict[str, Callable[[str, bytes], None]] = {
    "pipe": lambda name, _: os.mkfifo(name),
    "device": lambda name, _: Path(name).symlink_to("/dev/zero"),
    "folder": lambda name, _: Path(name).mkdir(),
    "socket": _make_socket,
    "sparse": _make_sparse,
    "number": _make_number,
    "nested": _nest,
}
"""What stands in the position of a file, and the function that makes it there, given what the file held."""


def impostors_of(drive: Path) -> range:
    """The numbers of the mutants that have something else in the position of a file, for each kind of file."""
    return range(-len(IMPOSTORS) * len(_kinds_of_files(drive)), 0)


def _use(drive: Path, name: str, number: int) -> tuple[str, str]:
    """Read a drive, then do one of several things with it, by the number."""
    from sceneloom.errors import SceneloomError

    outcome = "scene"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for step in (_read, _STEPS[number % len(_STEPS)]):
                try:
                    step(drive, name)
                except SceneloomError:
                    outcome = "refused"
    except BaseException:  # noqa: BLE001 - whatever else it is, it is what is looked for
        return "failed", traceback.format_exc()
    return outcome, ""


def _read(drive: Path, name: str, *, lenient: bool = False) -> None:
    """Open a drive and read all that is in it."""
    import sceneloom

    with sceneloom.open(drive, format=name.split(maxsplit=1)[0], lenient=lenient) as scene:
        for sensor in scene.sensors:
            for frame in getattr(sensor, "frames", ()):
                points = frame.points
                for part in ("positions", "intensities", "timestamps_ns", "colors"):
                    getattr(points, part, None)
            for image in getattr(sensor, "images", ()):
                image.decode()
        for annotation in scene.annotations:
            list(getattr(annotation, "labeled_points", ()))


def _read_leniently(drive: Path, name: str) -> None:
    _read(drive, name, lenient=True)


def _notify(drive: Path, name: str) -> None:
    """Do what `info` does, the format found by the content."""
    del name
    _run_verb("info", str(drive))


def _validate(drive: Path, name: str) -> None:
    del name
    _run_verb("validate", str(drive), "--json")


def _run_verb(*arguments: str) -> None:
    from click.testing import CliRunner

    from sceneloom.cli.main import sceneloom

    result = CliRunner().invoke(sceneloom, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception


_STEPS: tuple[Callable[[Path, str], None], ...] = (_read_leniently, _notify, _validate)


def _main() -> None:
    arguments = sys.argv[1:]
    if arguments[0] == "--worker":
        _work(arguments[1], Path(arguments[2]))
    elif arguments[1] in {"--count", "--impostors"}:
        begun = time.monotonic()
        numbers = range(int(arguments[2])) if arguments[1] == "--count" else None
        seconds = float(arguments[3]) if len(arguments) > 3 else float("inf")
        tried = try_mutants(arguments[0], numbers, seconds=seconds)
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss >> 10
        took = time.monotonic() - begun
        sys.stdout.write(f"{arguments[0]}: {tried}\n  {took:.0f} s, at most {peak} MiB in one process\n")
    else:
        with tempfile.TemporaryDirectory() as folder:
            drive = ALL_DRIVES[arguments[0]](Path(folder))
            file, content = change(drive, arguments[0], int(arguments[1]))
            sys.stdout.write(f"{file.relative_to(folder)}: {len(content)} -> {file.stat().st_size} bytes\n")
            sys.stdout.write("\n".join(_use(drive, arguments[0], int(arguments[1]))) + "\n")


if __name__ == "__main__":
    _main()
