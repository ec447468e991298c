"""Ways to damage a file: blindly, and knowing where a format keeps its numbers."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence

import numpy as np

from perf.fuzz.image_seeds import png_chunk

Mutation = Callable[[np.random.Generator, bytes, Sequence[bytes]], bytes]

_NUMBERS = (0, 1, 2, 3, 7, 8, 15, 16, 127, 128, 255, 256, 4095, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1,
            2**33, 2**62, 2**63 - 1, 2**63, 2**64 - 1)  # fmt: skip
_TAGS = (254, 255, 256, 257, 258, 259, 262, 266, 270, 273, 274, 277, 278, 279, 284, 285, 292, 317, 320, 322, 323,
         324, 325, 330, 338, 339, 347, 513, 514, 530, 32997, 33628, 33629, 34412, 42113, 50838, 50839,
         65426)  # fmt: skip


def mutate(rng: np.random.Generator, content: bytes, others: Sequence[bytes]) -> bytes:
    """One to three damages, one after the other; ``others``: files to take pieces from."""
    for _ in range(rng.integers(1, 4)):
        known = _BY_FORMAT.get(content[:2], ()) + _BY_FORMAT.get(content[:4], ())
        ways = (*_BLIND, *known * 4)
        content = ways[rng.integers(len(ways))](rng, content, others) or b"\0"
    return content


def _flip(rng: np.random.Generator, content: bytes, _others: Sequence[bytes]) -> bytes:
    data = np.frombuffer(content, np.uint8).copy()
    at = rng.integers(0, len(data), rng.integers(1, 9))
    data[at] ^= np.uint8(1) << rng.integers(0, 8, len(at)).astype(np.uint8)
    return data.tobytes()


def _truncate(rng: np.random.Generator, content: bytes, _others: Sequence[bytes]) -> bytes:
    return content[: rng.integers(0, len(content) + 1)]


def _grow(rng: np.random.Generator, content: bytes, _others: Sequence[bytes]) -> bytes:
    return content + rng.bytes(int(rng.integers(1, 400)))


def _blank(rng: np.random.Generator, content: bytes, _others: Sequence[bytes]) -> bytes:
    """As a file looks of which a part was not written yet."""
    first, last = np.sort(rng.integers(0, len(content) + 1, 2))
    return content[:first] + bytes(last - first) + content[last:]


def _splice(rng: np.random.Generator, content: bytes, others: Sequence[bytes]) -> bytes:
    other = others[rng.integers(len(others))]
    first, last = np.sort(rng.integers(0, len(other) + 1, 2))
    at = rng.integers(0, len(content) + 1)
    return content[:at] + other[first : min(last, first + 4096)] + content[at + rng.integers(0, 64) :]


def _number(rng: np.random.Generator, content: bytes, _others: Sequence[bytes]) -> bytes:
    size = int(rng.choice((2, 4, 8)))
    at = int(rng.integers(0, max(1, len(content) - size)))
    return content[:at] + _as_bytes(rng, size, "<" if rng.integers(2) else ">") + content[at + size :]


def _as_bytes(rng: np.random.Generator, size: int, order: str) -> bytes:
    value = _NUMBERS[rng.integers(len(_NUMBERS))] % 2 ** (8 * size)
    return value.to_bytes(size, "little" if order == "<" else "big")


def _tiff_entry(rng: np.random.Generator, content: bytes, _others: Sequence[bytes]) -> bytes:
    """Change tag, type, count or value of an entry of some header, or the pointer to the next."""
    order = "<" if content[:2] == b"II" else ">"
    big = content[2:4] in (b"+\0", b"\0+")
    pointer, counter, entry = (8, "Q", 20) if big else (4, "H", 12)
    at = 8 if big else 4
    headers: list[tuple[int, int]] = []
    while len(headers) < 5 and at + pointer <= len(content):
        start = int.from_bytes(content[at : at + pointer], "little" if order == "<" else "big")
        size = struct.calcsize(counter)
        if not start or start + size > len(content):
            break
        (n,) = struct.unpack_from(order + counter, content, start)
        headers.append((start + size, n))
        at = start + size + n * entry
    if not headers:
        return _number(rng, content, ())
    first, n = headers[rng.integers(len(headers))]
    start = first + entry * int(rng.integers(0, min(n, 100) + 1))
    half = 8 if big else 4
    field, size = ((0, 2), (2, 2), (4, half), (4 + half, half), (4 + half, half), (4 + half, 2))[rng.integers(6)]
    if field == 0:
        new = struct.pack(order + "H", _TAGS[rng.integers(len(_TAGS))])
    elif field == 2:
        new = struct.pack(order + "H", rng.integers(0, 20))
    else:
        new = _as_bytes(rng, size, order)
    return content[: start + field] + new + content[start + field + size :]


def _png_part(rng: np.random.Generator, content: bytes, _others: Sequence[bytes]) -> bytes:
    """Damage the data of one chunk, or repeat it, or leave it out; its check sum is right."""
    chunks, at = [], 8
    while at + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    if not chunks:
        return _number(rng, content, ())
    chosen = int(rng.integers(len(chunks)))
    kind, data = chunks[chosen]
    way = rng.integers(4)
    if way == 0 and data:
        chunks[chosen] = kind, _number(rng, data, ())
    elif way == 1 and data:
        chunks[chosen] = kind, _flip(rng, data, ())
    elif way == 2:
        chunks.insert(chosen, chunks[rng.integers(len(chunks))])
    else:
        del chunks[chosen]
    return content[:8] + b"".join(png_chunk(*chunk) for chunk in chunks)


def _pnm_number(rng: np.random.Generator, content: bytes, _others: Sequence[bytes]) -> bytes:
    numbers = list(re.finditer(rb"\d+", content[:40]))
    if not numbers:
        return content
    found = numbers[rng.integers(len(numbers))]
    new = (b"%d" % _NUMBERS[rng.integers(len(_NUMBERS))], b"9" * 5000, b"-1", b"# endless ", b"")[rng.integers(5)]
    return content[: found.start()] + new + content[found.end() :]


_BLIND: tuple[Mutation, ...] = (_flip, _truncate, _grow, _blank, _splice, _number)
_BY_FORMAT: dict[bytes, tuple[Mutation, ...]] = {
    b"II": (_tiff_entry,), b"MM": (_tiff_entry,), b"\x89PNG": (_png_part,),
    **{b"P%d" % k: (_pnm_number,) for k in (2, 3, 5, 6)},
}  # fmt: skip
