"""Which files of a capture are not what they were when a run began.

A listing has name, size and time of every file, as one compressed text: small enough for the attributes of a results
store (some 6 bytes a file). Times decide only where some files kept theirs: a copy of a whole capture has others
throughout, and is known by the checksums of its fingerprint.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterable
from pathlib import Path

from leafflow_ti.capture.files import FileState

CHECKED_BYTES = 64 * 2**20
"""Bytes of a capture up to which all are part of its checksum."""
PARTS = 64
"""Parts of a larger one, evenly spread over its files, that are part of it."""
_TICK_NS = 1_000_000
"""Resolution of the times in a listing: no file is written twice within it."""
_MOST_UNPACKED = 2**30

Listing = dict[str, FileState]
"""Name -> state."""


def pack(files: Iterable[tuple[str, FileState]]) -> str:
    """A listing as one line of text; names hold neither tabs nor ends of lines."""
    lines, before = [], 0
    for name, state in files:
        ticks = state.mtime_ns // _TICK_NS
        lines.append(f"{name}\t{state.size}\t{ticks - before}")
        before = ticks
    return base64.b64encode(zlib.compress("\n".join(lines).encode("utf-8", "surrogateescape"), 9)).decode("ascii")


def unpack(text: str) -> Listing:
    """The listing of a text; ValueError for one that is damaged."""
    try:
        content = zlib.decompressobj().decompress(base64.b64decode(text, validate=True), _MOST_UNPACKED)
        found, ticks = {}, 0
        for line in content.decode("utf-8", "surrogateescape").split("\n"):
            name, size, step = line.split("\t")
            ticks += int(step)
            found[name] = FileState(int(size), ticks * _TICK_NS)
    except (ValueError, zlib.error) as error:
        raise ValueError(f"no listing of files: {error}") from error
    return found


def changes(old: str, new: str) -> dict[str, str]:
    """Name -> what happened to it, for every file that differs between two listings; none for a copy with other times.

    Raises ValueError for a text that is no listing.
    """
    before, now = unpack(old), unpack(new)
    found = {name: "is missing" for name in before if name not in now}
    found |= {name: "is new" for name in now if name not in before}
    both = [name for name in before if name in now]
    found |= {
        name: f"had {before[name].size} bytes, has {now[name].size}"
        for name in both if before[name].size != now[name].size
    }  # fmt: skip
    later = [name for name in both if name not in found and not before[name].same(now[name])]
    if len(later) < len(both) - sum(name in found for name in both):
        found |= dict.fromkeys(later, "was written anew")
    return found


def parts(paths: Iterable[tuple[Path, int]]) -> list[tuple[Path, int, int]]:
    """Files of the given sizes -> file, offset and bytes of what a checksum of them all reads."""
    files = list(paths)
    total = sum(size for _, size in files)
    if total <= CHECKED_BYTES:
        return [(path, 0, size) for path, size in files]
    length = CHECKED_BYTES // PARTS
    # Both ends, and evenly between them.
    starts = [k * (total - 1) // (PARTS - 1) for k in range(PARTS)]
    found, begin, k = [], 0, 0
    for path, size in files:
        while k < PARTS and starts[k] < begin + size:
            offset = min(starts[k] - begin, max(size - length, 0))
            found.append((path, offset, min(length, size - offset)))
            k += 1
        begin += size
    return found
