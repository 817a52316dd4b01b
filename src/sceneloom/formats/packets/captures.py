"""Captures of networks, `.pcap` and `.pcapng`: where the payloads of their UDP datagrams lie.

Source: draft-ietf-opsawg-pcap and draft-ietf-opsawg-pcapng (records), IEEE 802.1Q (tags), RFC 791 and RFC 8200 (IP and
its fragments), RFC 768 (UDP).
"""

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, UInt8Array
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import FileIdentity, file_faults, open_file
from sceneloom.warnings import WarningKind

PCAPNG = b"\x0a\x0d\x0d\x0a"
MAGICS = (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d", PCAPNG)
"""What captures begin with: pcap of both byte orders, in microseconds and nanoseconds; pcapng."""

LARGEST_RECORD = 1 << 20
"""Longer records [bytes] are those of damaged files: a datagram has 65,535 bytes at most."""

_ETHERNET, _RAW, _LOOPBACK, _COOKED, _COOKED2 = 1, (12, 14, 101, 228, 229), (0, 108), 113, 276
_IPV4, _IPV6 = b"\x08\x00", b"\x86\xdd"
_TAGS = (b"\x81\x00", b"\x88\xa8", b"\x91\x00")
_UDP, _FRAGMENT = 17, 44
_IPV4_HEADER, _UDP_HEADER = struct.Struct(">BBHHHBBH").unpack_from, struct.Struct(">4H").unpack
_REASSEMBLY_NS = 2_000_000_000
"""Fragments that are farther apart belong to two datagrams, whose numbers have come round."""

_LATEST_NS = 1 << 62
_SPAN = 1 << 26  # bytes of a file that are read at once


@dataclass(frozen=True, slots=True, eq=False)
class Datagrams:
    """The UDP datagrams from one sender to one port, in the order of the capture.

    Attributes:
        file: the capture.
        sender: address and port, as text.
        port: to which they were sent.
        arrivals_ns: (N,) int64 [ns], by the capturing clock.
        lengths: (N,) int64, of the payloads [bytes].
        first: (N + 1,) int64, number of each payload's first piece: one, or one for each fragment.
        pieces: (P, 2) int64, offset and length of the pieces in the file [bytes].
    """

    file: FileIdentity
    sender: str
    port: int
    arrivals_ns: Int64Array
    lengths: Int64Array
    first: Int64Array
    pieces: Int64Array

    def payloads(self, rows: Int64Array) -> UInt8Array:
        """Read the payloads of datagrams, (K,) int64, that have the same length L, as (K, L) uint8.

        Raises:
            DataError: the file cannot be read, or was changed.
        """
        found: list[bytes | memoryview] = []
        starts, stops = self.first[rows], self.first[rows + 1]
        with file_faults(self.file.path), open_file(self.file.path) as file:
            self.file.check()
            low, high, content = 0, 0, memoryview(b"")
            for number, (start, stop) in enumerate(zip(starts.tolist(), stops.tolist(), strict=True)):
                for offset, length in self.pieces[start:stop].tolist():
                    if offset < low or offset + length > high:
                        low, high = offset, self._end(rows[number:], offset, length)
                        file.seek(low)
                        content = memoryview(file.read(high - low))
                    found.append(content[offset - low : offset - low + length])
        joined = np.frombuffer(b"".join(found), np.uint8)
        if not len(rows) or len(joined) != len(rows) * int(self.lengths[rows[0]]):
            raise DataError(self.file.name, "", "ends before the datagrams that it had when it was opened")
        return joined.reshape(len(rows), -1)

    def _end(self, rows: Int64Array, offset: int, length: int) -> int:
        """Where to stop reading, so that many of the next payloads are read at once."""
        last = self.pieces[self.first[rows + 1] - 1].sum(axis=1)
        near = last[(last > offset) & (last <= offset + _SPAN)]
        return max(int(near.max(initial=0)), offset + length)


_Record = tuple[int, int, int, int, bytes]
"""A captured packet: type of link, time [ns], length on the wire, offset of its bytes in the file, and these."""


class _Pending:
    """A datagram of which fragments are missing: those that came, by where they belong in it."""

    __slots__ = ("found", "head", "parts", "time_ns", "total")

    def __init__(self, time_ns: int) -> None:
        self.time_ns, self.found, self.total, self.head = time_ns, 0, -1, b""
        self.parts: dict[int, tuple[int, int]] = {}


@dataclass(slots=True)
class _Flow:
    """Datagrams that are collected."""

    arrivals: "array[int]" = field(default_factory=lambda: array("q"))
    lengths: "array[int]" = field(default_factory=lambda: array("q"))
    first: "array[int]" = field(default_factory=lambda: array("q", [0]))
    pieces: "array[int]" = field(default_factory=lambda: array("q"))

    def add(self, time_ns: int, length: int, pieces: list[int]) -> None:
        self.arrivals.append(time_ns)
        self.lengths.append(length)
        self.pieces.extend(pieces)
        self.first.append(len(self.pieces) // 2)


_Address = tuple[bytes, int, int]  # of the sender, its port, and the port that it sent to


class _Network:
    """Takes captured packets apart, puts fragments together, and counts what is left out."""

    def __init__(self, path: Path, ledger: Ledger) -> None:
        self.path, self.ledger = path, ledger
        self.flows: dict[_Address, _Flow] = {}
        self._pending: dict[tuple[bytes, int], _Pending] = {}

    def note(self, code: str, message: str, count: int = 1) -> None:
        self.ledger.note(WarningKind.SKIPPED, code, str(self.path), message, count=count)

    def take(self, link: int, time_ns: int, length: int, offset: int, content: bytes) -> None:
        kind, at = (content[12:14], 14) if link == _ETHERNET else (b"", 0)
        if kind != _IPV4:
            kind, at = _network_header(link, content)
        if kind == _IPV4 and len(content) >= at + 20:
            first, _, total, name, fragment, _, protocol, _ = _IPV4_HEADER(content, at)
            header, total = (first & 15) * 4, total or length - at
            more, start, addresses = fragment & 0x2000, (fragment & 0x1FFF) * 8, content[at + 12 : at + 20]
            sender = addresses[:4]
        elif kind == _IPV6 and len(content) >= at + 48:
            header, total = 40, 40 + int.from_bytes(content[at + 4 : at + 6], "big")
            protocol, more, start, name, addresses = content[at + 6], 0, 0, 0, content[at + 8 : at + 40]
            sender = addresses[:16]
            if protocol == _FRAGMENT:
                protocol, _, start, name = struct.unpack_from(">BBHI", content, at + 40)
                more, start, header = start & 1, start & 0xFFF8, 48
        else:
            return
        if protocol != _UDP:
            return
        body, stop = at + header, at + total
        if len(content) < stop or total < header:
            self.note("packets-cut", "a packet was captured in part; it is left out")
        elif more or start:
            pending = self._part((addresses, name), time_ns, start, offset + body, stop - body)
            if not start:
                pending.head = content[body : body + 8]
            if not more:
                pending.total = start + stop - body
            if pending.found == pending.total:
                self._join(sender, self._pending.pop((addresses, name)))
        elif total >= header + 8:
            self._add(time_ns, sender, content[body : body + 8], [offset + body, stop - body])

    def _part(self, name: tuple[bytes, int], time_ns: int, start: int, offset: int, length: int) -> _Pending:
        """Note a fragment, and give what has come of its datagram."""
        pending = self._pending.get(name)
        if pending is not None and time_ns - pending.time_ns > _REASSEMBLY_NS:
            self.note("fragments-missing", "fragments of a datagram are missing; it is left out")
            pending = None
        if pending is None:
            pending = self._pending[name] = _Pending(time_ns)
        if start not in pending.parts:
            pending.parts[start] = (offset, length)
            pending.found += length
        return pending

    def _join(self, sender: bytes, pending: _Pending) -> None:
        pieces: list[int] = []
        reached = 0
        for start, (offset, length) in sorted(pending.parts.items()):
            if start != reached:
                break
            pieces += (offset, length)
            reached += length
        if reached != pending.total or len(pending.head) < 8:
            self.note("fragments-missing", "fragments of a datagram do not fit together; it is left out")
        else:
            self._add(pending.time_ns, sender, pending.head, pieces)

    def _add(self, time_ns: int, sender: bytes, head: bytes, pieces: list[int]) -> None:
        """Add a datagram whose header begins the head, and whose pieces follow one another."""
        source, port, length, _ = _UDP_HEADER(head)
        available = sum(pieces[1::2])
        length = length or available  # of jumbograms it is 0
        if length == 8:
            return
        if not 8 < length <= available < length + pieces[-1] or not 0 <= time_ns < _LATEST_NS:
            self.note("packets-cut", "a datagram is shorter than it states, or its time is none; it is left out")
            return
        pieces[-1] -= available - length
        pieces[0], pieces[1] = pieces[0] + 8, pieces[1] - 8
        length -= 8
        self.flows.setdefault((sender, source, port), _Flow()).add(time_ns, length, pieces)

    def finish(self, file: FileIdentity) -> list[Datagrams]:
        if self._pending:
            message = "fragments of a datagram are missing; it is left out"
            self.note("fragments-missing", message, len(self._pending))
        return [
            Datagrams(
                file=file,
                sender=_named(sender, source),
                port=port,
                arrivals_ns=_integers(flow.arrivals),
                lengths=_integers(flow.lengths),
                first=_integers(flow.first),
                pieces=_integers(flow.pieces).reshape(-1, 2),
            )
            for (sender, source, port), flow in self.flows.items()
        ]


def _integers(values: "array[int]") -> Int64Array:
    found: AnyArray = np.frombuffer(values, np.int64) if values else np.zeros(0, np.int64)
    return found


def _named(address: bytes, port: int) -> str:
    host = str(ip_address(address))
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _network_header(link: int, content: bytes) -> tuple[bytes, int]:
    """Which protocol of the network layer a packet has, as type of Ethernet, and where its header begins.

    Source: the list of link types of tcpdump.org.
    """
    if link == _ETHERNET:
        kind, at = content[12:14], 14
        while kind in _TAGS:
            kind, at = content[at + 2 : at + 4], at + 4
        return kind, at
    if link == _COOKED:
        return content[14:16], 16
    if link == _COOKED2:
        return content[:2], 20
    at = 4 if link in _LOOPBACK else 0
    if link not in (*_RAW, *_LOOPBACK) or len(content) <= at:
        return b"", 0
    return {4: _IPV4, 6: _IPV6}.get(content[at] >> 4, b""), at


def read_datagrams(path: Path, ledger: Ledger) -> list[Datagrams]:
    """Find all UDP datagrams of a capture, by sender and port.

    What was captured in part, and datagrams of which fragments are missing, are left out and counted.

    Raises:
        DataError: the file cannot be read, or is no capture.
    """
    with file_faults(path), open_file(path, buffering=1 << 20) as file:
        network = _Network(path, ledger)
        for record in _records(file, path, network):
            network.take(*record)
        return network.finish(FileIdentity.of(path, descriptor=file.fileno()))


def _records(file: BinaryIO, path: Path, network: _Network) -> Iterator[_Record]:
    magic = file.read(4)
    if magic not in MAGICS:
        raise DataError(path, "byte 0", f"{magic.hex()}; expected the first bytes of a pcap or pcapng file")
    return _pcapng_records(file, network) if magic == PCAPNG else _pcap_records(file, magic, network)


def _pcap_records(file: BinaryIO, magic: bytes, network: _Network) -> Iterator[_Record]:
    order = "<" if magic in (MAGICS[0], MAGICS[2]) else ">"
    fraction_ns = 1 if magic in MAGICS[2:4] else 1000
    head = file.read(20)
    link = struct.unpack(f"{order}I", head[16:])[0] & 0xFFFF if len(head) == 20 else 0
    unpack, offset = struct.Struct(f"{order}4I").unpack, 24
    while len(head := file.read(16)) == 16:
        seconds, fraction, captured, length = unpack(head)
        if captured > LARGEST_RECORD:
            network.note("capture-damaged", f"byte {offset}: a record of {captured} bytes; the rest is left out")
            return
        content = file.read(captured)
        if len(content) < captured:
            break
        offset += 16
        yield link, seconds * 1_000_000_000 + fraction * fraction_ns, length, offset, content
        offset += captured
    if head:
        network.note("capture-cut", "the capture ends within a packet")


_SECTION, _INTERFACE, _ENHANCED, _PACKET, _SIMPLE = 0x0A0D0D0A, 1, 6, 2, 3
_RESOLUTION, _OFFSET = 9, 14  # options of an interface: of its timestamps


def _pcapng_records(file: BinaryIO, network: _Network) -> Iterator[_Record]:
    file.seek(0)
    interfaces: list[tuple[int, int, int]] = []
    order, offset = "<", 0
    while len(head := file.read(12)) == 12:
        if head[:4] == PCAPNG:
            order, interfaces = "<" if head[8:] == b"\x4d\x3c\x2b\x1a" else ">", []
        kind, length = struct.unpack_from(f"{order}2I", head)
        if length < 12 or length % 4 or (length > LARGEST_RECORD and kind in (_INTERFACE, _ENHANCED, _PACKET)):
            network.note("capture-damaged", f"byte {offset}: a block of {length} bytes; the rest is left out")
            return
        if kind not in (_INTERFACE, _ENHANCED, _PACKET):
            if kind == _SIMPLE:
                network.note("packets-without-time", "a simple packet block has no time; it is left out")
            file.seek(offset + length)
        else:
            body = head[8:] + file.read(length - 12)
            if len(body) < length - 8:
                break
            if kind == _INTERFACE:
                interfaces.append(_interface(order, body))
            elif len(body) >= 24:
                number, high, low, captured, original = struct.unpack_from(f"{order}5I", body)
                number = number if kind == _ENHANCED else struct.unpack_from(f"{order}H", body)[0]
                if number < len(interfaces) and captured <= len(body) - 24:
                    link, per_second, zero_ns = interfaces[number]
                    time_ns = zero_ns + (high << 32 | low) * 1_000_000_000 // per_second
                    yield link, time_ns, original, offset + 28, body[20 : 20 + captured]
                else:
                    network.note("capture-damaged", "a block of a packet does not fit its interface or length")
        offset += length
    if head:
        network.note("capture-cut", "the capture ends within a block")


def _interface(order: str, body: bytes) -> tuple[int, int, int]:
    """Type of link of an interface, how many units of its timestamps are a second, and their zero [ns]."""
    if len(body) < 12:
        return 0, 1, -_LATEST_NS
    link, per_second, zero_ns, at = struct.unpack_from(f"{order}H", body)[0], 1_000_000, 0, 8
    while at + 4 <= len(body) - 4:
        code, length = struct.unpack_from(f"{order}2H", body, at)
        value = body[at + 4 : at + 4 + length]
        if code == _RESOLUTION and length == 1:
            power = value[0] & 0x7F
            per_second = 2**power if value[0] & 0x80 else 10**power
        elif code == _OFFSET and length == 8:
            zero_ns = struct.unpack(f"{order}q", value)[0] * 1_000_000_000
        at += 4 + length + -length % 4
    return link, per_second, zero_ns
