"""File name patterns with numbered fields, e.g. ``cam_{sx:02d}/frame_{t:02d}.tif``: formatting and discovery."""

from __future__ import annotations

import itertools
import os
import re
import string
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from leafflow_ti.capture.files import Reach, unreadable
from leafflow_ti.errors import InputError

AXES = ("t", "sy", "sx")
"""Axes of a capture above ``y`` and ``x``, slowest first."""
FIELDS = (*AXES, "i")
LONGEST = 500
"""Characters of a path: beyond any in use, and few enough for a line of error."""
MOST_DIGITS = 18
"""Of a number in a name: it fits 64 bits."""

_NO_NAME = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories: control characters, lone surrogates, separators of lines and paragraphs."""

_Part = tuple[str, str | None, str]  # literal text, then a field or None, and its format


def path_text(text: str) -> str:
    """A path as it is; ValueError for what none can be, or what would break the lines of messages."""
    if not text:
        raise ValueError("the file name is empty")
    if len(text) > LONGEST:
        raise ValueError(f"a name of {len(text)} characters, paths have at most {LONGEST}")
    odd = next((letter for letter in text if unicodedata.category(letter) in _NO_NAME), None)
    if odd is not None:
        raise ValueError(f"the name holds the character {odd!a}: rename the files")
    return text


@dataclass(frozen=True)
class Pattern:
    """A path in which fields stand for whole numbers.

    A field with a format (``{t:03d}``) matches just the names which that format writes, one without (``{t}``) any
    digits. A field may occur several times; its values must then agree. One that another field or a digit follows has a
    format ``0Nd``, and then exactly N digits.
    """

    text: str
    components: tuple[tuple[_Part, ...], ...]

    @classmethod
    def parse(cls, text: str) -> Pattern:
        """Split a pattern; raises ValueError for an unknown field, a format other than ``d`` and ``0Nd``, fields whose
        digits cannot be told apart, and what no path can be."""
        return cls(text, tuple(_parts(component) for component in Path(path_text(text)).parts))

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields, each once, in order of appearance."""
        return tuple(dict.fromkeys(field for parts in self.components for _, field, _ in parts if field is not None))

    def format(self, values: Mapping[str, int]) -> str:
        """The path for given values."""
        return str(Path(*(_format(parts, values) for parts in self.components)))

    def discover(self, reach: Reach) -> list[tuple[dict[str, int], Path]]:
        """What fits, with its values; paths sorted. Only names with fields are looked up on disk.

        Raises InputError for folders that cannot be listed, lie outside, or are found by two names.
        """
        return sorted(self._walk(reach, reach.root, 0, {}, {}), key=lambda found: str(found[1]))

    def _walk(
        self, reach: Reach, folder: Path, depth: int, values: dict[str, int], listed: dict[tuple[int, str], Path]
    ) -> Iterator[tuple[dict[str, int], Path]]:
        if depth == len(self.components):
            yield values, folder
            return
        parts = self.components[depth]
        if all(field is None or field in values for _, field, _ in parts) and not _free(parts):
            yield from self._walk(reach, folder / _format(parts, values), depth + 1, values, listed)
            return
        # A link to a folder above would be walked through again and again, with one more name each time.
        other = listed.setdefault((depth, reach.folder(folder)), folder)
        if other != folder:
            raise InputError(f"{folder} and {other} are one folder: remove the link, or narrow the pattern")
        regex = _regex(parts)
        for name in _names(folder):
            found = _match(regex, parts, name, values)
            if found is not None:
                yield from self._walk(reach, folder / name, depth + 1, found, listed)


def _names(folder: Path) -> list[str]:
    """Names in a folder; none where it is no folder."""
    try:
        with os.scandir(folder) as entries:
            return [entry.name for entry in entries]
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise unreadable(folder, error, "check the folder and its permissions") from error


def _parts(component: str) -> tuple[_Part, ...]:
    result: list[_Part] = []
    for literal, field, spec, conversion in string.Formatter().parse(component):
        if field is not None:
            if field not in FIELDS or conversion:
                raise ValueError(f"field '{{{field}}}' is unknown, the fields are {', '.join(FIELDS)}")
            if not re.fullmatch(r"(0[1-9]\d?)?d|", spec or "") or _width(spec or "") > MOST_DIGITS:
                raise ValueError(
                    f"format '{spec}' of field {field} must be d or 0Nd with N up to {MOST_DIGITS}, "
                    f"e.g. {{{field}:03d}}"
                )
        result.append((literal, field, spec or ""))
    for (_, field, spec), bounded in zip(result, _bounded(result), strict=True):
        if bounded and not _width(spec):
            raise ValueError(
                f"field {field} is followed by a digit or a field, and where it ends cannot be told: give it a format, "
                f"e.g. {{{field}:03d}}"
            )
    return tuple(result)


def _width(spec: str) -> int:
    """Least number of digits that a format writes; 0: no format 0Nd."""
    return int(spec[1:-1] or 0)


def _bounded(parts: Sequence[_Part]) -> list[bool]:
    """For each part whether its field's digits end where a digit or the next field begins."""
    found = [
        field is not None and (literal[:1].isdigit() if literal else following is not None)
        for (_, field, _), (literal, following, _) in itertools.pairwise(parts)
    ]
    return [*found, False][: len(parts)]


def _free(parts: tuple[_Part, ...]) -> bool:
    """Whether a field has no format, so that its digits must be looked up even when its value is known."""
    return any(field is not None and not spec for _, field, spec in parts)


def _format(parts: tuple[_Part, ...], values: Mapping[str, int]) -> str:
    return "".join(
        literal + ("" if field is None else format(values[field], spec or "d")) for literal, field, spec in parts
    )


def _regex(parts: tuple[_Part, ...]) -> re.Pattern[str]:
    """There is one way to match a name, so that no name takes longer than to read it."""
    text = ""
    for (literal, field, spec), bounded in zip(parts, _bounded(parts), strict=True):
        text += re.escape(literal)
        if field is not None and bounded:
            text += rf"(-[0-9]{{{_width(spec) - 1}}}|[0-9]{{{_width(spec)}}})"
        elif field is not None:
            text += rf"(-?[0-9]{{1,{MOST_DIGITS}}}+)"
    return re.compile(text)


def _match(
    regex: re.Pattern[str], parts: tuple[_Part, ...], name: str, values: Mapping[str, int]
) -> dict[str, int] | None:
    match = regex.fullmatch(name)
    if match is None:
        return None
    found = dict(values)
    fields = [(field, spec) for _, field, spec in parts if field is not None]
    for (field, spec), digits in zip(fields, match.groups(), strict=True):
        if digits == "-":
            return None
        value = int(digits)
        if (spec and format(value, spec) != digits) or found.setdefault(field, value) != value:
            return None
    return found
