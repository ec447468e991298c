"""The documentation is true: its commands run, its settings are all there are, its output is what is printed."""

from __future__ import annotations

import contextlib
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from documentation import PAGES, README, ROOT, Session, agree, blocks, calls
from program import commands, help_of
from pydantic import BaseModel

import leafflow_ti
from leafflow_ti.capture.description import Description
from leafflow_ti.cli.main import COMMANDS, invoke
from leafflow_ti.config import RunConfig

CONTINUES = {"opening.md": "growth.md"} | dict.fromkeys(
    ("formats.md", "models.md", "performance.md", "rig.md"), "getting-started.md"
)
"""Pages that go on with the files of another one."""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    """A folder for all pages; figures are drawn into memory."""
    before = matplotlib.get_backend()
    matplotlib.use("agg")
    yield Session(tmp_path_factory.mktemp("docs"))
    matplotlib.pyplot.close("all")
    matplotlib.use(before)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_page_shows_runs(page: Path, session: Session) -> None:
    if page.name in CONTINUES:
        session.try_out(page.with_name(CONTINUES[page.name]))
    session.try_out(page)


OWN_IMAGES = "simulate leaf own --size 240x160 --cameras 5 --frames 6 --interval-s 120 --supersampling 2"
"""What README's "your own images" and ``labels.tif`` are."""


def test_what_the_readme_shows_runs(session: Session) -> None:
    with contextlib.chdir(session.folder):
        invoke(OWN_IMAGES.split())
    Session(session.folder / "own").try_out(README)


# --- nothing is forgotten, nothing invented --------------------------------------------------------------------------


def settings(model: type[BaseModel]) -> dict[str, Any]:
    """Dotted key of every setting -> its field."""
    found: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        parts = [t for t in (field.annotation, *getattr(field.annotation, "__args__", ())) if isinstance(t, type)]
        section = next((t for t in parts if issubclass(t, BaseModel)), None)
        found |= {f"{name}.{key}": f for key, f in settings(section).items()} if section else {name: field}
    return found


def table_defaults(text: str, title: str) -> list[tuple[str, str]]:
    """Dotted keys and defaults below the heading ``title``: sections ``### `[name]```, rows ``| `key` | default |``."""
    part = text.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    section, found = "", []
    for line in part.splitlines():
        if heading := re.match(r"### (?:`\[(\w+)\]`)?", line):
            section = f"{heading[1]}." if heading[1] else ""
        elif row := re.match(r"\| `(\w+)` \|([^|]*)\|", line):
            found.append((section + row[1], row[2].strip()))
    return found


@pytest.mark.parametrize(
    ("title", "model"), [("The capture: `capture.toml`", Description), ("Settings of a run: `run.toml`", RunConfig)]
)
def test_the_reference_of_settings_is_complete(title: str, model: type[BaseModel]) -> None:
    listed = table_defaults((ROOT / "docs/formats.md").read_text(encoding="utf-8"), title)
    known = settings(model)
    assert sorted(key for key, _ in listed) == sorted(known)
    for key, default in listed:
        if code := re.fullmatch(r"`(.*)`", default):  # else it is said in words
            assert_default(key, code[1], known[key].get_default(call_default_factory=True))


def assert_default(key: str, shown: str, default: object) -> None:
    """The default in the table is that of the program; one that depends on the image or the file is None there."""
    if default is not None:
        expected = tomllib.loads(f"value = {shown}")["value"]
        assert expected == (list(default) if isinstance(default, tuple) else default), key


@pytest.mark.parametrize("page", [*PAGES, README], ids=lambda page: page.stem)
def test_options_and_commands_in_the_text_exist(page: Path) -> None:
    prose = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    code = re.findall(r"`([^`\n]+)`", prose)
    options = {found for text in code for found in re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)}
    named = {found for text in code for found in re.findall(r"^leafflow-ti ([a-z][a-z-]*)", text)}
    assert named <= set(COMMANDS)
    assert options <= known_options() | {"--quick", "--json", "--out"}  # the latter of `python -m perf`


def known_options() -> set[str]:
    """All options of all commands."""
    return {found for words in commands() for found in re.findall(r"(?<![\w-])--[a-z][a-z-]+", help_of(*words))}


def test_every_page_is_in_the_contents() -> None:
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    listed = re.findall(r"^([\w-]+)$", "".join(b.text for b in blocks(ROOT / "docs/index.md")), re.MULTILINE)
    assert sorted(listed) == sorted(page.stem for page in PAGES if page.stem != "index"), index


def test_links_of_the_readme_lead_somewhere() -> None:
    """Those of the site's pages are checked while it is built."""
    links = re.findall(r"\]\(([^)#]+)(?:#[\w-]+)?\)", README.read_text(encoding="utf-8"))
    local = [link for link in links if not link.startswith("https:")]
    assert len(local) > 10
    assert [link for link in local if not (ROOT / link).is_file()] == []


def test_public_names_have_documentation() -> None:
    assert all(getattr(leafflow_ti, name).__doc__ for name in leafflow_ti.__all__)


# --- the test's own tools --------------------------------------------------------------------------------------------


def test_shown_output_is_compared() -> None:
    assert agree("depth mm … 9.85", "depth mm 971 9.86")
    assert not agree("depth mm … 9.85", "depth mm 971 9.2")
    assert not agree("done", "done in 3 s")
    assert agree("97% ok", "98% ok")
    assert not agree("97% ok", "98 ok")
    assert agree("1.00 ± 0.10 mm", "1.01 ± 0.12 mm")
    assert not agree("1.00 ± 0.10 mm", "1.10 ± 0.12 mm")
    assert not agree("1.00 ± 0.10 mm", "1.00 ± 0.20 mm")
    assert agree("done in … s", "done in 3 s")


def test_calls_are_found_with_their_output(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    text = "text\n\n```console\n$ leafflow-ti info \\\n  a  # why\nframes 3\n\n$ make test\n```\n"
    page.write_text(text, encoding="utf-8")
    (block,) = blocks(page)
    first, second = calls(block)
    assert first.words == ("leafflow-ti", "info", "a")
    assert first.shown == ("frames 3",)
    assert second.words == ("make", "test")
    assert first.line == 4
