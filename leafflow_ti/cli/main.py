"""The command line: one table of commands, each loaded when it is called, and one place where errors become exit codes.

Codes: 0 ok, 2 usage, 3 configuration, 4 input, 5 device, 6 runtime, 7 partly done, 130 interrupted.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from leafflow_ti import __version__
from leafflow_ti.errors import LeafflowError

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": (
        "demo:demo",
        "Simulate a rotating cube, measure it, compare with the truth, write a report: no input needed.",
    ),
    "simulate": ("simulate:app", "Write a synthetic capture with its exact truth (plane, cube, leaf, leaves)."),
    "run": ("run:run", "Measure depth, normals and 3D motion of a capture."),
    "growth": ("growth:growth", "Measure growth and strain from the motion in a results store."),
    "evaluate": ("evaluate:evaluate", "Compare results with a known truth."),
    "track": ("track:track", "Follow points through the frames; growth and strain since the start."),
    "export": ("export:export", "Write results for Fiji, ParaView, MATLAB, R and other programs."),
    "regions": ("regions:regions", "Measure each leaf of a label image: area, motion, growth per hour, diel curve."),
    "profile": ("profile:profile", "Measure the stages of a run on this machine, and predict the whole."),
    "check": ("check:check", "Say whether a capture can be measured, and what to change."),
    "plan-rig": ("plan_rig:plan_rig", "Predict the standard errors of a camera rig, and what would improve it most."),
    "report": ("report:report", "Write one HTML page of results: maps, curves, quality, the surface in 3D."),
    "info": ("info:info", "Say what a capture, or a results store, is."),
}
"""Command -> where it lives (module of this package:object) and its line in the help."""


class _LazyGroup(TyperGroup):
    """A group whose commands are placeholders with a line of help until one of them is called."""

    def __init__(self, **attrs: Any) -> None:
        super().__init__(**attrs)
        for name, (_, line) in COMMANDS.items():
            self.add_command(TyperCommand(name, help=line, short_help=line, rich_markup_mode=None))

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


def _app() -> typer.Typer:
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


def invoke(args: list[str]) -> None:
    """Run one command line in this process; errors are raised, not printed, and so is an exit code other than 0."""
    code = _app()(args, prog_name="leafflow-ti", standalone_mode=False)
    if code:
        raise typer.Exit(code)


def main(args: list[str] | None = None) -> None:
    """Run the command line with ``args`` (default: those of the process); always ends in ``SystemExit``."""
    try:
        _app()(args, prog_name="leafflow-ti")
    except LeafflowError as error:
        _fail(str(error), error.exit_code)
    except KeyboardInterrupt:
        _fail("interrupted", 130)
    except Exception as error:
        if os.environ.get("LEAFFLOW_TI_DEBUG") == "1":
            raise
        text = " ".join(str(error).split())
        _fail(f"unexpected {type(error).__name__}: {text} (LEAFFLOW_TI_DEBUG=1 shows where; please report it)", 6)


def _fail(message: str, code: int) -> None:
    sys.stdout.flush()
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)


if __name__ == "__main__":
    main()
