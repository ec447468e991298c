"""The command line as a whole: help, errors of one line, exit codes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer

from leafflow_ti import __version__, errors
from leafflow_ti.cli import main as cli


def call(*args: object) -> int:
    """Exit code of one command line."""
    with pytest.raises(SystemExit) as end:
        cli.main([str(arg) for arg in args])
    code = end.value.code
    return code if isinstance(code, int) else 0


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--help") == 0
    text = capsys.readouterr().out
    assert all(f"\n  {name} " in text for name in cli.COMMANDS)
    measuring, derived = {"run", "evaluate", "profile", "demo"}, {"growth", "track", "regions", "export", "report"}
    assert set(cli.COMMANDS) == measuring | derived | {"simulate", "plan-rig", "check", "info"}


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(command, "--help") == 0
    assert f"Usage: leafflow-ti {command}" in capsys.readouterr().out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--version") == 0
    assert capsys.readouterr().out == f"leafflow-ti {__version__}\n"


def test_entry_point_and_module_are_the_same_program() -> None:
    script = Path(sys.executable).with_name("leafflow-ti")
    for command in ([str(script)], [sys.executable, "-m", "leafflow_ti.cli.main"]):
        done = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
        assert done.stdout == f"leafflow-ti {__version__}\n"


def test_usage_errors_exit_with_2_and_suggest(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("rnu") == 2
    assert "'run'" in capsys.readouterr().err
    assert call("run") == 2
    assert "CAPTURE" in capsys.readouterr().err
    assert call("run", "x", "--window", "wide") == 2
    assert call() == 2
    assert "Usage:" in "".join(capsys.readouterr())


def raising(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command ``info`` raise ``error``."""

    def fails() -> None:
        raise error

    monkeypatch.setitem(sys.modules, "leafflow_ti.cli.failing", SimpleNamespace(fails=fails))
    monkeypatch.setitem(cli.COMMANDS, "info", ("failing:fails", "Fails."))


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.UsageError, 2),
        (errors.ConfigError, 3),
        (errors.InputError, 4),
        (errors.DeviceError, 5),
        (errors.RunError, 6),
        (errors.PartlyDone, 7),
    ],
)
def test_errors_are_one_line_and_a_code(
    error: type[Exception], code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    raising(error("first line\nsecond line"), monkeypatch)
    assert call("info") == code
    assert capsys.readouterr().err == "error: first line second line\n"


def test_unexpected_errors_are_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    raising(ZeroDivisionError("by\nzero"), monkeypatch)
    monkeypatch.delenv("LEAFFLOW_TI_DEBUG", raising=False)
    assert call("info") == 6
    text = capsys.readouterr().err
    assert text.startswith("error: unexpected ZeroDivisionError: by zero (LEAFFLOW_TI_DEBUG=1")
    assert text.count("\n") == 1
    monkeypatch.setenv("LEAFFLOW_TI_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        cli.main(["info"])


def test_command_run_from_inside_raises_its_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    raising(typer.Exit(7), monkeypatch)
    with pytest.raises(typer.Exit) as caught:
        cli.invoke(["info"])
    assert caught.value.exit_code == 7
    raising(errors.InputError("absent"), monkeypatch)
    with pytest.raises(errors.InputError, match="absent"):
        cli.invoke(["info"])


def test_interrupt_exits_with_130(monkeypatch: pytest.MonkeyPatch) -> None:
    raising(KeyboardInterrupt(), monkeypatch)
    assert call("info") == 130
