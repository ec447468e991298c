"""What a command says besides its results: warnings on standard error, every event as a line of JSON in a log file."""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import logging
import math
import time
import warnings
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from leafflow_ti import __version__
from leafflow_ti.cli.options import with_parameters
from leafflow_ti.cli.progress import write_line
from leafflow_ti.errors import UsageError, one_line
from leafflow_ti.events import LOGGER, event, warn

LogFile = Annotated[
    Path | None,
    typer.Option(
        "--log-file", metavar="FILE.jsonl", help="Append every event to this file, a line of JSON each.",
        show_default=False,
    ),
]  # fmt: skip


def with_log_file(command: Callable[..., None]) -> Callable[..., None]:
    """Decorator: gives a command ``--log-file``; how it ends, whatever that is, is the last line of the file."""
    name = command.__name__

    @functools.wraps(command)
    def wrapper(*, log_file: Path | None, **values: Any) -> None:
        if log_file is None:
            command(**values)
        else:
            with logged(log_file, name):
                command(**values)

    own = inspect.signature(command, eval_str=True).parameters.values()
    return with_parameters(wrapper, own, {"log_file": LogFile})


@contextlib.contextmanager
def logged(path: Path, command: str) -> Iterator[None]:
    """Every event of the block goes to a log file, between the event ``command`` and one that says how it ended:
    ``end``, ``error`` or ``interrupted``, with the exit code.

    Raises UsageError, before anything is done, when the file cannot be written or is no log file.
    """
    lines = _JsonLines(path)
    level = LOGGER.level
    LOGGER.addHandler(lines)
    LOGGER.setLevel(logging.INFO)
    began = time.perf_counter()

    def ended(name: str, message: str, level: int, exit_code: int) -> None:
        event(name, message, level, exit_code=exit_code, seconds=round(time.perf_counter() - began, 3))

    try:
        event("command", f"leafflow-ti {command}", version=__version__)
        yield
        ended("end", "done", logging.INFO, 0)
    except typer.Exit as end:
        ended("end", "done", logging.INFO, end.exit_code)
        raise
    except KeyboardInterrupt as interrupt:
        ended("interrupted", *_said(interrupt))
        raise
    except Exception as error:
        ended("error", *_said(error))
        raise
    finally:
        LOGGER.setLevel(level)
        LOGGER.removeHandler(lines)
        lines.close()


def _said(error: BaseException) -> tuple[str, int, int]:
    message, code = one_line(error)
    return message, logging.ERROR, code


class _JsonLines(logging.Handler):
    """Appends records to a file. A line is one write, so that a kill loses none and several jobs may share a file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        try:
            if path.is_file() and path.stat().st_size:
                with path.open("rb") as file:
                    if file.read(1) != b"{":
                        raise UsageError(f"--log-file {path}: exists and is no log file; give another name")
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise UsageError(f"--log-file {path}: cannot be written ({error.strerror}); give another name") from None

    def emit(self, record: logging.LogRecord) -> None:
        if self._file.closed:
            return
        head = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": getattr(record, "event", "log"),
            "message": record.getMessage(),
        }
        text = json.dumps({**head, **_plain(getattr(record, "facts", {})), **head}, ensure_ascii=False)
        try:
            self._file.write(f"{text}\n".encode(errors="backslashreplace"))  # of names of files that are no UTF-8
        except OSError as error:
            self._file.close()
            warn(f"--log-file {self._path}: cannot be written any more ({error.strerror}), so the log ends here")

    def close(self) -> None:
        self._file.close()
        super().close()


def _plain(value: Any) -> Any:
    """A fact as JSON has it: numbers that are not finite are null, other objects their text."""
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


@contextlib.contextmanager
def warnings_shown() -> Iterator[None]:
    """Warnings of the block go to standard error, each once; those of the module ``warnings`` are events like ours."""
    handler, before = _WarningLines(), warnings.showwarning
    LOGGER.addHandler(handler)

    def show(message: Warning | str, category: type[Warning], *_where: Any, **_more: Any) -> None:
        warn(f"{category.__name__}: {message}")

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = before
        LOGGER.removeHandler(handler)


class _WarningLines(logging.Handler):
    """Writes what a user must see while a command works as lines of their own; ``error:`` is left to its end."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._said: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        text = " ".join(record.getMessage().split())
        ends = getattr(record, "event", None) in ("error", "interrupted")
        if not ends and text not in self._said:
            self._said.add(text)
            write_line(f"warning: {text}")
