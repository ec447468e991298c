"""The command line: one table of commands, and one place where errors and signals become one line and an exit code.

Codes: 0 ok, 2 usage, 3 configuration, 4 input, 5 device, 6 runtime, 7 partly done, 130 interrupted, 143 terminated.
"""

from __future__ import annotations

import contextlib
import os
import sys

from leafflow_ti.errors import LeafflowError, one_line
from leafflow_ti.stopping import stoppable

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


def invoke(args: list[str]) -> None:
    """Run one command line in this process; errors are raised, not printed, and so is an exit code other than 0."""
    from leafflow_ti.cli import app

    app.invoke(args)


def main(args: list[str] | None = None) -> None:
    """Run the command line with ``args`` (default: those of the process); always ends in ``SystemExit``."""
    _open_streams()
    with stoppable(whole_process=args is None) as stop:  # before all that takes time to import
        try:
            from leafflow_ti.cli import app

            app.run(args)
        except BaseException as error:
            # Foreign code may have made another error of an interrupt, or of the error that followed it.
            if stop.number is not None and not isinstance(error, KeyboardInterrupt):
                error = stop.interrupt()
            if isinstance(error, SystemExit):
                raise
            if not isinstance(error, LeafflowError | KeyboardInterrupt) and os.environ.get("LEAFFLOW_TI_DEBUG") == "1":
                raise
            message, code = one_line(error)
            _say(f"error: {message}")
            if args is None and isinstance(error, KeyboardInterrupt):
                os._exit(code)  # the engine's own end can take ten seconds when it is cut short
            sys.exit(code)


def _open_streams() -> None:
    """Streams that whoever started this process has closed lead nowhere."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123 - until the end


def _say(line: str) -> None:
    """Print the last line, after all that was written before."""
    from leafflow_ti.cli.progress import end_line

    with contextlib.suppress(OSError):  # nobody reads it any more, or it is full: that may be the very error
        sys.stdout.flush()
    with contextlib.suppress(OSError):
        end_line()
        print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
