"""Frames and images of two sensors, one pair at a time."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.differences.report import Change
from sceneloom.editing.differences.values import Comparison
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames

_PIECE = 1 << 20


def pairs(
    first_ns: Int64Array, second_ns: Int64Array, tolerance_ns: float
) -> Iterator[tuple[int | None, int | None]]:
    """Pair frames by their timestamps (N,) and (M,) [ns], each with the first one near enough.

    None beside a lone one.
    """
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
        comparison: compares and reports.
        path: of the frames.
        first, second: the frames.
        compare: compares two of them.
        on_frame: reported after each.
    """
    tolerance_ns = comparison.tolerances.nanoseconds
    for k, n in pairs(first.timestamps_ns, second.timestamps_ns, tolerance_ns):
        if k is None:
            timestamp = int(second.timestamps_ns[n or 0])
            replace(comparison, frame=n).add(f"{path}[]", Change.ADDED, f"at {timestamp} ns")
        elif n is None:
            timestamp = int(first.timestamps_ns[k])
            replace(comparison, frame=k).add(f"{path}[]", Change.REMOVED, f"at {timestamp} ns")
        else:
            compare(replace(comparison, frame=k), f"{path}[]", first[k], second[n])
        on_frame()


def compare_images(
    comparison: Comparison,
    path: str,
    first: CameraSensor,
    second: CameraSensor,
    on_frame: Callable[[], None],
    *,
    pixels: bool,
) -> None:
    """Compare images of the same time: their camera models, and their files byte by byte.

    Images without a file of their own are those of a video, which is compared as one, or have to be decoded.

    Args:
        pixels: decode images whose bytes differ or are not there, and report how far their pixels differ.
    """
    videos = _videos(comparison, path, first, second, reported=not pixels)

    def compare(inner: Comparison, location: str, a: CameraImage, b: CameraImage) -> None:
        inner.records(location, a, b, skipped=("decode", "encoded"))
        equal = videos if a.encoded is None and b.encoded is None else _same_bytes(a, b)
        if equal:
            return
        if pixels:
            _compare_pixels(inner, location, a, b)
        elif equal is None:
            inner.findings.pass_over(
                f"{path}[]: images without files of their own; decode them to compare them"
            )
        elif videos is None:
            inner.add(f"{location}.content", Change.CHANGED, "other bytes")

    compare_frames(comparison, path, first.images, second.images, compare, on_frame)


def compare_depth_images(
    comparison: Comparison,
    path: str,
    first: DepthCameraSensor,
    second: DepthCameraSensor,
    on_frame: Callable[[], None],
    *,
    pixels: bool,
) -> None:
    """Compare depth images of the same time: their camera models, and their videos, else their depths where asked for.

    Args:
        pixels: decode images that no equal videos hold, and report how far their depths differ.
    """
    videos = _videos(comparison, path, first, second, reported=not pixels)

    def compare(inner: Comparison, location: str, a: DepthFrame, b: DepthFrame) -> None:
        inner.records(location, a, b, skipped=("decode",))
        if videos and a.scale == b.scale:
            return
        if pixels:
            _compare_depths(inner, location, a, b)
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


def _same_bytes(a: CameraImage, b: CameraImage) -> bool | None:
    """Whether the files of two images are equal; None where one has none."""
    if a.encoded is None or b.encoded is None:
        return None
    return a.encoded() == b.encoded()


def _videos(
    comparison: Comparison,
    path: str,
    first: CameraSensor | DepthCameraSensor,
    second: CameraSensor | DepthCameraSensor,
    *,
    reported: bool,
) -> bool | None:
    """Whether the videos behind two cameras are equal, `reported` where they are not; None where there are not two."""
    a, b = first.video, second.video
    if a is None or b is None:
        return None
    if a.frame_indices != b.frame_indices:
        return None
    equal = _same_files(a, b)
    if reported and not equal:
        comparison.add(f"{path}.video", Change.CHANGED, f"{a.codec}; then {b.codec} of other bytes")
    return equal


def _same_files(a: VideoContent, b: VideoContent) -> bool:
    with a.open() as first, b.open() as second:
        return all(piece == other for piece, other in _chunks(first, second))


def _chunks(first: BinaryIO | BytesIO, second: BinaryIO | BytesIO) -> Iterator[tuple[bytes, bytes]]:
    while True:
        piece, other = first.read(_PIECE), second.read(_PIECE)
        yield piece, other
        if not piece or not other:
            return


def _compare_pixels(comparison: Comparison, path: str, a: CameraImage, b: CameraImage) -> None:
    first, second = a.rgb, b.rgb
    if first.shape != second.shape:
        message = f"{first.shape[1]}x{first.shape[0]} pixels; then {second.shape[1]}x{second.shape[0]}"
        comparison.add(f"{path}.rgb", Change.CHANGED, message)
        return
    away = np.abs(first.astype(np.int16) - second.astype(np.int16))
    if away.any():
        message = f"the mean difference of a channel, {int(away.max())} at most"
        comparison.add(f"{path}.rgb", Change.CHANGED, message, float(away.mean()), "of 255")
