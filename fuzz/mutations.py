"""Inputs of several parts as one string of bytes, and changes to them that keep most of an input meaningful.

A mutation knows what kind of part it changes, so that it gets past the outermost check: a key of a msgpack map, a word
of a text, a record of an MCAP file whose checksums are left out then, an array of an npz archive.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import random
import re
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import msgpack
import zstandard

Parts = list[bytes]
Change = Callable[[bytes, random.Random], bytes]

#: Opcodes of MCAP records; the library itself is imported by the reader first, where coverage is looked at.
_FOOTER, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x05, 0x06, 0x0F
_LENGTH = struct.Struct("<I")
MAX_PARTS = 16
NUMBERS: tuple[Any, ...] = (
    0, 1, -1, 2, 3, 7, 8, 63, 64, 65, 127, 128, 255, 256, 511, 1000, 4096, 65535, 65536, 1 << 20, (1 << 31) - 1,
    1 << 31, (1 << 32) - 1, 1 << 32, 1 << 48, (1 << 53) + 1, (1 << 62) - 1, 1 << 62, (1 << 63) - 1, (1 << 64) - 1,
    -(1 << 31), -(1 << 63), 0.0, -0.0, 0.5, -0.5, 1e-9, 1e-300, 5e-324, 1e9, 1e15, 1e19, 1e300,
    1.7976931348623157e308, math.pi, math.nan, math.inf, -math.inf,
)  # fmt: skip
OTHERS: tuple[Any, ...] = (None, True, False, "", "x", "\x00", "ä", "a" * 300, "../x", "1", [], {}, [[]], b"", b"\xff")
#: Words that readers of text look for.
WORDS = (
    "nan", "inf", "-inf", "1e999", "-1", "0", "1", "65536", "4294967295", "99999999999999999999", "1e-320", "~", "null",
    "true", "!!bool x", "!!int x", "!!timestamp x", "!!binary =", "!!float ''", "!!python/name:os.system", "&a", "*a",
    "<<: *a", "? [1]", "[", "]", "{", "}", ":", "- ", "#", "\\", '"', "'", "=", "%", ",", ";", "@", "|", "\t", "\n",
    "\r", "\x00", "\x1e", "\x7f", "\u2028", "\ufeff", "١", "é", "0x", "--", "..", "/", "$", "*",
)  # fmt: skip


def joined(parts: Parts) -> bytes:
    """Parts as one input: each behind its length, 32 bits, little-endian."""
    return b"".join(_LENGTH.pack(len(part)) + part for part in parts)


def split(data: bytes) -> Parts:
    """Parts of any bytes: a length that is too large means the rest."""
    parts: Parts = []
    at = 0
    while at < len(data) and len(parts) < MAX_PARTS:
        length = int.from_bytes(data[at : at + 4], "little")
        parts.append(data[at + 4 : at + 4 + length])
        at += 4 + length
    return parts


def mutated(parts: Parts, kinds: tuple[str, ...], rng: random.Random) -> Parts:
    """`parts` with one to three changes; the last of `kinds` holds for all further parts."""
    parts = list(parts) or [b""]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        at = rng.randrange(len(parts))
        if rng.random() < 0.04:
            match rng.randrange(3):
                case 0 if len(parts) < MAX_PARTS:
                    parts.insert(at, parts[rng.randrange(len(parts))])
                case 1 if len(parts) > 1:
                    del parts[at]
                case _:
                    other = rng.randrange(len(parts))
                    parts[at], parts[other] = parts[other], parts[at]
            continue
        kind = kinds[min(at, len(kinds) - 1)]
        change = CHANGES[kind] if rng.random() < 0.8 else change_bytes
        # what is too broken for a change that knows its kind still has bytes
        try:
            parts[at] = change(parts[at], rng)
        except Exception:  # noqa: BLE001 - a mutation may fail in whatever way its input makes it
            parts[at] = change_bytes(parts[at], rng)
    return parts


def change_bytes(data: bytes, rng: random.Random) -> bytes:
    """Some bytes flipped, overwritten with a number, cut out, doubled or put in."""
    out = bytearray(data)
    at = rng.randrange(len(out) + 1)
    length = min(rng.choice((1, 1, 2, 4, 8, 16, 64)), len(out) - at)
    match rng.randrange(7):
        case 0 if at < len(out):
            out[at] ^= 1 << rng.randrange(8)
        case 1 if at < len(out):
            out[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        case 2:
            width = rng.choice((1, 2, 4, 8))
            number = int(rng.choice([one for one in NUMBERS if isinstance(one, int)])) & ((1 << 8 * width) - 1)
            out[at : at + width] = number.to_bytes(width, rng.choice(("little", "big")))
        case 3:
            del out[at : at + length]
        case 4:
            out[at:at] = out[at : at + length]
        case 5:
            out[at:at] = rng.randbytes(rng.choice((1, 2, 4, 8)))
        case _:
            del out[at:]
    return bytes(out)


def change_text(data: bytes, rng: random.Random) -> bytes:
    """A word, a number or a line changed."""
    text = data.decode("utf-8", "replace")
    numbers = list(re.finditer(r"-?\d+(\.\d+)?([eE][-+]?\d+)?", text))
    lines = text.split("\n")
    at, line = rng.randrange(len(text) + 1), rng.randrange(len(lines))
    match rng.randrange(6):
        case 0 | 1 if numbers:
            found = rng.choice(numbers)
            number = rng.choice((*map(str, NUMBERS), str(rng.randrange(-3, 70)), "0x7f", "00"))
            return (text[: found.start()] + number + text[found.end() :]).encode()
        case 2:
            return (text[:at] + rng.choice(WORDS) + text[at:]).encode()
        case 3:
            del lines[line]
        case 4:
            lines.insert(rng.randrange(len(lines) + 1), lines[line])
        case _:
            words = lines[line].split(" ")
            words[rng.randrange(len(words))] = rng.choice(WORDS)
            lines[line] = " ".join(words)
    return "\n".join(lines).encode()


def change_tree(value: Any, rng: random.Random) -> Any:
    """A plain value with one value below it, or its name, changed."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        match rng.randrange(12):
            case 0:
                return {name: item for name, item in value.items() if name != key}
            case 1:
                return {rng.choice(OTHERS[3:10]) if name == key else name: item for name, item in value.items()}
            case 2:
                return value | {rng.choice(list(value)): value[key]}
            case _:
                return value | {key: change_tree(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        at = rng.randrange(len(value))
        match rng.randrange(8):
            case 0:
                return value[:at] + value[at + 1 :]
            case 1:
                return [*value[:at], value[at], *value[at:]]
            case 2:
                return value * rng.choice((2, 3, 17))
            case _:
                return [*value[:at], change_tree(value[at], rng), *value[at + 1 :]]
    return _another(value, rng)


def _another(value: Any, rng: random.Random) -> Any:
    if isinstance(value, bytes) and rng.random() < 0.9:
        return change_bytes(value, rng)
    if isinstance(value, str) and rng.random() < 0.6:
        return change_text(value.encode("utf-8", "replace"), rng).decode("utf-8", "replace")
    if isinstance(value, int | float) and rng.random() < 0.4:
        return rng.choice((value + 1, value - 1, -value, value * 2, value * 1e6, float(value)))
    if rng.random() < 0.05:
        return _deep(value, rng.choice((10, 40, 1100)))
    return rng.choice((*NUMBERS, *OTHERS))


def _deep(value: Any, levels: int) -> Any:
    for _ in range(levels):
        value = [value]
    return value


def change_msgpack(data: bytes, rng: random.Random) -> bytes:
    """A value of a msgpack message changed."""
    tree = change_tree(msgpack.unpackb(data, strict_map_key=False), rng)
    packed: bytes = msgpack.packb(tree)
    return packed


def change_json(data: bytes, rng: random.Random) -> bytes:
    """A value of a JSON document changed, or its text."""
    if rng.random() < 0.25:
        return change_text(data, rng)
    return json.dumps(change_tree(json.loads(data), rng), default=str).encode()


def change_yaml(data: bytes, rng: random.Random) -> bytes:
    """A value of a YAML document changed, or its text."""
    if rng.random() < 0.5:
        return change_text(data, rng)
    # imported late: where coverage is looked at, by the reader first
    import yaml

    return yaml.safe_dump(change_tree(yaml.safe_load(data), rng), sort_keys=False, allow_unicode=True).encode()


def change_mcap(data: bytes, rng: random.Random) -> bytes:
    """Something in one record of an MCAP file changed, also within a chunk; checksums are left out."""
    records = list(mcap_records(data, 8))
    at = rng.randrange(len(records))
    match rng.randrange(10):
        case 0:
            records.insert(rng.randrange(len(records) + 1), records[at])
        case 1:
            del records[at]
        case _:
            opcode, body = records[at]
            body = _change_chunk(body, rng) if opcode == _CHUNK else change_bytes(body, rng)
            records[at] = opcode, body
    return data[:8] + b"".join(_record(*_unchecked(*record)) for record in records) + data[-8:]


def mcap_records(data: bytes, at: int) -> Any:
    """Opcode and body of each record from `at` on."""
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            return
        yield opcode, data[at + 9 : at + 9 + length]
        at += 9 + length


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _unchecked(opcode: int, body: bytes) -> tuple[int, bytes]:
    if opcode == _FOOTER and len(body) == 20:
        return opcode, body[:16] + bytes(4)
    return opcode, bytes(4) if opcode == _DATA_END and len(body) == 4 else body


def _change_chunk(body: bytes, rng: random.Random) -> bytes:
    """A chunk with its records decompressed, one of them changed, and compressed again or not."""
    if rng.random() < 0.2:
        return change_bytes(body, rng)
    head, name_length = body[:16], int.from_bytes(body[28:32], "little")
    name, stored = body[32 : 32 + name_length], body[40 + name_length :]
    plain = zstandard.decompress(stored) if name == b"zstd" else stored
    records = list(mcap_records(plain, 0))
    at = rng.randrange(len(records))
    opcode, inner = records[at]
    if opcode == _MESSAGE and len(inner) > 22 and rng.random() < 0.6:
        inner = inner[:22] + change_msgpack(inner[22:], rng)
    else:
        inner = change_bytes(inner, rng)
    records[at] = opcode, inner
    plain = b"".join(_record(*record) for record in records)
    name = rng.choice((b"", name))
    stored = zstandard.compress(plain) if name == b"zstd" else plain
    tail = struct.pack(f"<I{len(name)}sQ", len(name), name, len(stored))
    return head + struct.pack("<QI", len(plain), 0) + tail + stored


def change_npz(data: bytes, rng: random.Random) -> bytes:
    """An array of an archive changed, left out or renamed; the archive itself stays whole."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(members))
    match rng.randrange(8):
        case 0:
            del members[name]
        case 1:
            members[rng.choice(list(members))] = members[name]
        case _:
            members[name] = change_npy(members[name], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive, contextlib.suppress(UserWarning):
        for member, content in members.items():
            archive.writestr(zipfile.ZipInfo(member), content)
    return out.getvalue()


def change_npy(data: bytes, rng: random.Random) -> bytes:
    """The header or the numbers of a .npy file changed."""
    if rng.random() < 0.5:
        return change_bytes(data, rng)
    length = int.from_bytes(data[8:10], "little")
    header = change_text(data[10 : 10 + length], rng)
    return data[:8] + (len(header) & 0xFFFF).to_bytes(2, "little") + header + data[10 + length :]


CHANGES: dict[str, Change] = {
    "bytes": change_bytes,
    "text": change_text,
    "msgpack": change_msgpack,
    "json": change_json,
    "yaml": change_yaml,
    "mcap": change_mcap,
    "npz": change_npz,
    "npy": change_npy,
}
