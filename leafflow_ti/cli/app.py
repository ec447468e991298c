"""The group of all commands, each loaded when it is called."""

from __future__ import annotations

import importlib
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from leafflow_ti import __version__
from leafflow_ti.cli.log import warnings_shown
from leafflow_ti.cli.main import COMMANDS


class Left(BaseException):
    """A command was interrupted."""

    def __init__(self, interrupt: KeyboardInterrupt) -> None:
        super().__init__(interrupt)
        self.interrupt = interrupt


class _LazyGroup(TyperGroup):
    """A group whose commands are placeholders with a line of help until one of them is called."""

    def __init__(self, **attrs: Any) -> None:
        super().__init__(**attrs)
        for name, (_, line) in COMMANDS.items():
            self.add_command(TyperCommand(name, help=line, short_help=line, rich_markup_mode=None))

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as interrupt:
            raise Left(interrupt) from None  # typer would make an exit code of it, without a word

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, placeholder, rest = super().resolve_command(ctx, args)
        return name, placeholder if name is None else _load(name), rest


def _load(name: str) -> Any:
    module_name, _, attribute = COMMANDS[name][0].partition(":")
    found = getattr(importlib.import_module(f"leafflow_ti.cli.{module_name}"), attribute)
    if isinstance(found, typer.Typer):
        app = found
    else:
        app = typer.Typer(add_completion=False, rich_markup_mode=None)
        app.command(name, no_args_is_help=False)(found)
    return typer.main.get_command(app)


def _show_version(value: bool) -> None:
    if value:
        typer.echo(f"leafflow-ti {__version__}")
        raise typer.Exit


def make_app() -> typer.Typer:
    # Rich costs more than the rest of the start together, and completion adds two options to every help page.
    app = typer.Typer(
        cls=_LazyGroup,
        name="leafflow-ti",
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        epilog="First look: leafflow-ti demo. Help on a command: leafflow-ti run --help.",
    )

    @app.callback()
    def root(
        version: Annotated[
            bool, typer.Option("--version", help="Print the version and exit.", callback=_show_version, is_eager=True)
        ] = False,
    ) -> None:
        """Dense depth, surface normals and 3D motion with error bars from camera-grid image sequences."""

    return app


def run(args: list[str] | None) -> None:
    """Run a command line as a program does: usage errors are printed, and it ends in ``SystemExit``.

    Raises LeafflowError, KeyboardInterrupt, and what nobody expects.
    """
    try:
        with warnings_shown():
            make_app()(args, prog_name="leafflow-ti")
    except Left as left:
        raise left.interrupt from None


def invoke(args: list[str]) -> None:
    """Run one command line in this process; errors are raised, not printed, and so is an exit code other than 0."""
    try:
        code = make_app()(args, prog_name="leafflow-ti", standalone_mode=False)
    except Left as left:
        raise left.interrupt from None
    if code:
        raise typer.Exit(code)
