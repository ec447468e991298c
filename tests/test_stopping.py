"""Signals end a command with one line and the shell's exit code, and the next one at once."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from leafflow_ti.cli import main as cli
from leafflow_ti.errors import Interrupted
from leafflow_ti.stopping import ended_at_once, stoppable

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


@pytest.fixture(autouse=True)
def usual() -> Iterator[None]:
    """Handlers as Python sets them, before and after."""
    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def handlers() -> tuple[Any, Any]:
    return signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)


def raised(number: signal.Signals) -> None:
    """Send a signal to this process, and let the handler run."""
    os.kill(os.getpid(), number)
    for _ in range(1000):
        time.sleep(0.001)
    raise AssertionError("no handler raised anything")


def raised_and_lost(number: signal.Signals) -> None:
    """The same in foreign code that makes an error of its own of every exception."""
    try:
        raised(number)
    except BaseException as error:
        raise ValueError("compilation failed") from error


class Raising:
    """Hit by a signal while it is removed, where exceptions go no further."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number

    def __del__(self) -> None:
        raised(self.number)


def raised_in_a_destructor(number: signal.Signals) -> None:
    """The same in code that Python itself calls."""
    thing = Raising(number)
    del thing
    time.sleep(60)


@pytest.mark.parametrize("command", [raised, raised_and_lost, raised_in_a_destructor])
@pytest.mark.parametrize(
    ("number", "line", "code"),
    [(signal.SIGINT, "error: interrupted\n", 130), (signal.SIGTERM, "error: terminated\n", 143)],
)
def test_signals_are_one_line_and_a_code(
    command: Callable[[signal.Signals], None], number: signal.Signals, line: str, code: int,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, "leafflow_ti.cli.stopped", SimpleNamespace(info=lambda: command(number)))
    monkeypatch.setitem(cli.COMMANDS, "info", ("stopped:info", "Is stopped."))
    before = handlers()
    with pytest.raises(SystemExit) as end:
        cli.main(["info"])
    assert end.value.code == code
    assert capsys.readouterr().err == line
    assert handlers() == before


def test_the_second_signal_ends_the_process() -> None:
    with stoppable() as stop:
        with pytest.raises(Interrupted):
            raised(signal.SIGTERM)
        assert stop.number == signal.SIGTERM
        assert handlers() == (signal.SIG_DFL, signal.SIG_DFL)
        with ended_at_once():
            pass
        assert handlers() == (signal.SIG_DFL, signal.SIG_DFL)


def test_signals_end_foreign_calls_of_the_command_line_alone() -> None:
    before = handlers()
    with ended_at_once():  # a host's process is not ours to end
        assert handlers() == before
    with stoppable() as stop:
        with ended_at_once():
            assert handlers() == (signal.SIG_DFL, signal.SIG_DFL)
        assert handlers() == (stop.handle, stop.handle)
        with contextlib.suppress(RuntimeError), ended_at_once():
            raise RuntimeError
        assert handlers() == (stop.handle, stop.handle)
    assert handlers() == before


def test_what_is_ignored_stays_ignored() -> None:
    """As under ``nohup``, or in the background of a script."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with stoppable() as stop:
        assert handlers() == (signal.SIG_IGN, stop.handle)
        with ended_at_once():
            assert handlers() == (signal.SIG_IGN, signal.SIG_DFL)


def test_threads_leave_signals_alone() -> None:
    before, found = handlers(), []

    def work() -> None:
        with stoppable(), ended_at_once():
            found.append(handlers())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [before]


def test_the_end_of_a_process_is_not_disturbed() -> None:
    with stoppable(whole_process=True):
        pass
    assert handlers() == (signal.SIG_IGN, signal.SIG_IGN)


WAITING = """
import sys, time, types
from leafflow_ti.cli import main as cli

def info():
    print("ready", flush=True)
    time.sleep(60)

sys.modules["leafflow_ti.cli.waiting"] = types.SimpleNamespace(info=info)
cli.COMMANDS["info"] = ("waiting:info", "Waits.")
sys.argv = ["leafflow-ti", "info"]
cli.main()
"""


def test_a_process_that_is_interrupted() -> None:
    """Ctrl-C on a terminal: the whole group gets the signal."""
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    os.killpg(process.pid, signal.SIGINT)
    _, text = process.communicate(timeout=60)
    assert (process.returncode, text) == (130, "error: interrupted\n")
