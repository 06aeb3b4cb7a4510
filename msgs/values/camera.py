"""Images of a camera beside the radar: JPEG, as the camera or a library compressed it."""

from __future__ import annotations

import struct
from typing import Annotated, ClassVar, Self

import msgspec
import numpy as np

from msgs.values.arrays import Array, Checked, Count, StampNs

#: Largest image: a frame of 8 megapixels in high quality has 4 MiB.
MAX_JPEG_BYTES = 7 << 20
#: Pixels of a side, and of the whole: what a reader has to make room for.
MAX_SIDE_PX, MAX_PIXELS = 16_384, 1 << 26
#: Markers with sizes: start of frame, without the tables 0xC4, 0xC8 and 0xCC.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
#: Markers that stand alone, and that of the compressed data.
_ALONE, _SCAN = frozenset((0x01, *range(0xD0, 0xD9))), 0xDA
_START, _END = b"\xff\xd8\xff", b"\xff\xd9"
_SIZE = struct.Struct(">HBHH")


class CameraImage(Checked, frozen=True, kw_only=True, eq=False):
    """One image of a camera (topic `camera/image`)."""

    label: ClassVar[str] = "image"

    stamp_ns: StampNs
    #: Counts the images of a source.
    image_id: Count = 0
    #: Name of the camera, or of its frame.
    sensor: str = ""
    width_px: Annotated[int, msgspec.Meta(ge=1, le=MAX_SIDE_PX)]
    height_px: Annotated[int, msgspec.Meta(ge=1, le=MAX_SIDE_PX)]
    #: A whole JPEG file, its bytes [bytes].
    jpeg: Annotated[np.ndarray, Array("|u1", (None,))]

    def __post_init__(self) -> None:
        super().__post_init__()
        size = jpeg_size(self.jpeg.tobytes())
        if size != (self.width_px, self.height_px):
            raise ValueError(f"image must be of {self.width_px} x {self.height_px} pixels, its JPEG has {size}")

    @classmethod
    def of(cls, jpeg: bytes, stamp_ns: int, image_id: int = 0, sensor: str = "") -> Self:
        """Return the image of a JPEG file's bytes; `ValueError` where they are none."""
        width_px, height_px = jpeg_size(jpeg)
        return cls(
            stamp_ns=stamp_ns, image_id=image_id, sensor=sensor, width_px=width_px, height_px=height_px,
            jpeg=np.frombuffer(jpeg, np.uint8),
        )  # fmt: skip


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Return width and height of a JPEG by its header alone; `ValueError` for other bytes, cut or too large ones."""
    if not data:
        raise ValueError("image must be a JPEG, it is empty")
    if not data.startswith(_START):
        raise ValueError(f"image must be a JPEG, which begins with ff d8 ff, got {data[:4].hex(' ')}")
    if len(data) > MAX_JPEG_BYTES:
        raise ValueError(f"image must have at most {MAX_JPEG_BYTES} bytes, got {len(data)}")
    size, at = None, 2
    while at + 4 <= len(data):
        marker = data[at + 1]
        if data[at] != 0xFF:
            raise ValueError(f"image must be a JPEG: no marker at byte {at}")
        if marker == 0xFF or marker in _ALONE:
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _FRAMES and at + 4 + 5 <= len(data):
            _, _, height_px, width_px = _SIZE.unpack_from(data, at + 2)
            size = width_px, height_px
        if marker == _SCAN:
            break
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    if size is None or data.rfind(_END) < at:
        raise ValueError(f"image must be a whole JPEG, it is cut off after {len(data)} bytes")
    if not (0 < size[0] <= MAX_SIDE_PX and 0 < size[1] <= MAX_SIDE_PX and size[0] * size[1] <= MAX_PIXELS):
        limit = f"1..{MAX_SIDE_PX} pixels a side and {MAX_PIXELS} in all"
        raise ValueError(f"image must have {limit}, got {size[0]} x {size[1]}")
    return size
