"""Captures and packets of lidars, built from the public descriptions byte by byte."""

import json
import struct
from pathlib import Path

import numpy as np

START_NS = 1_700_000_000_000_000_000


def frames_of(payload, *, sender="192.168.1.201", port=2368, vlan=(), mtu=0, number=1, ipv6=False):
    """The Ethernet frames of one datagram: several where it is longer than `mtu`."""
    udp = struct.pack(">4H", port, port, len(payload) + 8, 0) + payload
    step = mtu or len(udp)
    frames = []
    for start in range(0, len(udp), step):
        part, more = udp[start : start + step], start + step < len(udp)
        if ipv6:
            fragment = b"" if not mtu else struct.pack(">BBHI", 17, 0, start | more, number)
            addresses = bytes.fromhex("fd00" + "00" * 13 + "01") + bytes.fromhex("fd00" + "00" * 13 + "02")
            ip = struct.pack(">IHBB", 6 << 28, len(fragment) + len(part), 44 if mtu else 17, 64) + addresses + fragment
        else:
            flags = (0x2000 if more else 0) | start // 8
            addresses = bytes(map(int, sender.split("."))) + bytes((255,) * 4)
            ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(part), number, flags, 64, 17, 0) + addresses
        tags = b"".join(b"\x81\x00" + struct.pack(">H", tag) for tag in vlan)
        frames.append(b"\xff" * 6 + b"\x02" * 6 + tags + (b"\x86\xdd" if ipv6 else b"\x08\x00") + ip + part)
    return frames


def pcap(records, *, order="<", nanoseconds=True, link=1):
    """A pcap file of (time [ns], frame)."""
    magic = 0xA1B23C4D if nanoseconds else 0xA1B2C3D4
    content = struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 65535, link)
    for time_ns, frame in records:
        fraction = time_ns % 10**9 // (1 if nanoseconds else 1000)
        content += struct.pack(f"{order}4I", time_ns // 10**9, fraction, len(frame), len(frame)) + frame
    return content


def pcapng(records, *, order="<", resolution=9):
    """A pcapng file of one interface, with a block that readers pass over."""

    def block(kind, body):
        body += bytes(-len(body) % 4)
        return struct.pack(f"{order}2I", kind, len(body) + 12) + body + struct.pack(f"{order}I", len(body) + 12)

    content = block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1))
    options = struct.pack(f"{order}2HB3x2H", 9, 1, resolution, 0, 0)
    content += block(1, struct.pack(f"{order}HHI", 1, 0, 65535) + options) + block(5, bytes(12))
    per_second = 2 ** (resolution & 0x7F) if resolution & 0x80 else 10**resolution
    for time_ns, frame in records:
        ticks = time_ns * per_second // 10**9
        head = struct.pack(f"{order}5I", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
        content += block(6, head + frame)
    return content


def capture(path: Path, packets, *, step_ns=1_000_000, start_ns=START_NS, **how):
    """Write a pcap file of payloads that come one after another."""
    records = []
    for number, packet in enumerate(packets):
        records += [(start_ns + number * step_ns, one) for one in frames_of(packet, number=number % 65536, **how)]
    path.write_bytes(pcap(records))
    return path


def velodyne(azimuths, distances, intensities, *, time_us, mode=0x37, product=0x22, flags=(0xEEFF,) * 12):
    """A packet of 12 blocks: azimuths (12,) [0.01°], distances and intensities (12, 32)."""
    content = b""
    for k in range(12):
        content += struct.pack("<HH", flags[k], azimuths[k])
        content += b"".join(
            struct.pack("<HB", d, i) for d, i in zip(distances[k].tolist(), intensities[k].tolist(), strict=True)
        )
    return content + struct.pack("<IBB", time_us, mode, product)


def hesai_40p(azimuths, distances, intensities, *, time_us, date=(23, 11, 14, 22, 13, 20), mode=0x37):
    """A packet of a Pandar40P: 10 blocks of 40."""
    content = b""
    for k in range(10):
        content += b"\xff\xee" + struct.pack("<H", azimuths[k])
        content += b"".join(struct.pack("<HB", d, i) for d, i in zip(distances[k], intensities[k], strict=True))
    tail = bytes(5) + b"\0" + bytes(2) + struct.pack("<H", 600) + struct.pack("<IBB", time_us, mode, 0x42)
    return content + tail + bytes(date)


def hesai_64(azimuths, distances, intensities, *, time_us, unit_mm=4, mode=0x37, date=(23, 11, 14, 22, 13, 20)):
    """A packet of a Pandar64: 6 blocks of 64 behind a header of 8 bytes."""
    content = bytes((0xEE, 0xFF, 64, 6, 0, unit_mm, 0, 0))
    for k in range(6):
        content += struct.pack("<H", azimuths[k])
        content += b"".join(struct.pack("<HB", d, i) for d, i in zip(distances[k], intensities[k], strict=True))
    tail = bytes(5) + b"\0" + bytes(2) + struct.pack("<H", 600) + struct.pack("<IBB", time_us, mode, 0x42)
    return content + tail + bytes(date)


def hesai_ot128(azimuths, distances, intensities, *, time_us, unit_mm=4, mode=0x37, fine=False):
    """A packet of an OT128: 2 blocks of 128, each value of 3 bytes, then checksum, functional safety and tail."""
    content = struct.pack("<2s10B", b"\xee\xff", 1, 4, 0, 0, 128, 2, 1, unit_mm, 1, 0)
    for k in range(2):
        content += struct.pack("<H", azimuths[k])
        content += b"".join(struct.pack("<HB", d, i) for d, i in zip(distances[k], intensities[k], strict=True))
    tail = bytes(4 + 17 + 9 + 2) + bytes((not fine, mode)) + bytes(2) + bytes((123, 11, 14, 22, 13, 20))
    return content + tail + struct.pack("<IB", time_us, 0x42) + bytes(30)


def hesai(azimuths, distances, intensities, *, time_us, unit_mm=4, mode=0x37, date=(123, 11, 14, 22, 13, 20)):
    """A packet of an XT16, XT32 (8 blocks), XT32M (6), QT64 (4 of 64) or, with fine azimuths, AT128 (2 of 128)."""
    blocks, channels = np.shape(distances)
    content = struct.pack("<2s10B", b"\xee\xff", 6, 1, 0, 0, channels, blocks, 1, unit_mm, 1, 0)
    for k in range(blocks):
        fine = struct.pack("<HB", azimuths[k] >> 8, azimuths[k] & 255)
        content += fine if channels == 128 else struct.pack("<H", azimuths[k])
        content += b"".join(struct.pack("<HBB", d, i, 0) for d, i in zip(distances[k], intensities[k], strict=True))
    micro = struct.pack("<I", time_us)
    if channels <= 32:
        return content + bytes(10) + bytes((mode,)) + bytes(2) + bytes(date) + micro + b"\x42" + bytes(4)
    if channels == 64:
        return content + bytes(12) + micro + bytes((mode, 0x42)) + bytes(date) + bytes(4)
    return content + bytes(4) + bytes(20) + micro + bytes((mode, 0x42)) + b"\0" + date[0].to_bytes(5, "big")


def at_correction(starts, azimuths, elevations, azimuth_steps, elevation_steps):
    """An angle correction file of an AT128, version 1.5."""
    sides = len(starts)
    head = b"\xee\xff\x01\x05" + bytes((128, sides, sides)) + bytes(8) + b"\x01"
    integers = [np.asarray(one, "<i4").tobytes() for one in (starts, starts, azimuths, elevations)]
    return head + b"".join(integers) + azimuth_steps.astype("i1").tobytes() + elevation_steps.astype("i1").tobytes()


def robosense(azimuths, distances, intensities, *, time_us, seconds=1_700_000_000, kind=None, calendar=None):
    """An MSOP packet: 12 blocks of 32; of the older form with a type; with a date, or the newer one's time."""
    head = b"\x55\xaa\x05\x5a" + bytes(16) if kind is None else b"\x55\xaa\x05\x0a\x5a\xa5\x50\xa0" + bytes(12)
    if calendar is None:
        head += seconds.to_bytes(6, "big") + struct.pack(">I", time_us)
    else:
        head += bytes(calendar) + struct.pack(">HH", *divmod(time_us, 1000))
    content = (head + bytes((6 if kind is None else kind,))).ljust(42, b"\0")
    for k in range(12):
        content += b"\xff\xee" + struct.pack(">H", azimuths[k])
        content += b"".join(struct.pack(">HB", d, i) for d, i in zip(distances[k], intensities[k], strict=True))
    return content + bytes(6)


def robosense_state(elevations_deg, azimuths_deg, *, mode=4):
    """A DIFOP packet with the angles of 16 or 32 lasers; those of an RS-LiDAR-16 lie elsewhere, without azimuths."""

    def angles(values):
        return b"".join(struct.pack(">BH", int(value < 0), round(abs(value) * 100)) for value in values).ljust(
            96, b"\0"
        )

    packet = bytearray(b"\xa5\xff\x00\x5a\x11\x11\x55\x55".ljust(1248, b"\0"))
    packet[300] = mode
    if azimuths_deg is None:
        packet[1165:1213] = b"".join(round(abs(one) * 10_000).to_bytes(3, "big") for one in elevations_deg)
    else:
        packet[468:660] = angles(elevations_deg) + angles(azimuths_deg)
    return bytes(packet)


def ouster_metadata(path: Path, *, profile="RNG15_RFL8_NIR8", rows=4, columns=64, per_packet=16, **more):
    """Metadata in the form of firmware 2.2 and later."""
    layout = {
        "udp_profile_lidar": profile, "udp_profile_imu": "LEGACY", "columns_per_frame": columns,
        "columns_per_packet": per_packet, "pixels_per_column": rows, "pixel_shift_by_row": [0] * rows,
        "column_window": [0, columns - 1], **more,
    }  # fmt: skip
    content = {
        "sensor_info": {"prod_line": "OS-1-4", "prod_sn": "7", "initialization_id": 5},
        "lidar_data_format": layout,
        "beam_intrinsics": {
            "beam_altitude_angles": [10.0, 2.0, -3.0, -12.0][:rows],
            "beam_azimuth_angles": [3.0, 1.0, -1.0, -3.0][:rows],
            "lidar_origin_to_beam_origin_mm": 15.8,
        },
        "lidar_intrinsics": {"lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 38.2, 0, 0, 0, 1]},
        "imu_intrinsics": {"imu_to_sensor_transform": [1, 0, 0, 6, 0, 1, 0, -11, 0, 0, 1, 7, 0, 0, 0, 1]},
        "config_params": {"udp_port_lidar": 7502, "udp_port_imu": 7503},
    }
    path.write_text(json.dumps(content))
    return path


def ouster(columns, words, *, frame=1, session=5, first_ns=10**12, step_ns=100_000, size=4, valid=True):
    """A packet of any profile but the legacy one: words (W, H, size) uint8 are the pixels as they are sent."""
    content = struct.pack("<HH", 1, frame) + session.to_bytes(3, "little") + bytes(25)
    for k, number in enumerate(columns):
        content += struct.pack("<QHH", first_ns + step_ns * int(number), number, valid) + words[k, :, :size].tobytes()
    return content + bytes(32)


LIVOX_FIRST = {0: ("iiiB", 100, 1), 1: ("IHHB", 100, 1), 2: ("iiiBB", 96, 1), 3: ("IHHBB", 96, 1),
               4: ("iiiBB", 48, 2), 5: ("IBB", 48, 2), 7: ("iiiBB", 30, 3), 8: ("IBB", 30, 3)}  # fmt: skip
LIVOX_SECOND = {1: ("iiiBB", 96, 1), 2: ("hhhBB", 96, 1), 3: ("IHHBB", 96, 1)}
"""Of each data type: what a return is, how many points a packet has, and how many returns a point."""


def livox_points(data_type, returns, *, second=False):
    """The points of a packet; returns (N, R, 5) are x, y, z [mm], or depth [mm], theta and phi [0.01°]; value, tag."""
    form = (LIVOX_SECOND if second else LIVOX_FIRST)[data_type][0]
    content = b""
    for point in np.asarray(returns).tolist():
        if form == "IBB":
            content += struct.pack("<HH", *point[0][1:3])
            content += b"".join(struct.pack("<IBB", one[0], *one[3:]) for one in point)
        else:
            content += b"".join(struct.pack(f"<{form}", *one[: len(form)]) for one in point)
    return content


def livox(data_type, content, *, time_ns, time_type=1, second=False, interval_ns=475_000, count=96):
    """A packet of the first or second SDK around points or values of an IMU."""
    if not second:
        return struct.pack("<4BI2BQ", 5, 1, 1, 0, 0, time_type, data_type, time_ns) + content
    head = struct.pack("<BHHHHBBB", 0, 36 + len(content), interval_ns // 100, count, 7, 3, data_type, time_type)
    return head + bytes(12) + struct.pack("<IQ", 0, time_ns) + content


def lvx(frames, *, version=1, device_type=7, pose=(0.0, 0.0, 90.0, 1.0, 2.0, 3.0), enabled=1):
    """A `.lvx` (version 1) or `.lvx2` file of frames, each of (data type, time [ns], data)."""
    content = b"livox_tech".ljust(16, b"\0") + bytes((version, 2 - version, 0, 0)) + struct.pack("<I", 0xAC0EA767)
    content += struct.pack("<IB", 50, 1) + b"3GGDJ6K00100881".ljust(16, b"\0") + bytes(16)
    content += bytes((0, device_type)) if version == 1 else struct.pack("<IBB", 7, 0, device_type)
    content += bytes((enabled,)) + struct.pack("<6f", *pose)
    for number, packages in enumerate(frames):
        body = b""
        for data_type, time_ns, data in packages:
            if version == 1:
                body += struct.pack("<5BI2BQ", 0, 5, 1, 1, 0, 0, 1, data_type, time_ns) + data
            else:
                body += struct.pack("<BIBBQHBIB4x", 0, 7, 0, 1, time_ns, 0, data_type, len(data), 0) + data
        content += struct.pack("<3Q", len(content), len(content) + 24 + len(body), number) + body
    return content
