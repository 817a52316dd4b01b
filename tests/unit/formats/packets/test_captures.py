"""Captures: the datagrams of pcap and pcapng, tagged, of IPv6, in fragments, cut and mixed."""

import numpy as np
import pytest
from tests.unit.formats.packets.build import START_NS, frames_of, pcap, pcapng

from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.packets.captures import read_datagrams

PAYLOADS = [bytes([k]) * (3000 + (k == 3)) for k in range(5)]


def read(path, content, codes=()):
    path.write_bytes(content)
    ledger = Ledger(lenient=False)
    found = read_datagrams(path, ledger)
    assert [warning.code for warning in ledger.warnings] == list(codes)
    return found


def records(**how):
    return [
        (START_NS + 1000 * number, frame)
        for number, payload in enumerate(PAYLOADS)
        for frame in frames_of(payload, number=number, **how)
    ]


@pytest.mark.parametrize("how", [{}, {"vlan": (7,)}, {"vlan": (7, 8)}, {"ipv6": True}, {"mtu": 1480},
                                 {"mtu": 1480, "ipv6": True}, {"mtu": 8, "vlan": (1,)}])  # fmt: skip
@pytest.mark.parametrize(
    "form",
    [
        pcap,
        lambda r: pcap(r, order=">", nanoseconds=False),
        pcapng,
        lambda r: pcapng(r, order=">"),
        lambda r: pcapng(r, resolution=6),
        lambda r: pcapng(r, resolution=0x80 | 30),
    ],
)
def test_payloads_senders_and_times_of_datagrams_are_those_that_were_sent(tmp_path, how, form):
    (found,) = read(tmp_path / "a.pcap", form(records(**how)))
    assert found.sender == ("[fd00::1]:2368" if how.get("ipv6") else "192.168.1.201:2368")
    assert found.port == 2368
    # of ticks that are no nanoseconds
    assert np.abs(found.arrivals_ns - START_NS - 1000 * np.arange(5)).max() <= 1
    assert found.lengths.tolist() == list(map(len, PAYLOADS))
    rows = np.array([4, 0, 2])
    assert [one.tobytes() for one in found.payloads(rows)] == [PAYLOADS[k] for k in rows]


def test_other_links_are_read_and_what_is_no_udp_is_passed_over(tmp_path):
    (frame,) = frames_of(b"abc")
    links = {101: frame[14:], 12: frame[14:], 113: bytes(14) + frame[12:], 276: frame[12:14] + bytes(18) + frame[14:],
             0: b"\2\0\0\0" + frame[14:]}  # fmt: skip
    for link, content in links.items():
        (found,) = read(tmp_path / "a.pcap", pcap([(START_NS, content)], link=link))
        assert found.payloads(np.array([0])).tobytes() == b"abc"
    tcp, arp = bytearray(frame), bytearray(frame)
    tcp[23], arp[12:14] = 6, b"\x08\x06"
    assert read(tmp_path / "a.pcap", pcap([(START_NS, bytes(one)) for one in (tcp, arp, b"", frame[:20])])) == []
    assert read(tmp_path / "a.pcap", pcap([(START_NS, frame)], link=147)) == []


def test_fragments_in_any_order_of_two_datagrams_at_once_and_twice_are_put_together(tmp_path):
    whole = records(mtu=800)
    mixed = [whole[k] for k in np.random.default_rng(3).permutation(len(whole))]
    (found,) = read(tmp_path / "a.pcap", pcap(mixed + whole[:1]), ["fragments-missing"])  # the last one begins another
    payloads = [found.payloads(np.array([k])).tobytes() for k in range(5)]
    assert sorted(payloads) == sorted(PAYLOADS)
    assert len(read(tmp_path / "a.pcap", pcap(whole[1:]), ["fragments-missing"])[0].lengths) == 4


def test_what_is_cut_or_damaged_is_counted_and_the_rest_read(tmp_path):
    whole = pcap(records())
    assert len(read(tmp_path / "a.pcap", whole[:-10], ["capture-cut"])[0].lengths) == 4
    assert len(read(tmp_path / "a.pcap", whole + b"\0", ["capture-cut"])[0].lengths) == 5
    assert len(read(tmp_path / "a.pcap", whole + b"\xff" * 40, ["capture-damaged"])[0].lengths) == 5
    one = records()
    short = [(one[0][0], one[0][1][:100]), *one[1:]]
    assert len(read(tmp_path / "a.pcap", pcap(short), ["packets-cut"])[0].lengths) == 4
    whole = pcapng(one)
    assert len(read(tmp_path / "a.pcap", whole[:-10], ["capture-cut"])[0].lengths) == 4
    assert len(read(tmp_path / "a.pcap", whole + b"\xff" * 40, ["capture-damaged"])[0].lengths) == 5


def test_what_is_no_capture_or_was_changed_since_is_refused(tmp_path):
    with pytest.raises(DataError, match="expected the first bytes of a pcap"):
        read(tmp_path / "a.pcap", b"hello world")
    (found,) = read(tmp_path / "a.pcap", pcap(records()))
    (tmp_path / "a.pcap").write_bytes(b"")
    with pytest.raises(DataError, match="was changed after it was opened"):
        found.payloads(np.array([0]))
