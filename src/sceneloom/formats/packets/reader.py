"""Open a capture of a network as a scene: its lidars, with their IMUs and satellite receivers."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.gnss_logs.nmea import checksum_of, day_of, position_of, time_of_day
from sceneloom.formats.packets import hesai, livox, ouster, robosense, velodyne
from sceneloom.formats.packets.captures import Datagrams, read_datagrams
from sceneloom.formats.packets.spec import CaptureReading
from sceneloom.formats.packets.sweeps import PacketDecoder, find_sweeps, no_sweeps
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

_SAMPLE = 64  # packets by which a stream is recognised
_CHUNK = 2048  # packets that are searched together
_OUSTER_PORT, _SHORTEST = 7502, 560  # packets of returns are longer, and of no state
_NAMES_LISTED = 5
_FAR_NS = 100_000_000_000  # a receiver's clock that is farther from the capturing one is not believed
_DAY_NS = 86_400_000_000_000

_MAKERS = (velodyne, hesai, robosense, livox)
"""The modules of makers whose packets tell their model: each has `MODELS`, `recognise` and `decoder_of`."""

_EGO_FROM_Y_FORWARD = RigidTransform(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
"""Hesai's axes are x right, y forward, z up."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stream:
    """The datagrams of one length from one sender to one port."""

    datagrams: Datagrams
    rows: Int64Array

    @property
    def length(self) -> int:
        return int(self.datagrams.lengths[self.rows[0]])

    @property
    def host(self) -> str:
        return self.datagrams.sender.rpartition(":")[0]

    @property
    def arrivals_ns(self) -> Int64Array:
        found: Int64Array = self.datagrams.arrivals_ns[self.rows]
        return found

    def packets(self, count: int | None = None) -> UInt8Array:
        return self.datagrams.payloads(self.rows[:count])

    def state(self) -> UInt8Array | None:
        """The first DIFOP packet of a RoboSense lidar that sends them to the port of its returns; None without any."""
        for start in range(0, len(self.rows), _CHUNK):
            packets: UInt8Array = self.datagrams.payloads(self.rows[start : start + _CHUNK])
            packet: UInt8Array
            for packet in packets[robosense.states(packets)][:1]:
                return packet
        return None


def open_capture(path: Path, *, options: CaptureReading) -> Scene:
    """Open a capture: every datagram is looked at, no point is decoded.

    Raises:
        DataError: the file is no capture, has no packets of lidars that are known, or metadata are missing or wrong.
        OptionError: there is no such model.
    """
    ledger = Ledger(lenient=options.lenient)
    with ledger.telling():
        streams = [stream for flow in read_datagrams(path, ledger) for stream in _streams(flow)]
        sensors = _Capture(path, options, ledger, streams).sensors()
    return Scene(tuple(sensors), source=str(path), format="pcap", warnings=ledger.warnings)


def _streams(flow: Datagrams) -> list[_Stream]:
    """The datagrams of a flow by their lengths."""
    order = np.argsort(flow.lengths, kind="stable")
    changes = np.flatnonzero(np.diff(flow.lengths[order])) + 1
    return [_Stream(flow, rows) for rows in np.split(order, changes)]


def check_model(options: CaptureReading) -> None:
    """Raise an OptionError where there is no such model."""
    known = [name for maker in _MAKERS for name in maker.MODELS]
    if options.model is not None and options.model not in known:
        raise OptionError(f"model {options.model!r}; expected one of {', '.join(known)}")


def decoder_of(
    packets: UInt8Array, options: CaptureReading, angles: Path | None, state: UInt8Array | None
) -> PacketDecoder | None:
    """What decodes the packets that some of them, (P, L) uint8, are of; None where they are of no model that is known.

    Args:
        packets: some of them.
        options: may name the model.
        angles: file of the lidar's angles, if there is one.
        state: a packet in which the lidar states its angles, if there is one.

    Raises:
        DataError: angles are missing or wrong.
    """
    maker, key = next(((one, key) for one in _MAKERS if (key := one.recognise(packets))), (None, None))
    if maker is None or key is None:
        return None
    if options.model is not None and options.model in maker.MODELS:
        key = options.model
    return livox.decoder_of(key, packets) if maker is livox else maker.decoder_of(key, angles, state)


def find_angles(path: Path, options: CaptureReading, name: str) -> Path | None:
    """The file of angles of the lidar of a name: of the option, else one of the name of the capture or bag."""
    for one in (options.angles or "").split(","):
        stated, equals, file = one.strip().rpartition("=")
        if file and (not equals or stated == name):
            return Path(file)
    if options.angles:
        return None
    beside = (path.with_suffix(suffix) for suffix in (".csv", ".dat", ".yaml", ".yml"))
    return next((file for file in beside if file.is_file()), None)


def find_metadata(path: Path, options: CaptureReading) -> list[ouster.OusterMetadata]:
    """The metadata that are named, else those beside the capture or bag: of its name, or all that lie there.

    Raises:
        DataError: what is named is no metadata.
    """
    if options.metadata is not None:
        return [ouster.read_metadata(Path(name.strip())) for name in options.metadata.split(",")]
    named = path.with_suffix(".json")
    try:
        files = [named] if named.is_file() else sorted(path.parent.glob("*.json"))[:_SAMPLE]
    except OSError:
        return []
    found = []
    for file in files:
        try:
            found.append(ouster.read_metadata(file))
        except DataError as error:
            if file == named and error.location == "udp_profile_lidar":
                raise
    return found


class _Capture:
    """The streams of a capture, and what was found of them."""

    def __init__(self, path: Path, options: CaptureReading, ledger: Ledger, streams: Sequence[_Stream]) -> None:
        self.path, self.options, self.ledger = path, options, ledger
        self.left = list(streams)
        self.imus: list[tuple[_Stream, ouster.OusterMetadata]] = []
        check_model(options)

    def sensors(self) -> list[Sensor]:
        lidars: list[LidarSensor] = []
        shifts_ns: dict[str, int] = {}
        for stream, decoder in (*self._ousters(), *self._others()):
            where = f"{self.path}: {stream.datagrams.sender}"
            found = find_sweeps(stream.datagrams, stream.rows, stream.arrivals_ns, decoder, where, self.ledger)
            if found is None:
                continue
            shifts_ns.setdefault(stream.host, int(found.shifts_ns[0]))
            mount = _EGO_FROM_Y_FORWARD if isinstance(decoder, hesai.HesaiDecoder) else RigidTransform.identity()
            sender = MappingProxyType({"sender": stream.datagrams.sender})
            lidar = LidarSensor(
                f"lidar_{len(lidars) + 1}", found.frames, mount=mount, model=decoder.model, extras=sender
            )
            lidars.append(lidar)
        if not lidars:
            self._note_left()
            raise no_sweeps(self.path, "no packets of lidars that can be read")
        message = "where the lidar sits on the ego is not known; it is put at its origin"
        self.ledger.note(WarningKind.ASSUMED, "extrinsics-unknown", str(self.path), message, count=len(lidars))
        others = [*self._inertial(shifts_ns), *self._receivers()]
        self._note_left()
        return [*([replace(lidars[0], id="lidar")] if len(lidars) == 1 else lidars), *others]

    def _taken(self, is_one: Callable[[_Stream], bool]) -> list[_Stream]:
        """Streams of a kind, which nobody else is to look at."""
        found = [stream for stream in self.left if is_one(stream)]
        self.left = [stream for stream in self.left if stream not in found]
        return found

    def _others(self) -> Iterator[tuple[_Stream, PacketDecoder]]:
        """Streams of lidars whose packets say which model they are of, and what decodes them."""
        samples = [(one, one.packets(_SAMPLE)) for one in self._taken(lambda one: one.length >= _SHORTEST)]
        states: dict[str, UInt8Array] = {}
        for stream, packets in samples:
            for packet in packets[robosense.states(packets)][:1]:
                states.setdefault(stream.host, packet)
        for stream, packets in samples:
            if robosense.states(packets).all():
                continue
            angles, state = find_angles(self.path, self.options, stream.host), states.get(stream.host)
            try:
                if angles is None and state is None and robosense.recognise(packets) is not None:
                    state = stream.state()
                decoder = decoder_of(packets, self.options, angles, state)
            except DataError as error:
                self.ledger.fault("lidar-unreadable", error)
                continue
            if decoder is None:
                self.left.append(stream)
            else:
                yield stream, decoder

    # Ouster

    def _ousters(self) -> Iterator[tuple[_Stream, PacketDecoder]]:
        """Streams of Ouster's lidars, whose packets only their metadata explain; streams of their IMUs are kept."""
        known = find_metadata(self.path, self.options)
        for stream in self._taken(lambda one: any(one.length == metadata.length for metadata in known)):
            fitting = [metadata for metadata in known if metadata.length == stream.length]
            session = ouster.session_of(stream.packets(1), fitting[0])
            # of several sensors with packets of one length the one of this start of the sensor, or of this port
            metadata = max(
                fitting, key=lambda one: (one.session == session != 0, one.ports[0] == stream.datagrams.port)
            )
            if 0 not in (metadata.session, session) and metadata.session != session:
                message = "the metadata are of another start of the sensor than its packets"
                self.ledger.note(WarningKind.ASSUMED, "metadata-of-another-start", metadata.file, message)
            if metadata.imu_profile != "OFF":
                length, port = metadata.imu_length, metadata.ports[1]
                own = self._taken(
                    lambda one: one.host == stream.host and one.length == length and port in (0, one.datagrams.port)  # noqa: B023
                )
                self.imus += [(imu, metadata) for imu in own]
            yield stream, ouster.OusterDecoder(metadata)
        for stream in self._taken(lambda one: one.datagrams.port == _OUSTER_PORT and one.length > _SHORTEST):
            stated = ", ".join(f"{one.file} ({one.length} bytes)" for one in known) or "none"
            problem = (
                f"packets of {stream.length} bytes to port {_OUSTER_PORT}, as of an Ouster; expected its metadata "
                f"beside the capture or as `--input-option metadata=FILE.json`, found {stated}"
            )
            self.ledger.fault("lidar-unreadable", DataError(self.path, stream.datagrams.sender, problem))

    def _inertial(self, shifts_ns: dict[str, int]) -> Iterator[Sensor]:
        """The IMUs, on the clocks of their lidars."""
        of_livox = self._taken(lambda one: one.length in livox.IMU_LENGTHS and livox.are_imu(one.packets(_SAMPLE)))
        found = [
            ouster.imu_streams(metadata, stream.packets(), shifts_ns.get(stream.host, 0))
            for stream, metadata in self.imus
        ]
        found += [livox.imu_streams(one.packets(), shifts_ns.get(one.host, 0)) for one in of_livox]
        for number, streams in enumerate(found, 1):
            yield ImuSensor("imu" if len(found) == 1 else f"imu_{number}", MappingProxyType(streams))

    # satellite receivers

    def _receivers(self) -> Iterator[Sensor]:
        """A receiver for each stream of NMEA sentences with fixes."""
        positions = self._taken(lambda one: one.length == velodyne.POSITION_LENGTH)
        carried = [(one, velodyne.position_sentences(one.packets())) for one in positions]
        carried += [(one, ouster.imu_sentences(metadata, one.packets())) for one, metadata in self.imus]
        carried = [(stream, sentences) for stream, sentences in carried if any(sentences)]
        for number, (stream, sentences) in enumerate(carried, 1):
            sensor = _receiver("gnss" if len(carried) == 1 else f"gnss_{number}", sentences, stream.arrivals_ns)
            if sensor is None:
                where, message = f"{self.path}: {stream.datagrams.sender}", "no NMEA sentence with a valid fix"
                self.ledger.note(WarningKind.SKIPPED, "positions-without-fix", where, message, count=len(sentences))
            else:
                if np.isnan(sensor.positions_lla).any():
                    where, message = (
                        f"{self.path}: {stream.datagrams.sender}",
                        "RMC sentences have no altitude; it is 0",
                    )
                    self.ledger.note(WarningKind.ASSUMED, "altitude-unknown", where, message)
                    sensor = replace(sensor, positions_lla=np.nan_to_num(sensor.positions_lla))
                yield sensor

    def _note_left(self) -> None:
        """Note the datagrams that nobody knows."""
        if not self.left:
            return
        named = [f"{one.length} bytes to port {one.datagrams.port}" for one in self.left[:_NAMES_LISTED]]
        more = f" and {len(self.left) - len(named)} more kinds" if len(self.left) > len(named) else ""
        message = f"datagrams of no lidar that is known: {', '.join(named)}{more}"
        count = sum(len(one.rows) for one in self.left)
        self.ledger.note(WarningKind.SKIPPED, "datagrams-unknown", str(self.path), message, count=count)


def _receiver(sensor_id: str, sentences: Sequence[str], arrivals_ns: Int64Array) -> GnssSensor | None:
    """The fixes of NMEA sentences (RMC, GGA), each once; None where there is none.

    Altitudes are NaN of RMC sentences, which have none.
    """
    fixes: dict[int, tuple[float, float, float]] = {}
    previous = ""
    for sentence, arrival_ns in zip(sentences, arrivals_ns.tolist(), strict=True):
        fix = _fix(sentence, arrival_ns) if sentence != previous else None
        previous = sentence
        if fix is not None and not (fix[0] in fixes and np.isnan(fix[1][2])):
            fixes[fix[0]] = fix[1]
    if not fixes:
        return None
    times_ns, unknown = sorted(fixes), np.full(len(fixes), np.nan)
    positions_lla = np.array([fixes[time_ns] for time_ns in times_ns])
    return GnssSensor(sensor_id, np.array(times_ns, np.int64), positions_lla, unknown, unknown)


def _fix(sentence: str, arrival_ns: int) -> tuple[int, tuple[float, float, float]] | None:
    """Time [ns] and position of an RMC or GGA sentence; None where it has no fix or its checksum does not hold.

    Source: NMEA 0183: RMC and GGA, checksum.
    """
    body, _, stated = sentence.removeprefix("$").partition("*")
    address, *fields = body.split(",")
    try:
        if stated[:2].upper() != checksum_of(body):
            return None
        if address.endswith("RMC") and fields[1] == "A":
            position, altitude, day = position_of(fields[2:6]), float("nan"), day_of(fields[8])
        elif address.endswith("GGA") and fields[5] not in ("", "0"):
            # it has no date: the one that is nearest to when it came
            position, altitude, day = position_of(fields[1:5]), float(fields[8]) + float(fields[10] or 0.0), None
        else:
            return None
        time_ns = time_of_day(fields[0])
    except (ValueError, IndexError, OverflowError):
        return None
    if position is None or time_ns is None:
        return None
    time_ns += _DAY_NS * (round((arrival_ns - time_ns) / _DAY_NS) if day is None else day)
    return (time_ns if abs(time_ns - arrival_ns) < _FAR_NS else arrival_ns), (*position, altitude)
