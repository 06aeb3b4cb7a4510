"""Images that are no JPEG yet, compressed by the library Pillow; a JPEG stays as it is, byte for byte."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from msgs.values.camera import MAX_JPEG_BYTES, MAX_PIXELS, MAX_SIDE_PX

QUALITY = 90
#: Raw pixels of ROS by their encoding: bytes a pixel, and the order of red, green, blue; () for grey.
ENCODINGS: dict[str, tuple[int, tuple[int, ...]]] = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "mono8": (1, ()),
    "8UC1": (1, ()),
    "8UC3": (3, (2, 1, 0)),
}
#: Formats of files beside JPEG that are compressed anew.
FORMATS = ("PNG", "BMP", "TIFF", "PPM", "WEBP")


def jpeg_of_file(data: bytes) -> bytes:
    """Return a JPEG of a file's bytes: themselves, or an image of `FORMATS` compressed; `ValueError` for others."""
    from PIL import Image, UnidentifiedImageError

    if data.startswith(b"\xff\xd8"):
        return data
    if not data:
        raise ValueError("image must be a JPEG, it is empty")
    try:
        with _small_enough(), Image.open(io.BytesIO(data), formats=FORMATS) as image:
            require_pixels(*image.size)
            return _compressed(image.convert("RGB"))
    except UnidentifiedImageError:
        raise ValueError(f"image must be a JPEG, or {', '.join(FORMATS)}, got {data[:4].hex(' ')}") from None
    except Exception as error:  # noqa: BLE001 - a damaged image fails in whatever way the damage makes its reader
        raise ValueError(f"image cannot be read: {' '.join(str(error).split())}") from None


def jpeg_of_pixels(image: Any) -> bytes:
    """Return the JPEG of a `sensor_msgs/Image`; `ValueError` for an encoding or sizes that do not fit its data."""
    from PIL import Image

    if image.encoding not in ENCODINGS:
        raise ValueError(f"encoding must be one of {', '.join(ENCODINGS)}, got {image.encoding!r}")
    depth, order = ENCODINGS[image.encoding]
    require_pixels(image.width, image.height)
    data, used = np.asarray(image.data, np.uint8), image.width * depth
    if image.step < used or len(data) < image.step * (image.height - 1) + used:
        need = f"{image.height} rows of {used} bytes in steps of {image.step}"
        raise ValueError(f"data must hold {need}, got {len(data)} bytes")
    rows = np.lib.stride_tricks.as_strided(data, (image.height, used), (image.step, 1), writeable=False)
    pixels = rows.reshape(image.height, image.width, depth)
    grey_or_colour = pixels[..., order] if order else pixels[..., 0]
    return _compressed(Image.fromarray(np.ascontiguousarray(grey_or_colour)))


@contextmanager
def _small_enough() -> Iterator[None]:
    """Have the library refuse an image that it only warns of, for its size."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def require_pixels(width_px: int, height_px: int) -> None:
    """Raise `ValueError` for an image of no pixels, or of more than are read."""
    if not (0 < width_px <= MAX_SIDE_PX and 0 < height_px <= MAX_SIDE_PX and width_px * height_px <= MAX_PIXELS):
        limit = f"1..{MAX_SIDE_PX} pixels a side and {MAX_PIXELS} in all"
        raise ValueError(f"image must have {limit}, got {width_px} x {height_px}")


def _compressed(image: Any) -> bytes:
    out = io.BytesIO()
    image.save(out, "JPEG", quality=QUALITY)
    if len(out.getvalue()) > MAX_JPEG_BYTES:
        raise ValueError(f"image must have at most {MAX_JPEG_BYTES} bytes as a JPEG, got {len(out.getvalue())}")
    return out.getvalue()
