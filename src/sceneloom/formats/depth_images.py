"""Depth images as files: 16-bit PNG in steps of 1/256 m, or NPZ with the exact float32 metres.

Source: the development kit of the KITTI depth benchmark (PNG: metres times 256, 0 for none).
"""

from pathlib import Path

import numpy as np

from sceneloom.arrays import Float32Array, check_array
from sceneloom.errors import ArrayError, DataError
from sceneloom.formats.encoded_images import open_image
from sceneloom.formats.output import replacing

_STEPS_PER_METRE = 256
_LARGEST = 65535
_COMPRESSION = 3


def write_depth_png(depth_image: Float32Array, path: Path, *, overwrite: bool = False) -> int:
    """Write a depth image as PNG with 16 bits a pixel, rounded to 1/256 m.

    Args:
        depth_image: (H, W) float32 [m], 0 for none. A depth too small for the first step is written as one step.
        overwrite: replace a file that is there.

    Returns:
        How many depths lie beyond what 16 bits hold (255.99 m); they are written as 0.

    Raises:
        ArrayError: the image is empty, or holds NaN or a negative depth.
        OutputError: the file exists or cannot be written.
    """
    from PIL import Image

    _check(depth_image)
    steps = np.rint(depth_image.astype(np.float64) * _STEPS_PER_METRE)
    beyond = steps > _LARGEST
    steps[(depth_image > 0) & (steps == 0)] = 1
    steps[beyond] = 0
    with replacing(path, overwrite=overwrite) as draft:
        Image.fromarray(steps.astype(np.uint16)).save(draft, "PNG", compress_level=_COMPRESSION)
    return int(beyond.sum())


def read_depth_png(path: Path) -> Float32Array:
    """Read a depth image with 16 bits a pixel, in steps of 1/256 m.

    Returns:
        (H, W) float32 [m], 0 for none.

    Raises:
        DataError: it is no such image.
    """
    try:
        with open_image(path, ("PNG",)) as image:
            if not image.mode.startswith("I"):
                raise DataError(
                    path, "", f"an image of mode {image.mode}; expected depths of 16 bits a pixel"
                )
            return np.asarray(image, np.float32) / np.float32(_STEPS_PER_METRE)
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(path, "", f"cannot be read as a depth image: {error}") from error


def write_depth_npz(
    depth_image: Float32Array,
    path: Path,
    *,
    confidence: Float32Array | None = None,
    overwrite: bool = False,
) -> None:
    """Write a depth image losslessly, as array `depth` of a compressed NPZ file.

    Args:
        depth_image: (H, W) float32 [m], 0 for none.
        confidence: (H, W) float32, 0 to 1: goes into the array `confidence` of the file.
        overwrite: replace a file that is there.

    Raises:
        ArrayError: the image is empty, or holds NaN or a negative depth, or the confidence is of another size.
        OutputError: the file exists or cannot be written.
    """
    _check(depth_image)
    check_array("confidence", confidence, depth_image.shape, np.float32, optional=True)
    arrays = {"depth": depth_image} | ({} if confidence is None else {"confidence": confidence})
    with replacing(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # its flags are keywords, too


def write_confidence_png(confidence: Float32Array, path: Path, *, overwrite: bool = False) -> None:
    """Write confidences as PNG with 8 bits a pixel: 255 for 1.

    Args:
        confidence: (H, W) float32, 0 to 1.
        overwrite: replace a file that is there.

    Raises:
        ArrayError: the image is empty, or holds a number outside 0 to 1.
        OutputError: the file exists or cannot be written.
    """
    from PIL import Image

    check_array("confidence", confidence, (None, None), np.float32)
    if confidence.size == 0 or not (confidence >= 0).all() or not (confidence <= 1).all():
        raise ArrayError(
            f"confidence: {confidence.shape}; expected at least one pixel, and numbers from 0 to 1"
        )
    with replacing(path, overwrite=overwrite) as draft:
        Image.fromarray(np.rint(confidence * 255).astype(np.uint8)).save(
            draft, "PNG", compress_level=_COMPRESSION
        )


def _check(depth_image: Float32Array) -> None:
    check_array("depth_image", depth_image, (None, None), np.float32)
    if depth_image.size == 0:
        raise ArrayError(f"depth_image: {depth_image.shape}; expected at least one pixel")
    wrong = np.argwhere(~(depth_image >= 0))
    if len(wrong):
        row, column = (int(number) for number in wrong[0])
        raise ArrayError(
            f"depth_image[{row}, {column}]: {depth_image[row, column]}; expected metres, 0 where there is no depth"
        )
