"""Errors with the exit code that the command line gives them.

A message is one line that names the value, the limit and the way out.
"""

from __future__ import annotations


class LeafflowError(Exception):
    """Base of every error that a user can cause or mend; ``exit_code`` is the command line's answer."""

    exit_code = 6


class UsageError(LeafflowError):
    """An option or argument that makes no sense (exit code 2)."""

    exit_code = 2


class ConfigError(LeafflowError):
    """A run configuration that is invalid or does not fit the capture (exit code 3)."""

    exit_code = 3


class InputError(LeafflowError):
    """Missing, unreadable or inconsistent input files (exit code 4)."""

    exit_code = 4


class DeviceError(LeafflowError):
    """The asked-for compute device cannot be used (exit code 5)."""

    exit_code = 5


class RunError(LeafflowError):
    """A failure while computing or writing results (exit code 6)."""

    exit_code = 6


class PartlyDone(LeafflowError):
    """Some units failed; the run can be resumed (exit code 7)."""

    exit_code = 7


class Interrupted(KeyboardInterrupt):
    """A signal asks for the end; ``exit_code``: as shells have it. No LeafflowError: nothing has failed."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code

    @classmethod
    def advised(cls, interrupt: KeyboardInterrupt, advice: str) -> Interrupted:
        """The same, with what to do next."""
        return cls(f"{str(interrupt) or 'interrupted'}: {advice}", getattr(interrupt, "exit_code", 130))


class MissingExtra(ConfigError):
    """An optional package is needed; the message names the extra that installs it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs the package '{package}': pip install 'leafflow-ti[{extra}]'")


def one_line(error: BaseException) -> tuple[str, int]:
    """What the command line answers an error with: one line, and the exit code."""
    text = " ".join(str(error).split())
    if isinstance(error, LeafflowError):
        return text, error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return text or "interrupted", getattr(error, "exit_code", 130)
    return f"unexpected {type(error).__name__}: {text} (LEAFFLOW_TI_DEBUG=1 shows where; please report it)", 6
