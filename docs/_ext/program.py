"""Directives that show the program as it is: its commands with their help, and its public Python names."""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import re
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import leafflow_ti
from leafflow_ti import backend
from leafflow_ti.cli.main import COMMANDS, invoke


def help_of(*words: str) -> str:
    """What the command line ``words --help`` prints, 80 columns wide."""
    os.environ["COLUMNS"] = "80"
    with contextlib.redirect_stdout(io.StringIO()) as out:
        invoke([*words, "--help"])
    return out.getvalue()


def commands() -> Iterator[tuple[str, ...]]:
    """Every command that does something, subcommands as ``("simulate", "plane")``."""
    for name in COMMANDS:
        _, found, below = help_of(name).partition("\nCommands:\n")
        yield from ((name, sub) for sub in re.findall(r"^  (\S+)", below, re.MULTILINE)) if found else ((name,),)


class Commands(SphinxDirective):
    """``{commands}``: a section with its help for each command."""

    def run(self) -> list[nodes.Node]:
        """The sections."""
        self.env.note_reread()  # the program may change without the page
        return [self._section(words) for words in commands()]

    def _section(self, words: tuple[str, ...]) -> nodes.section:
        title = " ".join(words)
        section = nodes.section("", nodes.title("", title), ids=[nodes.make_id(title)], names=[title])
        section += nodes.literal_block("", help_of(*words).strip(), language="text")
        self.state.document.note_implicit_target(section)
        return section


class PublicNames(SphinxDirective):
    """``{public-names} functions`` or ``classes``: the documentation of all of these that the package offers."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The documentation of the names in alphabetical order."""
        self.env.note_reread()
        classes = {"functions": False, "classes": True}[self.arguments[0]]
        entry = ".. autoclass:: leafflow_ti.{}\n   :members:\n" if classes else ".. autofunction:: leafflow_ti.{}\n"
        names = (name for name in sorted(leafflow_ti.__all__) if inspect.isclass(getattr(leafflow_ti, name)) is classes)
        return self.parse_text_to_nodes("```{eval-rst}\n" + "\n".join(map(entry.format, names)) + "```\n")


class BackendNames(SphinxDirective):
    """``{backend-names}``: the documentation of all functions of ``leafflow_ti.backend``."""

    def run(self) -> list[nodes.Node]:
        """The documentation of the names in alphabetical order."""
        self.env.note_reread()
        found = [name for name in sorted(backend.__all__) if not inspect.isclass(getattr(backend, name))]
        entries = (f".. autofunction:: leafflow_ti.backend.{name}\n" for name in found)
        return self.parse_text_to_nodes("```{eval-rst}\n" + "\n".join(entries) + "```\n")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("commands", Commands)
    app.add_directive("public-names", PublicNames)
    app.add_directive("backend-names", BackendNames)
    return {"parallel_read_safe": True}
