"""Slow writers of what messages are compressed with, by the descriptions of others: Cloudini, Draco, RVL, depths."""

import struct
import zlib

import lz4.block
import numpy as np
import zstandard

TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8, "i8": 9, "u8": 10}
NAMES = ("", "INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "FLOAT32", "FLOAT64", "INT64", "UINT64")
DRACO = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "i8": 7, "u8": 8, "f4": 9, "f8": 10}


def varint(number):
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*found, number])


def step(number):
    """A signed number as Cloudini writes it: zigzag, and one more, since 0 is NaN."""
    return varint((2 * number if number >= 0 else -2 * number - 1) + 1)


def gorilla(values):
    """Floats of 64 bits by their bits that change, each in whole bytes, lowest bit first (Cloudini 4)."""
    before, found, window = None, [], None
    for value in np.asarray(values, "<f8").view("<u8").tolist():
        if before is None:
            found.append(struct.pack("<Q", value))
            before = value
            continue
        changed, bits = value ^ before, ""  # bits in the order of writing
        if changed == 0:
            bits = "0"
        else:
            leading, trailing = min(31, 64 - changed.bit_length()), (changed & -changed).bit_length() - 1
            if window and leading >= window[0] and trailing >= window[1]:
                bits = "10" + f"{changed >> window[1]:0{64 - sum(window)}b}"[::-1]
            else:
                window, length = (leading, trailing), 64 - leading - trailing
                bits = (
                    "11"
                    + f"{leading:05b}"[::-1]
                    + f"{length - 1:06b}"[::-1]
                    + f"{changed >> trailing:0{length}b}"[::-1]
                )
        bits += "0" * (-len(bits) % 8)
        found.append(bytes(int(bits[k : k + 8][::-1], 2) for k in range(0, len(bits), 8)))
        before = value
    return found


def steps_of(values):
    """Whole numbers by steps, None for NaN, after which steps begin from 0."""
    before, found = 0, []
    for value in values:
        found.append(b"\0" if value is None else step(value - before))
        before = value or 0
    return found


def section(values, size, mode):
    """A section of whole numbers of Cloudini 5."""
    raw = [int(v).to_bytes(size, "little", signed=int(v) < 0) for v in values]
    if mode == 0:
        return b"\0" + b"".join(steps_of(values))
    if mode == 1:
        palette = list(dict.fromkeys(raw))
        width = (len(palette) - 1).bit_length()
        bits = "".join(f"{palette.index(one):0{width}b}"[::-1] if width else "" for one in raw)
        bits += "0" * (-len(bits) % 8)
        packed = bytes(int(bits[k : k + 8][::-1], 2) for k in range(0, len(bits), 8))
        return b"\1" + struct.pack("<H", len(palette)) + b"".join(palette) + packed
    runs, before = [], 0
    for value, one in zip(values, raw, strict=True):
        key = one if mode == 2 else step(value - before)
        before = value
        if runs and runs[-1][0] == key:
            runs[-1][1] += 1
        else:
            runs.append([key, 1])
    return bytes([mode]) + struct.pack("<I", len(runs)) + b"".join(key + varint(count) for key, count in runs)


def cloudini(table, *, version=3, stage="LOSSY", compression="ZSTD", resolution=0.001, height=1, text=True, modes=0):
    """Compress a table (N,) of named columns as Cloudini does."""
    count, dtype = len(table), table.dtype
    resolution = None if resolution is None else float(np.float32(resolution))
    fields = [(name, dtype.fields[name][1], dtype[name].str[1:]) for name in dtype.names]
    lossy = {name for name, _, kind in fields if kind[0] == "f" and stage == "LOSSY" and resolution}
    head = b"CLOUDINI_V" + f"{version:02d}".encode()
    if text:
        values = version, count // height, height, dtype.itemsize, stage, compression
        names = "version", "width", "height", "point_step", "encoding_opt", "compression_opt"
        lines = [*(f"{name}: {value}" for name, value in zip(names, values, strict=True)), "fields:"]
        for name, offset, kind in fields:
            stated = repr(resolution) if name in lossy else "null"
            lines += [f"  - name: {name}", f"    offset: {offset}", f"    type: {NAMES[TYPES[kind]]}",
                      f"    resolution: {stated}"]  # fmt: skip
        head += b"\n" + "\n".join(lines).encode() + b"\n\0"
    else:
        stages = ("NONE", "LOSSY", "LOSSLESS").index(stage), ("NONE", "LZ4", "ZSTD").index(compression)
        head += struct.pack("<IIIBBH", count // height, height, dtype.itemsize, *stages, len(fields))
        for name, offset, kind in fields:
            head += struct.pack("<H", len(name)) + name.encode()
            head += struct.pack("<IBf", offset, TYPES[kind], resolution if name in lossy else -1.0)
    chunks = []
    size = 32 * 1024 if version >= 3 else max(1, count)
    for start in range(0, count, size):
        rows, streams, sections = table[start : start + size], [], []
        leading = next(
            (k for k, (name, _, kind) in enumerate(fields) if kind != "f4" or name not in lossy), len(fields)
        )
        leading = leading if leading in {3, 4} else 0
        whole = [kind[0] in "iu" and kind[1] != "1" for _, _, kind in fields]
        apart = version >= 5 and stage == "LOSSY" and any(whole[leading:])
        for k, (name, _, kind) in enumerate(fields):
            values = rows[name]
            if apart and whole[k] and k >= leading:
                sections.append(section([int(v) for v in values], int(kind[1:]), modes))
            elif stage == "NONE" or kind[1:] == "1":
                streams.append([v.tobytes() for v in values])
            elif whole[k]:
                streams.append(steps_of([int(v) for v in values]))
            elif name in lossy:
                streams.append(steps_of([None if np.isnan(v) else round(float(v) / resolution) for v in values]))
            elif kind == "f8" and version >= 4:
                streams.append(gorilla(values))
            elif kind == "f8" or stage == "LOSSLESS":
                bits = values.view(f"<u{kind[1:]}")
                mixed = np.concatenate([bits[:1], bits[1:] ^ bits[:-1]])
                streams.append([v.tobytes() for v in mixed])
            else:
                streams.append([v.tobytes() for v in values])
        plain = b"".join(b"".join(point) for point in zip(*streams, strict=True)) + b"".join(sections)
        packed = {"NONE": lambda b: b, "ZSTD": zstandard.ZstdCompressor(level=1).compress,
                  "LZ4": lambda b: lz4.block.compress(b, store_size=False)}[compression](plain)  # fmt: skip
        chunks.append((struct.pack("<I", len(packed)) if version >= 3 else b"") + packed)
    return head + b"".join(chunks)


def draco(attributes, count, names=()):
    """Points as Draco's sequences of numbers as they are: `attributes` of a type each, and (N, K) numbers.

    Source: Draco bitstream specification, 3.3, 4 and 5.
    """
    metadata = b""
    if names:
        parts = [varint(number) + b"\1\4name" + varint(len(name)) + name.encode() + b"\0" for number, name in names]
        metadata = varint(len(parts)) + b"".join(parts) + b"\0\0"
    head = b"DRACO" + bytes([2, 3, 0, 0]) + struct.pack("<H", 0x8000 if metadata else 0) + metadata
    head += struct.pack("<i", count) + bytes([1, len(attributes)])
    for k, (kind, values) in enumerate(attributes):
        head += bytes([kind, DRACO[values.dtype.str[1:]], values.shape[1], 0, k])
    return head + bytes(len(attributes)) + b"".join(values.tobytes() for _, values in attributes)


def gzipped(content):
    """What zlib_point_cloud_transport writes: deflated, in the frame of gzip."""
    packer = zlib.compressobj(6, zlib.DEFLATED, 31)
    return packer.compress(content) + packer.flush()


def rvl(pixels):
    """(H, W) uint16 by Wilson's runs: nibbles of three bits, eight of them a word, the first one highest."""
    nibbles = []

    def number(value):
        while True:
            nibbles.append(value & 7 | (8 if value >> 3 else 0))
            value >>= 3
            if not value:
                return

    flat, place, before = pixels.reshape(-1).tolist(), 0, 0
    while place < len(flat):
        zeros = next((k for k, v in enumerate(flat[place:]) if v), len(flat) - place)
        number(zeros)
        place += zeros
        others = next((k for k, v in enumerate(flat[place:]) if not v), len(flat) - place)
        number(others)
        for value in flat[place : place + others]:
            delta = value - before
            number(2 * delta if delta >= 0 else -2 * delta - 1)
            before = value
        place += others
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        sum(nibble << 4 * (7 - j) for j, nibble in enumerate(nibbles[k : k + 8])) for k in range(0, len(nibbles), 8)
    ]
    return struct.pack("<II", pixels.shape[1], pixels.shape[0]) + struct.pack(f"<{len(words)}I", *words)


def inverse(depths, *, quantization=100.0, farthest=10.0):
    """(H, W) [m] as compressed_depth_image_transport writes them: the head, and uint16, 0 for none."""
    a = np.float32(quantization * (quantization + 1))
    b = np.float32(1 - a / np.float32(farthest))
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.where(depths < farthest, a / depths.astype(np.float32) + b, 0)
    return struct.pack("<iff", 0, a, b), np.nan_to_num(steps).astype(np.uint16)
