"""The bare structure of a TIFF file: its chain of headers and the entries that its values hang on.

tifffile leaves out what it cannot parse and says so in its log. An image whose compression, predictor or type is left
out would then be read with the default: here such a file is refused. What a header may ask for is bounded, too, before
anything is made of it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.stored import OpenFile, StoredFile
from leafflow_ti.errors import InputError

MAX_PAGES = 2**16
"""Headers in one file; each costs about 0.2 ms to parse."""
MAX_ENTRIES = 4096
"""Entries of one header (tifffile reads no more)."""
MAX_VALUES = 2**24
"""Numbers in the entries of all headers, strips and tiles above all; each costs about 40 bytes once it is parsed."""

_BYTES = np.zeros(19, np.int64)  # of one value, by type; 0: no such type
_BYTES[1:14] = 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4
_BYTES[16:19] = 8
_WHOLE_NUMBERS = (1, 3, 4, 8, 9, 13, 16, 17, 18)
_TEXT = (1, 2, 6, 7)
_SINGLE = (254, 256, 257, 259, 262, 266, 274, 277, 284, 292, 317, 322, 323, 32997, 32998)
_NEEDED = (*_SINGLE, 258, 273, 278, 279, 320, 324, 325, 338, 339, 513, 514, 530)
_TABLES = 347
"""Tags that decide about values: one whole number, any count of them, and the tables of JPEG, which are bytes."""


@dataclass(frozen=True)
class _Format:
    count: str
    pointer: str
    entry: np.dtype[np.void]
    inline: int  # bytes of values that stand in the entry itself


def _format(order: str, big: bool) -> _Format:
    pointer = order + ("Q" if big else "I")
    size = struct.calcsize(pointer)
    number = f"{order}u{size}"
    entry = np.dtype([("tag", f"{order}u2"), ("type", f"{order}u2"), ("count", number), ("value", number)])
    return _Format(order + ("Q" if big else "H"), pointer, entry, size)


def check_structure(stored: StoredFile, file: OpenFile) -> int:
    """Number of headers in the chain; raises InputError for a chain that leaves the file or bites its tail, and for
    entries that are doubled, lead out of the file, or ask for more than the file can hold."""
    order = "<" if file.read(0, 2) == b"II" else ">"
    big = file.read(2, 2) in (b"+\0", b"\0+")
    form = _format(order, big)
    (offset,) = struct.unpack(form.pointer, file.read(8 if big else 4, form.inline))
    seen: set[int] = set()
    values = value_bytes = 0
    while offset:
        name = f"{stored.path}: page {len(seen)}"
        if offset in seen or offset >= stored.size:
            raise InputError(f"{name} has its header at byte {offset}: damaged, write it again")
        if len(seen) == MAX_PAGES:
            raise InputError(f"{stored.path}: more than {MAX_PAGES} pages: split the stack into several files")
        seen.add(offset)
        counter = struct.calcsize(form.count)
        (n,) = struct.unpack(form.count, file.read(offset, counter))
        if not 1 <= n <= MAX_ENTRIES:
            raise InputError(f"{name}: a header of {n} entries, 1 to {MAX_ENTRIES} are read: damaged, write it again")
        block = file.read(offset + counter, n * form.entry.itemsize + form.inline)
        counts, sizes = _check_entries(name, np.frombuffer(block, form.entry, n), form.inline, stored.size)
        values, value_bytes = values + counts, value_bytes + sizes
        if values > MAX_VALUES or value_bytes > 2 * stored.size:
            raise InputError(
                f"{name}: headers with {values} values ({value_bytes} bytes), more than {MAX_VALUES} or twice the "
                "file: damaged, or save in larger strips or tiles"
            )
        (offset,) = struct.unpack_from(form.pointer, block, n * form.entry.itemsize)
    if not seen:
        raise InputError(f"{stored.path}: TIFF without an image: write the file again")
    return len(seen)


def _check_entries(name: str, entries: npt.NDArray[np.void], inline: int, size: int) -> tuple[int, int]:
    """Numbers and bytes of all values of one header that lie in the file."""
    types = np.minimum(entries["type"], 14)  # 14 is no type
    types = np.where((entries["type"] >= 16) & (entries["type"] <= 18), entries["type"], types)
    each = _BYTES[types]
    # Counts and offsets of BigTIFF reach 2**64: as float they are compared without overflow, exactly up to 2**53.
    n_bytes = entries["count"].astype(np.float64) * each
    inside = (n_bytes <= inline) | ((entries["value"] >= 8) & (entries["value"].astype(np.float64) + n_bytes <= size))
    sound = (each > 0) & (entries["count"] > 0) & inside
    needed = np.isin(entries["tag"], (*_NEEDED, _TABLES))
    whole = np.isin(entries["type"], _WHOLE_NUMBERS) | ((entries["tag"] == _TABLES) & np.isin(entries["type"], _TEXT))
    several = np.isin(entries["tag"], _SINGLE) & (entries["count"] != 1)
    bad = entries["tag"][needed & (several | ~(sound & whole))]
    if len(bad):
        raise InputError(f"{name}: entry {bad[0]} of the header is damaged: write the file again")
    tags, times = np.unique(entries["tag"][needed], return_counts=True)
    if (times > 1).any():
        raise InputError(f"{name}: entry {tags[times > 1][0]} stands twice in the header: write the file again")
    numbers = sound & ~np.isin(entries["type"], _TEXT)
    return int(entries["count"][numbers].sum()), int(n_bytes[sound & (n_bytes > inline)].sum())
