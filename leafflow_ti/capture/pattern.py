"""File name patterns with numbered fields, e.g. ``cam_{sx:02d}/frame_{t:02d}.tif``: formatting and discovery."""

from __future__ import annotations

import os
import re
import string
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

AXES = ("t", "sy", "sx")
"""Axes of a capture above ``y`` and ``x``, slowest first."""
FIELDS = (*AXES, "i")

_Part = tuple[str, str | None, str]  # literal text, then a field or None, and its format


@dataclass(frozen=True)
class Pattern:
    """A path in which fields stand for whole numbers.

    A field with a format (``{t:03d}``) matches just the names which that format writes, one without (``{t}``) any
    digits. A field may occur several times; its values must then agree.
    """

    text: str
    components: tuple[tuple[_Part, ...], ...]

    @classmethod
    def parse(cls, text: str) -> Pattern:
        """Split a pattern; raises ValueError for an unknown field or a format other than ``d`` and ``0Nd``."""
        if not text:
            raise ValueError("the file name is empty")
        components = tuple(_parts(component) for component in Path(text).parts)
        return cls(text, components)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields, each once, in order of appearance."""
        return tuple(dict.fromkeys(field for parts in self.components for _, field, _ in parts if field is not None))

    def format(self, values: Mapping[str, int]) -> str:
        """The path for given values."""
        return str(Path(*(_format(parts, values) for parts in self.components)))

    def discover(self, root: Path) -> list[tuple[dict[str, int], Path]]:
        """Files that fit, with their values; paths sorted. Only names with fields are looked up on disk."""
        return sorted(self._walk(root, 0, {}), key=lambda found: str(found[1]))

    def _walk(self, folder: Path, depth: int, values: dict[str, int]) -> Iterator[tuple[dict[str, int], Path]]:
        if depth == len(self.components):
            yield values, folder
            return
        parts = self.components[depth]
        if all(field is None or field in values for _, field, _ in parts) and not _free(parts):
            yield from self._walk(folder / _format(parts, values), depth + 1, values)
            return
        regex = _regex(parts)
        try:
            names = [entry.name for entry in os.scandir(folder)]
        except (FileNotFoundError, NotADirectoryError):
            return
        for name in names:
            found = _match(regex, parts, name, values)
            if found is not None:
                yield from self._walk(folder / name, depth + 1, found)


def _parts(component: str) -> tuple[_Part, ...]:
    result: list[_Part] = []
    for literal, field, spec, conversion in string.Formatter().parse(component):
        if field is not None:
            if field not in FIELDS or conversion:
                raise ValueError(f"field '{{{field}}}' is unknown, the fields are {', '.join(FIELDS)}")
            if not re.fullmatch(r"(0[1-9]\d*)?d|", spec or ""):
                raise ValueError(f"format '{spec}' of field {field} must be d or 0Nd, e.g. {{{field}:03d}}")
        result.append((literal, field, spec or ""))
    return tuple(result)


def _free(parts: tuple[_Part, ...]) -> bool:
    """Whether a field has no format, so that its digits must be looked up even when its value is known."""
    return any(field is not None and not spec for _, field, spec in parts)


def _format(parts: tuple[_Part, ...], values: Mapping[str, int]) -> str:
    return "".join(
        literal + ("" if field is None else format(values[field], spec or "d")) for literal, field, spec in parts
    )


def _regex(parts: tuple[_Part, ...]) -> re.Pattern[str]:
    return re.compile(
        "".join(re.escape(literal) + ("" if field is None else r"(-?\d+)") for literal, field, _ in parts)
    )


def _match(
    regex: re.Pattern[str], parts: tuple[_Part, ...], name: str, values: Mapping[str, int]
) -> dict[str, int] | None:
    match = regex.fullmatch(name)
    if match is None:
        return None
    found = dict(values)
    fields = [(field, spec) for _, field, spec in parts if field is not None]
    for (field, spec), digits in zip(fields, match.groups(), strict=True):
        value = int(digits)
        if (spec and format(value, spec) != digits) or found.setdefault(field, value) != value:
            return None
    return found
