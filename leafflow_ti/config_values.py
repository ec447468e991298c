"""Single values of a configuration from what people write: sizes, integers, lists of pixels; the machine's memory."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable
from pathlib import Path

_MEMORY_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}
_MIN_MEMORY = 64 * 2**20


def parse_memory(value: object) -> int:
    """Bytes of ``"8G"``, ``"512M"``, ``"1.5G"`` (binary multiples) or of a plain number; else ValueError."""
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)(?:i?B)?\s*", str(value), re.IGNORECASE)
    if found is None:
        raise ValueError("must be a size such as 8G, 512M or a number of bytes")
    number = float(found[1]) if "." in found[1] else int(found[1])
    size = int(number * _MEMORY_UNITS[found[2].upper()])
    if size < _MIN_MEMORY:
        raise ValueError("must be at least 64M")
    return size


def machine_memory() -> int:
    """Memory [bytes] that this process may use: physical memory, or the limit of its control group where that is less.

    8 GiB on systems that tell neither.
    """
    sizes = []
    if hasattr(os, "sysconf"):  # not on Windows
        sizes.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    limit = Path("/sys/fs/cgroup/memory.max")
    if limit.is_file():
        text = limit.read_text(encoding="ascii").strip()
        sizes += [int(text)] if text.isdecimal() else []
    return min(sizes, default=8 * 2**30)


def one_of(value: str, known: Iterable[str]) -> str:
    """``value``, if it is one of ``known``; else ValueError."""
    names = tuple(known)
    if value not in names:
        raise ValueError(f"must be one of {', '.join(names)}")
    return value


def integer(value: object, low: int, odd: bool = False, high: int | None = None) -> int:
    """An integer of at least ``low`` and, where that is given, at most ``high``; else ValueError."""
    try:
        number = int(str(value))  # via str: True and 4.5 are no integers here
    except ValueError:
        number = low - 1
    if number < low or (odd and number % 2 == 0) or (high is not None and number > high):
        limits = f">= {low}" if high is None else f"from {low} to {high}"
        raise ValueError(f"must be an {'odd ' if odd else ''}integer {limits}")
    return number


def auto_or_integer(value: object, low: int, odd: bool = False, high: int | None = None) -> object:
    """The same, or ``"auto"``."""
    if value == "auto":
        return value
    try:
        return integer(value, low, odd, high)
    except ValueError as error:
        raise ValueError(f'{error}, or "auto"') from None


def positive_or_auto(value: object) -> object:
    """A positive number, or ``"auto"``; else ValueError."""
    if value == "auto":
        return value
    number = _number(value)
    if not 0 < number < math.inf:
        raise ValueError('must be a number > 0, or "auto"')
    return number


def increasing(value: object) -> object:
    """Two increasing numbers of ``"1,2.5"`` or ``[1, 2.5]``, or ``"auto"``; else ValueError."""
    if value == "auto":
        return value
    parts = value.split(",") if isinstance(value, str) else value
    found = tuple(map(_number, parts)) if isinstance(parts, list | tuple) else ()
    if len(found) != 2 or not -math.inf < found[0] < found[1] < math.inf:
        raise ValueError('must be two increasing numbers A,B, or "auto"')
    return found


def before_and_behind(value: object) -> object:
    """Two numbers of frames of ``"1,2"`` or ``[1, 2]``, one for both of them, or ``"auto"``; else ValueError."""
    if value == "auto":
        return value
    parts = value.split(",") if isinstance(value, str) else value if isinstance(value, list | tuple) else (value,)
    try:
        found = tuple(integer(part, 0) for part in parts)
    except ValueError:
        found = ()
    if len(found) not in (1, 2):
        raise ValueError('must be frames before and behind, N or A,B, or "auto"')
    return found[0], found[-1]


def _number(value: object) -> float:
    """A number as people write it; else NaN."""
    try:
        return float(str(value))
    except ValueError:
        return math.nan


def noise_or_auto(value: object) -> object:
    """A standard deviation in grey values, or ``"auto"``; else ValueError."""
    if value == "auto":
        return value
    number = _number(value)
    if not 0 <= number < math.inf:
        raise ValueError('must be a number of grey values >= 0, or "auto"')
    return number


def numbers(value: object, counts: tuple[int, ...], form: str) -> tuple[int, ...]:
    """Integers of ``"1,2"``, ``[1, 2]`` or ``1``; ValueError unless there are as many as one of ``counts``."""
    if isinstance(value, str):
        parts: Iterable[object] = value.split(",")
    else:
        parts = value if isinstance(value, list | tuple) else (value,)
    try:
        found = tuple(int(str(part)) for part in parts)
    except ValueError:
        found = ()
    if len(found) not in counts:
        raise ValueError(f"must be whole pixels {form}")
    return found
