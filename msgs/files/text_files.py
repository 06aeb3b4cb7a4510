"""Text of other people's files: byte-order marks, UTF-16, and the bytes of cp1252 where a file is no UTF-8."""

from __future__ import annotations

import codecs
import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from msgs.values.wording import as_utf8

#: Marks and their encodings; that of UTF-32 begins as that of UTF-16 does.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
#: Name of the error handler that reads each byte that is no UTF-8 as cp1252.
AS_CP1252 = "mirrorwave.cp1252"


def _as_cp1252(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeDecodeError) or error.encoding != "utf-8":
        raise error
    return error.object[error.start : error.end].decode("cp1252", "replace"), error.end


codecs.register_error(AS_CP1252, _as_cp1252)


def text_encoding(head: bytes) -> str:
    """Return the encoding that the first four bytes of a file state, UTF-8 where they state none."""
    return next((name for mark, name in _MARKS if head.startswith(mark)), "utf-8")


def decode_text(content: bytes, errors: str = "strict") -> str:
    """Return the text of a file without its byte-order mark; `ValueError` that names the byte that is none."""
    encoding = text_encoding(content[:4])
    try:
        return content.decode(encoding, errors)
    except UnicodeDecodeError as error:
        at, name = error.start, encoding.removesuffix("-sig").upper()
        raise ValueError(f"must be {name} text, got byte {content[at]:#04x} at {at}") from None


def read_text(path: Path, errors: str = "strict") -> str:
    """Return the text of a file; `ValueError` that begins with its path, `OSError` where it cannot be read."""
    try:
        return decode_text(path.read_bytes(), errors)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


@contextlib.contextmanager
def without_mark(path: Path) -> Iterator[Path]:
    """Yield a file, or a copy without mark or odd name for readers that trip over these; errors name the file."""
    with path.open("rb") as file:
        if file.read(len(codecs.BOM_UTF8)) != codecs.BOM_UTF8:
            file.seek(0)
            if as_utf8(str(path)) == str(path):
                yield path
                return
        with tempfile.NamedTemporaryFile(suffix=path.suffix) as copy:
            shutil.copyfileobj(file, copy)
            copy.flush()
            try:
                yield Path(copy.name)
            except ValueError as error:
                raise ValueError(str(error).replace(copy.name, str(path))) from None
