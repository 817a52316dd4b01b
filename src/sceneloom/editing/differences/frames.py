"""Frames and pictures of two sensors, one pair at a time."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.differences.report import Change
from sceneloom.editing.differences.values import Comparison
from sceneloom.scene.cameras import CameraSensor, Picture, VideoContent
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames

_PIECE = 1 << 20


def pairs(
    first_ns: Int64Array, second_ns: Int64Array, tolerance_ns: float
) -> Iterator[tuple[int | None, int | None]]:
    """Pair frames by their stamps (N,) and (M,) [ns], each with the first one near enough; None beside a lone one."""
    k = n = 0
    while k < len(first_ns) or n < len(second_ns):
        if k == len(first_ns):
            yield None, n
            n += 1
        elif n == len(second_ns):
            yield k, None
            k += 1
        else:
            away = int(second_ns[n]) - int(first_ns[k])
            if abs(away) <= tolerance_ns:
                yield k, n
                k, n = k + 1, n + 1
            elif away > 0:
                yield k, None
                k += 1
            else:
                yield None, n
                n += 1


def compare_frames(
    comparison: Comparison,
    path: str,
    first: LazyFrames[Any],
    second: LazyFrames[Any],
    compare: Callable[[Comparison, str, Any, Any], None],
    on_frame: Callable[[], None],
) -> None:
    """Compare frames of the same time, read one pair after the other.

    Args:
        comparison: compares and tells.
        path: of the frames.
        first, second: the frames.
        compare: compares two of them.
        on_frame: told after each.
    """
    tolerance_ns = comparison.tolerances.nanoseconds
    for k, n in pairs(first.timestamps_ns, second.timestamps_ns, tolerance_ns):
        if k is None:
            stamp = int(second.timestamps_ns[n or 0])
            replace(comparison, frame=n).add(f"{path}[]", Change.ADDED, f"at {stamp} ns")
        elif n is None:
            stamp = int(first.timestamps_ns[k])
            replace(comparison, frame=k).add(f"{path}[]", Change.REMOVED, f"at {stamp} ns")
        else:
            compare(replace(comparison, frame=k), f"{path}[]", first[k], second[n])
        on_frame()


def compare_pictures(
    comparison: Comparison,
    path: str,
    first: CameraSensor,
    second: CameraSensor,
    on_frame: Callable[[], None],
    *,
    pixels: bool,
) -> None:
    """Compare pictures of the same time: their lenses, and their files byte by byte.

    Pictures without a file of their own are those of a video, which is compared as one, or have to be decoded.

    Args:
        pixels: decode pictures whose bytes differ or are not there, and tell how far their pixels differ.
    """
    videos = _videos(comparison, path, first, second, told=not pixels)

    def compare(inner: Comparison, place: str, a: Picture, b: Picture) -> None:
        inner.records(place, a, b, skipped=("decode", "encoded"))
        equal = videos if a.encoded is None and b.encoded is None else _same_bytes(a, b)
        if equal:
            return
        if pixels:
            _compare_pixels(inner, place, a, b)
        elif equal is None:
            inner.findings.pass_over(
                f"{path}[]: pictures without files of their own; decode them to compare them"
            )
        elif videos is None:
            inner.add(f"{place}.content", Change.CHANGED, "other bytes")

    compare_frames(comparison, path, first.pictures, second.pictures, compare, on_frame)


def compare_depth_images(
    comparison: Comparison,
    path: str,
    first: DepthCameraSensor,
    second: DepthCameraSensor,
    on_frame: Callable[[], None],
    *,
    pixels: bool,
) -> None:
    """Compare depth images of the same time: their lenses, and their videos, else their depths where asked for.

    Args:
        pixels: decode images that no equal videos hold, and tell how far their depths differ.
    """
    videos = _videos(comparison, path, first, second, told=not pixels)

    def compare(inner: Comparison, place: str, a: DepthFrame, b: DepthFrame) -> None:
        inner.records(place, a, b, skipped=("decode",))
        if videos and a.scale == b.scale:
            return
        if pixels:
            _compare_depths(inner, place, a, b)
        else:
            inner.findings.pass_over(f"{path}[]: depth images; decode them to compare them")

    compare_frames(comparison, path, first.frames, second.frames, compare, on_frame)


def _compare_depths(comparison: Comparison, path: str, a: DepthFrame, b: DepthFrame) -> None:
    first, second = a.depth, b.depth
    if first.shape != second.shape:
        message = f"{first.shape[1]}x{first.shape[0]} pixels; then {second.shape[1]}x{second.shape[0]}"
        comparison.add(f"{path}.depth", Change.CHANGED, message)
        return
    away = np.abs(first.astype(np.float64) - second)
    if away.any():
        message = f"the mean difference of a depth, {float(away.max()):g} m at most"
        comparison.add(f"{path}.depth", Change.CHANGED, message, float(away.mean()), "m")


def _same_bytes(a: Picture, b: Picture) -> bool | None:
    """Whether the files of two pictures are equal; None where one has none."""
    if a.encoded is None or b.encoded is None:
        return None
    return a.encoded() == b.encoded()


def _videos(
    comparison: Comparison,
    path: str,
    first: CameraSensor | DepthCameraSensor,
    second: CameraSensor | DepthCameraSensor,
    *,
    told: bool,
) -> bool | None:
    """Whether the videos behind two cameras are equal, `told` where they are not; None where there are not two."""
    a, b = first.video, second.video
    if a is None or b is None:
        return None
    if a.frame_indices != b.frame_indices:
        return None
    equal = _same_files(a, b)
    if told and not equal:
        comparison.add(f"{path}.video", Change.CHANGED, f"{a.codec}; then {b.codec} of other bytes")
    return equal


def _same_files(a: VideoContent, b: VideoContent) -> bool:
    with a.open() as first, b.open() as second:
        return all(piece == other for piece, other in _pieces(first, second))


def _pieces(first: BinaryIO | BytesIO, second: BinaryIO | BytesIO) -> Iterator[tuple[bytes, bytes]]:
    while True:
        piece, other = first.read(_PIECE), second.read(_PIECE)
        yield piece, other
        if not piece or not other:
            return


def _compare_pixels(comparison: Comparison, path: str, a: Picture, b: Picture) -> None:
    first, second = a.rgb, b.rgb
    if first.shape != second.shape:
        message = f"{first.shape[1]}x{first.shape[0]} pixels; then {second.shape[1]}x{second.shape[0]}"
        comparison.add(f"{path}.rgb", Change.CHANGED, message)
        return
    away = np.abs(first.astype(np.int16) - second.astype(np.int16))
    if away.any():
        message = f"the mean difference of a channel, {int(away.max())} at most"
        comparison.add(f"{path}.rgb", Change.CHANGED, message, float(away.mean()), "of 255")
