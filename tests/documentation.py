"""The blocks of the documentation's pages, and how each kind of them is tried out."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leafflow_ti.capture.description import Description, read_description
from leafflow_ti.cli.main import invoke
from leafflow_ti.config import load_config
from perf.cases import find

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = tuple(sorted((ROOT / "docs").glob("*.md")))

NOT_RUN = {
    "git": "fetches the project itself, which is here already",
    "cd": "goes into what git has fetched",
    "pip": "changes the environment that the tests run in",
    "napari": "opens a window and is not installed with the project",
}
"""Programs that a page may call and no test does, with the reason."""

SHOWN_ONLY = {
    "r": "R is not installed with the project",
    "matlab": "neither is MATLAB",
    "text": "no language: layouts of folders, lines of files",
    "bibtex": "a citation",
}
"""Languages of blocks that are not tried out, with the reason."""

_FENCE = re.compile(r"^```([^\n`]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(%?)$", re.IGNORECASE)
TOLERANCE = 0.02
"""Of shown numbers, relative: machines and seeds of compilers differ in the last digits of what is measured."""
ERROR_TOLERANCE = 0.3
"""Of the number behind ±, relative: a standard error is known that well."""


@dataclass(frozen=True)
class Block:
    """A fenced block: its language (``""`` without one; directives are ``{name}``), text and first line in the page."""

    language: str
    text: str
    line: int


@dataclass(frozen=True)
class Call:
    """A command line and the lines of output that the page shows below it."""

    words: tuple[str, ...]
    shown: tuple[str, ...]
    line: int


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [Block(m[1].strip(), m[2], text[: m.start()].count("\n") + 2) for m in _FENCE.finditer(text)]


def calls(block: Block) -> Iterator[Call]:
    """The command lines of a block: those behind ``$``, or every line of a block without a language."""
    lines: list[tuple[int, str]] = []
    for number, text in enumerate(block.text.splitlines(), block.line):
        if lines and lines[-1][1].endswith("\\"):
            begin, before = lines[-1]
            lines[-1] = (begin, before[:-1] + text)
        else:
            lines.append((number, text))
    if not block.language:
        lines = [(number, f"$ {part}") for number, line in lines for part in line.split(" && ")]
    starts = [at for at, (_, line) in enumerate(lines) if line.startswith("$ ")]
    for at, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        number, line = lines[at]
        shown = tuple(text for _, text in lines[at + 1 : end] if text.strip())
        words = tuple(shlex.split(line[2:], comments=True))
        if words:
            yield Call(words, shown, number)


class Session:
    """One folder in which pages are tried out; each sees the files of those before it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._tried: set[Path] = set()

    def try_out(self, page: Path) -> None:
        """Run what the page shows, in order; once, however often it is asked for. AssertionError names the line."""
        if page in self._tried:
            return
        self._tried.add(page)
        names: dict[str, Any] = {}
        with contextlib.chdir(self.folder):
            for block in blocks(page):
                place = f"{page.name}, line {block.line}"
                if block.language in ("console", ""):
                    for call in calls(block):
                        run_call(call, f"{page.name}, line {call.line}")
                elif block.language == "python":
                    with contextlib.redirect_stdout(io.StringIO()):
                        exec(compile(block.text, place, "exec"), names)
                elif block.language == "toml":
                    check_toml(block.text, self.folder)
                else:
                    directive = block.language.startswith("{")
                    assert directive or block.language in SHOWN_ONLY, f"{place}: nobody tries out {block.language!r}"


def run_call(call: Call, place: str) -> None:
    """Run a command line in this process and compare its output with what the page shows."""
    program, *arguments = call.words
    if program == "leafflow-ti":
        with contextlib.redirect_stdout(io.StringIO()) as out:
            invoke(arguments)
        compare(call.shown, out.getvalue(), place)
    elif call.words[:3] == ("python", "-m", "perf"):  # they take minutes each: that they exist is all that is tried
        unknown = [name for name in call.words[3:] if not name.startswith("-") and find(name) is None]
        assert not unknown, f"{place}: there is no case {unknown}"
    elif program == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        assert re.search(rf"^{re.escape(arguments[0])}:", makefile, re.MULTILINE), f"{place}: no target {arguments[0]}"
    else:
        assert program in NOT_RUN, f"{place}: nobody tries out {program!r}"


def compare(shown: tuple[str, ...], output: str, place: str) -> None:
    """Every shown line is one of the output, in the same order (``agree``); … is anything."""
    rest = iter(output.splitlines())
    for line in shown:
        assert line.strip() == "…" or any(agree(line, real) for real in rest), (
            f"{place}: the output has no line\n{line}\nwhere the page shows it; it is\n{output}"
        )


def agree(shown: str, real: str) -> bool:
    """Whether a line of output is the one shown: numbers agree within the tolerances, … is any words."""
    return _agree(shown.split(), real.split(), TOLERANCE)


def _agree(shown: list[str], real: list[str], tolerance: float) -> bool:
    if not shown:
        return not real
    if shown[0] == "…":
        return any(_agree(shown[1:], real[n:], TOLERANCE) for n in range(len(real) + 1))
    if not real or not _same(shown[0], real[0], tolerance):
        return False
    return _agree(shown[1:], real[1:], ERROR_TOLERANCE if shown[0] == "±" else TOLERANCE)


def _same(shown: str, real: str, tolerance: float) -> bool:
    if shown == real:
        return True
    numbers = _NUMBER.match(shown), _NUMBER.match(real)
    if not (numbers[0] and numbers[1] and numbers[0][2] == numbers[1][2]):
        return False
    expected, found = (float(number[1]) for number in numbers)
    return abs(expected - found) <= tolerance * abs(expected)


def check_toml(text: str, folder: Path) -> None:
    """Read a ``capture.toml``, or a part of one, or a ``run.toml`` as the program does."""
    path = folder / f"block-{os.getpid()}.toml"
    sections = tomllib.loads(text)
    if sections.keys() <= Description.model_fields.keys():
        images = "" if "images" in sections else '[images]\npattern = "{t}.tif"\n'
        path.write_text(images + text, encoding="utf-8")
        read_description(path)
    else:
        path.write_text(text, encoding="utf-8")
        load_config(path)
    path.unlink()
