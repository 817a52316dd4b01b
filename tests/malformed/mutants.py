"""Mutants of whole drives: each is read to its end, reported and validated in a process of its own with little memory.

A mutant is a drive with one file changed, and is known by the name of the drive and a number, so that each can be made
again: `python -m tests.malformed.mutants NAME NUMBER` shows what becomes of one, with its traceback.
`python -m tests.malformed.mutants NAME --count 2000` tries the first of them, `--count 2000 120`
for two minutes at most, and says how many there were of each outcome, how long they took and the most memory.
`python -m tests.malformed.mutants --every 60` does so with every drive for a minute each, with mutants that nobody
has tried, and fails if one fails; `--every 60 ubx pcap` with these drives.
Mutants with negative numbers have a named pipe, a device, a folder, a socket or a file of 200 GB without content in
the position of a file, or a file that is named by a number beyond 64 bits, or has values nested 100,000 deep.

What may become of a mutant is a scene, or a `SceneloomError`. Any other exception, a process that dies, takes more
memory than `MEMORY`, or longer than `SECONDS`, is a failure.
"""

import os
import re
import resource
import shutil
import socket
import struct
import sys
import tarfile
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from tests.malformed.damage import look_at_everything

SECONDS = 40.0
"""How long one mutant may take; a sound drive takes a fraction of a second, a busy machine ten times as long."""
MEMORY = 2 << 30
"""How much more memory than a sound drive has asked for before a mutant may ask for [bytes of address space]."""

_ROOT = Path(__file__).parents[2]
_HEAD = 400
_TEXTS = ("", "NaN", "-1", "0", "1e999", "-1e308", "99999999999999999999999", "9223372036854775808", "null", "true",
          '"a"', "[]", "{}", "[[[]]]", "1e-320", "Infinity", "\u00e9", "0x10", "-0", "1_0", "\x00")  # fmt: skip
_DEEP = ("[" * 100_000, "[" * 100_000 + "]" * 100_000, '{"a":' * 100_000, "<a>" * 100_000)
_KINDS = {
    "<b": (0, -1, 127, -128),
    "<h": (0, -1, 32767, -32768),
    "<i": (0, -1, 2**31 - 1, -(2**31), 2**28),
    "<q": (0, -1, 2**63 - 1, -(2**63), 2**40),
    "<f": (float("nan"), float("inf"), 3e38, 1e-40),
    "<d": (float("nan"), float("-inf"), 1e308, 1e-310, 0.0),
    ">i": (2**31 - 1, 2**28),
}
_NUMBERS = tuple(struct.pack(kind, value) for kind, values in _KINDS.items() for value in values)


def sound_scene() -> Any:
    """A small drive with sweeps, images, boxes, an IMU and a trajectory."""
    from sceneloom.cameras.camera import Camera
    from sceneloom.simulate import CameraSpec, ImuSpec, LidarSpec, camera_mount, simulate_street

    camera = CameraSpec(Camera("pinhole", 48, 16, 30.0, 30.0, 23.5, 7.5), camera_mount())
    lidar, imu = LidarSpec(beams=4, steps=60), ImuSpec(rate_hz=20.0)
    return simulate_street(5, frames=2, lidar=lidar, cameras=(camera,), imu=imu).scene


Write = Callable[[Path], Path]  # writes a sound drive into an empty folder, and gives its path, of a file or a folder


def _written(name: str, location: str, folder: Path, **options: Any) -> Path:
    from sceneloom.formats import write_scene
    from sceneloom.scene import LabeledPoints, LabeledPointsAnnotation

    scene = sound_scene()
    labels = LabeledPoints("lidar", np.arange(4, dtype=np.uint32), 0)
    road = LabeledPointsAnnotation("road", (labels,), label="road")
    write_scene(replace(scene, annotations=(*scene.annotations, road)), folder / location, format=name, **options)
    return folder / location


def _labelled(name: str, location: str, folder: Path, *parts: str) -> Path:
    """A drive with labels of some kinds, in the format of a labelling tool."""
    from tests.unit.formats.labelling.test_round_trips import scene_of

    from sceneloom.formats import write_scene

    write_scene(scene_of(*parts), folder / location, format=name)
    return folder / location


def _by_test(module: str, function: str, location: str, folder: Path) -> Path:
    """A drive of a format that is only read, made by the writer in the tests of that format."""
    (folder / location).mkdir(exist_ok=True)
    return getattr(import_module(f"tests.unit.formats.{module}"), function)(folder / location)


def _street(folder: Path) -> Path:
    from tests.unit.formats.nuscenes.schema_folder import street, with_classes

    return with_classes(street(folder / "drive"), dict.fromkeys((0, 2, 4), slice(3, 9))).write()


def _t4(folder: Path) -> Path:
    from tests.unit.formats.nuscenes.test_nuscenes import t4_street

    return t4_street(folder / "drive").write()


def _ncore_folder(folder: Path) -> Path:
    archive = _written("ncore", "drive.zarr.itar", folder)
    with tarfile.open(archive) as tar:
        tar.extractall(folder / "drive.zarr", filter="data")
    archive.unlink()
    return folder / "drive.zarr"


def _without_checksums(folder: Path) -> Path:
    """Write an MCAP file with packed chunks and without checksums, so that what is changed in it is looked at."""
    return _rewrite_mcap(_written("mcap", "sound.mcap", folder), folder / "drive.mcap", "ZSTD")


def _flatbuffers(folder: Path) -> Path:
    """Write an MCAP file with messages that are FlatBuffers, without checksums."""
    golden = _ROOT / "tests" / "interop" / "golden" / "foxglove_flatbuffers.mcap"
    return _rewrite_mcap(Path(shutil.copyfile(golden, folder / "sound.mcap")), folder / "drive.mcap", "NONE")


def _rewrite_mcap(sound: Path, target: Path, compression: str) -> Path:
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    with sound.open("rb") as source, target.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType[compression], enable_crcs=False)
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


def rewrite_bag(sound: Path, target: Path, change: Callable[[Any, Any], Any] | None = None, lz4: bool = False) -> Path:
    """Write a bag of ROS 1 again: its messages changed by a function of type and message, or its chunks compressed."""
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag1 import Writer

    bag = Writer(target)
    if lz4:
        bag.set_compression(Writer.CompressionFormat.LZ4)
    with AnyReader([sound]) as reader, bag:
        store = reader.typestore
        known = {one.id: bag.add_connection(one.topic, one.msgtype, typestore=store) for one in reader.connections}
        for connection, time_ns, raw in reader.messages():
            kind = connection.msgtype
            changed = change(kind, reader.deserialize(raw, kind)) if change else None
            bag.write(known[connection.id], time_ns, raw if changed is None else store.serialize_ros1(changed, kind))
    sound.unlink()
    return target


def _packed_bag(folder: Path) -> Path:
    return rewrite_bag(_written("ros1", "sound.bag", folder), folder / "drive.bag", lz4=True)


def _lidar_bag(folder: Path) -> Path:
    return import_module("tests.interop.test_lidar_messages").write_bag(folder)


def _packed_messages(folder: Path) -> Path:
    return import_module("tests.interop.test_packed_messages").write_drive(folder / "drive")


def _copied(location: str, folder: Path) -> Path:
    """A file of someone else, out of the folder of real data."""
    data = os.environ.get("SCENELOOM_DATA", _ROOT.parent / "shared" / "data")
    source = Path(data, "real", "strangers", location)
    return Path(shutil.copyfile(source, folder / source.name))


def _packets(folder: Path) -> Path:
    """Packets of every maker, with the metadata of an Ouster beside."""
    from tests.malformed.test_packets import sound
    from tests.unit.formats.packets.build import pcap

    (folder / "drive.pcap").write_bytes(pcap(sound(folder)))
    return folder / "drive.pcap"


_RIG_FILE = "rig-file"
_RIG_FILES = ("rig.urdf", "camchain.yaml", "mei.yaml", "rig.toml")


def _rig_file(name: str, folder: Path) -> Path:
    from tests.unit.formats.rig_files.test_reader import FILES

    (folder / name).write_text(FILES[name], "utf-8")
    return folder / name


def _folders(*names: str) -> dict[str, Write]:
    return {name: partial(_written, name, "drive") for name in names}


DRIVES: dict[str, Write] = {
    "openlabel": partial(_written, "openlabel", "drive.json"),
    **_folders("kitti-raw", "kitti-object", "laz", "las", "pcd", "ply", "npz"),
    "mcap": partial(_written, "mcap", "drive.mcap"),
    "mcap lz4": partial(_written, "mcap", "drive.mcap", compression="lz4"),
    "mcap zstd unchecked": _without_checksums,
    "mcap flatbuffers": _flatbuffers,
    "ros1": partial(_written, "ros1", "drive.bag", images="raw"),
    "ros1 lz4": _packed_bag,
    **_folders("ros2"),
    "ros2 sqlite": partial(_written, "ros2", "drive", storage="sqlite3"),
    "ros1 lidars": _lidar_bag,
    "lvx": partial(_by_test, "packets.test_livox", "write_file", "."),
    "ros2 packed messages": _packed_messages,
}
"""Writers of sound drives, by their format and what else reports them apart."""

STRANGERS: dict[str, Write] = {
    "mcap stranger": partial(_copied, "mcap/custom-camera-model.mcap"),
    "ros1 stranger lz4": partial(_copied, "ros1_bags/example-lz4.bag"),
    "ros1 stranger tf": partial(_copied, "tf_bags/tf_example.bag"),
    "ros2 stranger tf": partial(_copied, "tf_bags/tf_example.db3"),
    "ros2 stranger radar": partial(_copied, "radar_bag/ars548/1708578204.db3"),
}
"""The same with files of others."""

OTHER_DRIVES: dict[str, Write] = {
    "sfs": partial(_written, "sfs", "drive.sfs"),
    "recording": partial(_written, "recording", "drive"),
    "rig": partial(_by_test, "rig.conftest", "write_folder", "drive"),
    **_folders("kitti-tracking", "kitti-odometry", "kitti-bin", "nuscenes-bin"),
    "nuscenes": _street,
    "nuscenes t4": _t4,
    "ncore": partial(_written, "ncore", "drive.zarr.itar"),
    "ncore folder": _ncore_folder,
    "argoverse2": partial(_by_test, "argoverse2.test_reader", "write_log", "drive"),
    "pandaset": partial(_by_test, "pandaset.test_reader", "write_drive", "drive"),
    "kitti-360": partial(_by_test, "kitti.test_kitti360", "write_data", "drive"),
    "waymo": partial(_by_test, "waymo.test_reader", "write_segment", "drive"),
    "zod": partial(_by_test, "zod.test_reader", "write_sequence", "000002"),
    "scale-toolkit": partial(_by_test, "scale_toolkit.test_reader", "write_folder", "drive"),
    "euroc-mav": partial(_by_test, "euroc_mav.test_reader", "write_drive", "."),
    **_folders("supervisely", "segments", "scale-task", "sustechpoints"),
    "cvat": lambda folder: _labelled("cvat", "a.xml", folder, "boxes", "rotated", "lines"),
    "tracklets": lambda folder: _labelled("tracklets", "a.xml", folder, "cuboids"),
    "coco": lambda folder: _labelled("coco", "a.json", folder, "boxes", "masks", "keypoints"),
    "datumaro": lambda folder: _labelled("datumaro", "a.json", folder, "boxes", "masks", "lines"),
    "yolo": lambda folder: _labelled("yolo", "drive", folder, "boxes", "keypoints"),
    "label-studio": lambda folder: _labelled("label-studio", "a.json", folder, "boxes", "masks"),
    "nmea": partial(_by_test, "gnss_logs.test_nmea", "write_log", "."),
    "ubx": partial(_by_test, "gnss_logs.test_ubx", "write_log", "."),
    "rtklib": partial(_by_test, "gnss_logs.test_rtklib", "write_log", "."),
    "pcap": _packets,
    **{f"{_RIG_FILE} {name}": partial(_rig_file, name) for name in _RIG_FILES},
}
"""Those of the formats whose mutants are tried elsewhere."""

ALL_DRIVES = DRIVES | OTHER_DRIVES | STRANGERS


_WAYS = ("flip", "set", "cut", "double", "remove", "insert", *["number"] * 2, *["token"] * 3, "line")


def mutant_of(content: bytes, chance: np.random.Generator) -> bytes:
    """Change a file in one of many ways; its beginning more often than the rest."""

    def location() -> int:
        reach = len(content) if chance.random() < 0.5 else min(_HEAD, len(content))
        return int(chance.integers(reach + 1))

    way, start = _WAYS[int(chance.integers(len(_WAYS)))], location()
    stop = start + int(chance.integers(1, 65))
    tokens = list(re.finditer(rb"-?\d[\d.eE+-]*|\"[^\"]*\"|[A-Za-z_]+", content)) if way == "token" else []
    if way == "token" and (b"\x00" in content[:_HEAD] or not tokens):  # where there is no text, a number of bytes
        way = "number"
    match way:
        case "flip":
            changed = bytearray(content)
            for _ in range(int(chance.integers(1, 4)) if changed else 0):
                changed[min(location(), len(changed) - 1)] ^= 1 << int(chance.integers(8))
            return bytes(changed)
        case "set":
            return content[:start] + chance.bytes(1) + content[start + 1 :]
        case "cut":
            return content[:start]
        case "double":
            return content[:stop] + content[start:stop] * int(chance.integers(1, 4)) + content[stop:]
        case "remove":
            return content[:start] + content[stop:]
        case "insert":
            return content[:start] + chance.bytes(int(chance.integers(1, 17))) + content[start:]
        case "number":
            number = _NUMBERS[int(chance.integers(len(_NUMBERS)))]
            start -= start % len(number) if chance.random() < 0.5 else 0
            return content[:start] + number + content[start + len(number) :]
        case "token":
            token = tokens[int(chance.integers(len(tokens)))]
            texts = _DEEP if chance.random() < 0.03 else _TEXTS
            text = texts[int(chance.integers(len(texts)))].encode()
            return content[: token.start()] + text + content[token.end() :]
        case _:  # a line left out, or stated twice, or somewhere else
            lines = content.split(b"\n")
            taken = lines.pop(int(chance.integers(len(lines))))
            for _ in range(int(chance.integers(3))):
                lines.insert(int(chance.integers(len(lines) + 1)), taken)
            return b"\n".join(lines)


class Tried:
    """What became of many mutants: how many had each outcome, and the traceback, or the end, of each failure."""

    def __init__(self) -> None:
        self.outcomes: Counter[str] = Counter()
        self.failures: dict[int, str] = {}
        self.until = float("inf")  # when no further mutant is begun

    def __str__(self) -> str:
        kinds: dict[str, list[int]] = {}
        for number, reported in self.failures.items():
            locations = re.findall(r'File "[^"]*/(sceneloom/[^"]*)", line (\d+)', reported)
            last = reported.strip().splitlines()[-1][:120]
            kinds.setdefault(f"{':'.join(locations[-1])}: {last}" if locations else last, []).append(number)
        counts = ", ".join(f"{count} {name}" for name, count in sorted(self.outcomes.items()))
        return "\n".join([counts, *(f"  {len(n)} x {kind} (such as mutant {n[0]})" for kind, n in kinds.items())])


def try_mutants(name: str, numbers: range | None, *, seconds: float = float("inf")) -> Tried:
    """Make mutants of a drive and see what becomes of them.

    Args:
        name: of `ALL_DRIVES`.
        numbers: of the mutants; None for those of `impostors_of`.
        seconds: begin no further mutant after this time from when the sound drive has been read.
    """
    tried = Tried()
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        sound = Path(folder, "sound")
        sound.mkdir()
        ALL_DRIVES[name](sound)
        waiting = list(reversed(impostors_of(_drive_in(sound)) if numbers is None else numbers))
        while waiting and time.monotonic() < tried.until:
            _work_off(name, Path(folder), waiting, tried, seconds)
    return tried


def _drive_in(folder: Path) -> Path:
    """The drive of a folder, in which metadata may be beside it."""
    return min(folder.iterdir(), key=lambda path: path.suffix == ".json")


def _work_off(name: str, folder: Path, waiting: list[int], tried: Tried, seconds: float) -> None:
    """Give mutants to one worker until it dies or none is left."""
    ours, theirs = Pipe()
    worker = get_context("spawn").Process(target=_work, args=(name, folder, theirs))
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    with patch.dict(os.environ, threads), patch.object(sys, "path", [str(_ROOT), *sys.path]):
        worker.start()
    theirs.close()
    try:
        outcome = _answer(ours, 300.0)
        if outcome is None or outcome[0] != "scene":
            raise AssertionError(f"the sound drive {name!r} cannot be read: {outcome}")
        tried.until = min(tried.until, time.monotonic() + seconds)
        while waiting and time.monotonic() < tried.until:
            number = waiting.pop()
            ours.send(number)
            # a video is looked through for ten seconds each time that it is opened
            outcome = _answer(ours, SECONDS if number >= 0 else 3 * SECONDS)
            if outcome is None:
                worker.kill()
                worker.join()
                end = "was killed: it took too long" if worker.exitcode == -9 else f"died: exit code {worker.exitcode}"
                outcome = "failed", f"the process {end}"
            tried.outcomes[outcome[0]] += 1
            if outcome[0] == "failed":
                tried.failures[number] = outcome[1]
            if not worker.is_alive():
                return
    finally:
        worker.kill()
        worker.join()
        ours.close()


def _answer(ours: Connection, seconds: float) -> tuple[str, str] | None:
    """What a worker says next, or None if it dies or takes too long."""
    with suppress(EOFError, ConnectionResetError):
        if ours.poll(seconds):
            answer: tuple[str, str] = ours.recv()
            return answer
    return None


def _work(name: str, folder: Path, theirs: Connection) -> None:
    """Be a worker: take numbers, answer each with an outcome."""
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    sound = _drive_in(folder / "sound")
    with tempfile.TemporaryDirectory(dir=folder) as own:
        drive = Path(own, sound.name)
        shutil.copytree(sound.parent, own, dirs_exist_ok=True)
        outcomes = {_use(drive, name, step) for step in range(len(_STEPS))}
        theirs.send(outcomes.pop() if len(outcomes) == 1 else ("failed", str(outcomes)))
        pages = int(Path("/proc/self/statm").read_text("ascii").split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        while True:
            number = theirs.recv()
            file, content = change(drive, name, number)
            outcome = _use(drive, name, number)
            _restore(file, content)
            theirs.send(outcome)


def change(drive: Path, name: str, number: int) -> tuple[Path, bytes]:
    """Make a mutant of a drive in place; gives the file that was changed and what it was before."""
    chance = np.random.default_rng([abs(number), *name.encode()])
    kinds = kinds_of_files(drive)
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


def kinds_of_files(drive: Path) -> list[list[Path]]:
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


def _make_socket(name: str, _: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as there:
        there.bind(name)


def _make_sparse(name: str, content: bytes) -> None:
    Path(name).write_bytes(content)
    os.truncate(name, SPARSE)


def _nest(name: str, content: bytes) -> None:
    """Put lists in lists, or elements in elements, into the position of the first value, or of all that there is."""
    opened, closed = (b"<a>", b"</a>") if name.endswith(".xml") else (b"[", b"]")
    if name.endswith((".xml", ".json", ".jsonl", ".toml", ".yaml", ".yml")):
        first = re.search(rb"(?<=: )[^\s,{}\[\]]+|(?<=\":)[^\s,{}\[\]]+|(?<= = )[^\s,{}\[\]]+", content)
        start, stop = first.span() if first and opened == b"[" else (0, len(content))
        content = content[:start] + opened * 100_000 + closed * 100_000 + content[stop:]
    Path(name).write_bytes(content)


_LARGE = "9999999999999999999"  # a number that 64 bits with a sign do not hold

SPARSE = 200_000_000_000 // 55_200 * 55_200
"""Length of files without content [bytes]: a whole number of points of every kind."""

IMPOSTORS: dict[str, Callable[[str, bytes], object]] = {
    "pipe": lambda name, _: os.mkfifo(name),
    "device": lambda name, _: Path(name).symlink_to("/dev/zero"),
    "folder": lambda name, _: Path(name).mkdir(),
    "socket": _make_socket,
    "sparse": _make_sparse,
    "number": lambda name, content: Path(f"{_LARGE}{Path(name).suffix}").write_bytes(content),
    "nested": _nest,
}
"""What stands in the position of a file, and the function that makes it there, given what the file held."""


def impostors_of(drive: Path) -> range:
    """The numbers of the mutants that have something else in the position of a file, for each kind of file."""
    return range(-len(IMPOSTORS) * len(kinds_of_files(drive)), 0)


def _use(drive: Path, name: str, number: int) -> tuple[str, str]:
    """Read a drive, then do one of several things with it, by the number."""
    from sceneloom.errors import SceneloomError

    outcome = "scene"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for step in (_read_rig_file,) if name.startswith(_RIG_FILE) else (read, _STEPS[number % len(_STEPS)]):
                try:
                    step(drive, name)
                except SceneloomError:
                    outcome = "refused"
    except BaseException:  # noqa: BLE001 - whatever else it is, it is what is looked for
        return "failed", traceback.format_exc()
    return outcome, ""


def read(drive: Path, name: str, *, lenient: bool = False) -> None:
    import sceneloom

    with sceneloom.open(drive, format=name.split(maxsplit=1)[0], lenient=lenient) as scene:
        look_at_everything(scene)


def _read_rig_file(drive: Path, _: str) -> None:
    from sceneloom.formats.rig_files.reader import read_rig

    read_rig(drive)


def _run_verb(*arguments: str) -> None:
    from click.testing import CliRunner

    from sceneloom.cli.main import sceneloom

    result = CliRunner().invoke(sceneloom, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception


_STEPS: tuple[Callable[[Path, str], None], ...] = (
    lambda drive, name: read(drive, name, lenient=True),
    lambda drive, _: _run_verb("info", str(drive)),
    lambda drive, _: _run_verb("validate", str(drive), "--json"),
)


def _try_every(seconds: float, names: list[str]) -> bool:
    """Try new mutants of drives, and say what became of them; gives whether none failed."""
    from sceneloom.formats.base.registry import format_named, format_names

    start, sound = int(time.time()) << 20, True

    def tried(name: str) -> Tried | Exception:
        try:
            return try_mutants(name, range(start, start + (1 << 20)), seconds=seconds)
        except (FileNotFoundError, ImportError) as missing:  # no files of others, or no library that reads them
            return missing

    chosen = names or list(ALL_DRIVES)
    with ThreadPoolExecutor(os.cpu_count()) as threads:  # each waits for a worker of its own
        for name, outcome in zip(chosen, threads.map(tried, chosen), strict=True):
            if isinstance(outcome, Exception):
                sys.stdout.write(f"{name}: left out: {outcome}\n")
                continue
            sys.stdout.write(f"{name}: {outcome.outcomes.total()} mutants: {outcome}\n")
            sys.stdout.flush()
            sound &= not outcome.failures
    known = {name.split(maxsplit=1)[0] for name in ALL_DRIVES}
    left = [name for name in format_names() if name not in known and format_named(name).reads]
    if left and not names:
        sys.stdout.write(f"no sample of: {', '.join(left)}\n")
    return sound


def _main() -> None:
    arguments = sys.argv[1:]
    if arguments[0] == "--every":
        sys.exit(not _try_every(float(arguments[1]), arguments[2:]))
    if arguments[1] in {"--count", "--impostors"}:
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
