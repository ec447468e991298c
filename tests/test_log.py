"""``--log-file``: every event a line of JSON, the last one says how it ended; and warnings on standard error."""

from __future__ import annotations

import io
import json
import logging
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from test_cli import call

from leafflow_ti import __version__, errors, events
from leafflow_ti.cli import main as cli
from leafflow_ti.cli.log import logged, with_log_file
from leafflow_ti.cli.progress import RewrittenLine, counted, write_line


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def does(work: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command ``info`` do this, and log it where it is asked to."""

    def info() -> None:
        work()

    monkeypatch.setitem(sys.modules, "leafflow_ti.cli.working", SimpleNamespace(info=with_log_file(info)))
    monkeypatch.setitem(cli.COMMANDS, "info", ("working:info", "Works."))


def some_events() -> None:
    events.event("unit", "unit 3 is done", unit=3, rows=[0, 40], seconds=0.25)
    events.warn("baseline 0.5 m: is that millimetres?", baseline_mm=float("nan"), path=Path("a") / "b")


# --- the file --------------------------------------------------------------------------------------------------------


def test_every_event_is_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    does(some_events, monkeypatch)
    before = datetime.now(UTC) - timedelta(milliseconds=1)
    assert call("info", "--log-file", tmp_path / "run.jsonl") == 0
    begin, unit, warning, end = lines_of(tmp_path / "run.jsonl")
    assert list(unit) == ["time", "level", "event", "message", "unit", "rows", "seconds"]
    assert unit == {
        "time": unit["time"], "level": "info", "event": "unit", "message": "unit 3 is done",
        "unit": 3, "rows": [0, 40], "seconds": 0.25,
    }  # fmt: skip
    assert (warning["level"], warning["event"]) == ("warning", "warning")
    assert (warning["baseline_mm"], warning["path"]) == (None, str(Path("a") / "b"))
    assert (begin["event"], begin["message"], begin["version"]) == ("command", "leafflow-ti info", __version__)
    assert (end["event"], end["level"], end["exit_code"]) == ("end", "info", 0)
    stamps = [datetime.fromisoformat(line["time"]) for line in (begin, unit, warning, end)]
    assert stamps == sorted(stamps)
    assert before <= stamps[0] <= stamps[-1] <= datetime.now(UTC)
    assert all(stamp.utcoffset() == timedelta(0) for stamp in stamps)


def test_the_next_run_is_appended_and_leaves_the_logger_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handlers, level = list(events.LOGGER.handlers), events.LOGGER.level
    does(some_events, monkeypatch)
    for n in (1, 2):
        assert call("info", "--log-file", tmp_path / "run.jsonl") == 0
        assert [line["event"] for line in lines_of(tmp_path / "run.jsonl")] == ["command", "unit", "warning", "end"] * n
    assert (events.LOGGER.handlers, events.LOGGER.level) == (handlers, level)


@pytest.mark.parametrize(
    ("error", "code", "name", "message"),
    [
        (errors.InputError("a.tif:\nends early"), 4, "error", "a.tif: ends early"),
        (errors.PartlyDone("2 of 9 units are missing"), 7, "error", "2 of 9 units are missing"),
        (ZeroDivisionError("by zero"), 6, "error", "unexpected ZeroDivisionError: by zero (LEAFFLOW_TI_DEBUG=1 shows"),
        (KeyboardInterrupt(), 130, "interrupted", "interrupted"),
        (typer.Exit(7), 7, "end", "done"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_how_it_ended_is_the_last_line(
    error: BaseException, code: int, name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def fails() -> None:
        raise error

    does(fails, monkeypatch)
    monkeypatch.delenv("LEAFFLOW_TI_DEBUG", raising=False)
    assert call("info", "--log-file", tmp_path / "run.jsonl") == code
    last = lines_of(tmp_path / "run.jsonl")[-1]
    assert (last["event"], last["exit_code"]) == (name, code)
    assert last["message"].startswith(message)
    assert capsys.readouterr().err == ("" if name == "end" else f"error: {last['message']}\n")  # once


@pytest.mark.parametrize("command", ["run", "growth", "track", "regions"])
def test_commands_that_log_say_what_stopped_them(command: str, tmp_path: Path) -> None:
    more = {"track": ["-o", tmp_path / "t.csv"], "regions": ["--labels", "l.tif", "-o", tmp_path / "t.csv"]}
    more["run"] = ["-o", tmp_path / "out.zarr"]
    arguments = [tmp_path / "absent", *more.get(command, [])]
    assert call(command, *arguments, "--log-file", tmp_path / "log") == 4
    begin, end = lines_of(tmp_path / "log")
    assert begin["message"] == f"leafflow-ti {command}"
    assert str(tmp_path / "absent") in end["message"]
    assert end["exit_code"] == 4


KILLED = """
import os, signal, sys
from pathlib import Path
from leafflow_ti.cli.log import logged
from leafflow_ti.events import event
with logged(Path(sys.argv[1]), "run"):
    event("unit", "unit 0 is done")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is a POSIX signal")
def test_a_kill_loses_no_line(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "log")], check=False)
    assert done.returncode < 0
    assert [line["event"] for line in lines_of(tmp_path / "log")] == ["command", "unit"]


def test_no_name_breaks_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events.LOGGER, "propagate", False)  # what pytest captures travels as UTF-8
    name = os.fsdecode(b"caf\xe9\n") + "µ.tif"  # no UTF-8, and a new line
    with logged(tmp_path / "log", "run"):
        events.warn(f"{name} is dark", event="not the name of an event", image=name)
    warning = lines_of(tmp_path / "log")[1]
    assert (warning["image"], warning["message"], warning["event"]) == (name, f"{name} is dark", "warning")


def test_what_is_no_log_file_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worked: list[int] = []
    does(lambda: worked.append(1), monkeypatch)
    other = tmp_path / "capture.toml"
    other.write_text("[images]\n")
    assert call("info", "--log-file", other) == 2
    assert other.read_text() == "[images]\n"
    assert call("info", "--log-file", tmp_path) == 2
    assert call("info", "--log-file", tmp_path / "absent" / "log") == 2
    assert worked == []


def test_an_unwritable_file_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    does(some_events, monkeypatch)
    assert call("info", "--log-file", tmp_path / "absent" / "log") == 2
    path = tmp_path / "absent" / "log"
    said = f"error: --log-file {path}: cannot be written (No such file or directory); give another name\n"
    assert capsys.readouterr().err == said


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is always full")
def test_a_full_disk_ends_the_log_and_not_the_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    does(some_events, monkeypatch)
    assert call("info", "--log-file", "/dev/full") == 0
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("warning: --log-file /dev/full: cannot be written any more (No space left on device)")
    assert second == "warning: baseline 0.5 m: is that millimetres?"


def test_several_runs_share_a_file(tmp_path: Path) -> None:
    with logged(tmp_path / "log", "run"), logged(tmp_path / "log", "run"):
        events.event("unit", "x" * 100_000)
    assert [line["event"] for line in lines_of(tmp_path / "log")].count("unit") == 2


# --- standard error --------------------------------------------------------------------------------------------------


def test_warnings_are_said_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def work() -> None:
        for _ in range(3):
            events.warn("images are\ndark")
        events.event("quarantine", "unit 3 is given up", logging.ERROR)
        events.event("unit", "unit 4 is done")

    does(work, monkeypatch)
    assert call("info") == 0
    assert capsys.readouterr().err == "warning: images are dark\nwarning: unit 3 is given up\n"
    assert call("info") == 0
    assert capsys.readouterr().err.count("dark") == 1


def test_python_warnings_are_events(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = warnings.showwarning

    def work() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn("invalid value", RuntimeWarning, stacklevel=1)

    does(work, monkeypatch)
    assert call("info", "--log-file", tmp_path / "log") == 0
    assert capsys.readouterr().err == "warning: RuntimeWarning: invalid value\n"
    assert lines_of(tmp_path / "log")[1]["message"] == "RuntimeWarning: invalid value"
    assert warnings.showwarning is before


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(written: str) -> list[str]:
    """The lines that a terminal shows after this was written to it."""
    screen: list[str] = []
    for line in written.split("\n"):
        seen = ""
        for part in line.split("\r"):
            seen = part + seen[len(part) :]
        screen.append(seen.rstrip())
    return screen


def test_a_warning_never_lands_in_a_progress_line(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    show = counted("frame")
    assert show is not None
    show(1, 3)
    write_line("warning: dark")
    assert shown(stream.getvalue()) == ["warning: dark", "frame 1/3"]
    show(2, 3)
    assert shown(stream.getvalue()) == ["warning: dark", "frame 2/3"]
    show(3, 3)
    write_line("warning: bright")
    assert shown(stream.getvalue()) == ["warning: dark", "frame 3/3", "warning: bright", ""]


def test_an_error_comes_below_the_progress_line(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)

    def work() -> None:
        RewrittenLine(stream).show("frame 1/3")
        raise errors.RunError("disk full")

    does(work, monkeypatch)
    assert call("info") == 6
    assert shown(stream.getvalue()) == ["frame 1/3", "error: disk full", ""]
