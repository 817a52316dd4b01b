"""Label images: PNG files whose pixels are numbers of classes, of 8 or 16 bits, or of a palette."""

from pathlib import Path

import numpy as np

from sceneloom.arrays import UInt16Array, check_array
from sceneloom.errors import DataError
from sceneloom.formats.encoded_images import open_image
from sceneloom.formats.output import replacing

_NUMBERS = {"1", "L", "P", "I", "I;16", "I;16B", "I;16L"}
_LARGEST = 65535
_LARGEST_BYTE = 255
_COMPRESSION = 3


def read_label_png(path: Path) -> UInt16Array:
    """Read the numbers of the classes, (H, W); of a palette its indices, whatever their colours are.

    Raises:
        DataError: the file cannot be read, or its pixels are colours and not numbers.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with open_image(path, ("PNG",)) as image:
            mode = image.mode
            values = np.asarray(image) if mode in _NUMBERS else None
    except UnidentifiedImageError as error:
        raise DataError(path, "", "is no PNG file; expected a label image") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(path, "", f"cannot be read: {error}; expected a label image") from error
    if values is None or values.ndim != 2:
        problem = f"pixels are colours ({mode}); expected one number each: grey of 8 or 16 bits, or a palette"
        raise DataError(path, "", problem)
    if values.size and not (int(values.min()) >= 0 and int(values.max()) <= _LARGEST):
        raise DataError(path, "", f"numbers from {values.min()} to {values.max()}; expected 0 to {_LARGEST}")
    return values.astype(np.uint16)


def write_label_png(labels: UInt16Array, path: Path, *, overwrite: bool = False) -> None:
    """Write numbers of classes (H, W) as grey of 8 bits, or of 16 where one needs them.

    Raises:
        OutputError: the file exists or cannot be written.
    """
    from PIL import Image

    check_array("labels", labels, (None, None), np.uint16)
    small = int(labels.max(initial=0)) <= _LARGEST_BYTE
    with replacing(path, overwrite=overwrite) as draft:
        Image.fromarray(labels.astype(np.uint8) if small else labels).save(
            draft, "PNG", compress_level=_COMPRESSION
        )
