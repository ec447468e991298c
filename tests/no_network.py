"""``python tests/no_network.py``: command lines from standard input, in a process that the system kills when it opens
an internet socket, and that notes what else programs do behind their users' backs. Prints these notes, a line each."""

from __future__ import annotations

import ctypes
import os
import platform
import socket
import sys

SYSCALLS = {"x86_64": (0xC000003E, 41), "aarch64": (0xC00000B7, 198)}
"""Machine -> what seccomp calls it, and the number of ``socket``."""
PREFIXES = ("socket.", "pickle.", "urllib.", "ctypes.dlopen", "subprocess.", "os.system", "os.exec", "os.posix_spawn",
            "webbrowser.")  # fmt: skip
"""Audit events that are noted."""
_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _FILTER = 38, 22, 2
_LOAD, _EQUAL, _RETURN = 0x20, 0x15, 0x06
_KILL, _ALLOW = 0x80000000, 0x7FFF0000
_NUMBER, _MACHINE, _FIRST = 0, 4, 16
"""Offsets into what a filter sees: number of the call, machine, first argument."""


class _Instruction(ctypes.Structure):
    _fields_ = (("code", ctypes.c_uint16), ("yes", ctypes.c_uint8), ("no", ctypes.c_uint8), ("k", ctypes.c_uint32))


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.POINTER(_Instruction)))


def forbid_internet() -> None:
    """From now on an internet socket ends this process and its children; OSError where the system cannot do that."""
    machine, socket_call = SYSCALLS[platform.machine()]
    lines = [
        (_LOAD, 0, 0, _MACHINE), (_EQUAL, 1, 0, machine), (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, _NUMBER), (_EQUAL, 0, 4, socket_call),
        (_LOAD, 0, 0, _FIRST), (_EQUAL, 1, 0, socket.AF_INET), (_EQUAL, 0, 1, socket.AF_INET6), (_RETURN, 0, 0, _KILL),
        (_RETURN, 0, 0, _ALLOW),
    ]  # fmt: skip
    program = _Program(len(lines), (_Instruction * len(lines))(*lines))
    libc = ctypes.CDLL(None, use_errno=True)
    for arguments in ((_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), (_PR_SET_SECCOMP, _FILTER, ctypes.byref(program), 0, 0)):
        if libc.prctl(*arguments):
            raise OSError(ctypes.get_errno(), "this system filters no system calls")


def killed_by_socket(family: int) -> bool:
    """Whether the filter works: a child that opens such a socket does not come back."""
    child = os.fork()
    if child == 0:
        socket.socket(family).close()
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def main() -> None:
    """Run the command lines."""
    try:
        forbid_internet()
    except OSError as error:
        print(f"skip: {error}")
        return
    assert killed_by_socket(socket.AF_INET)
    assert killed_by_socket(socket.AF_INET6)
    assert not killed_by_socket(socket.AF_UNIX)
    notes: list[str] = []
    output, sys.stdout = sys.stdout, sys.stderr

    def note(event: str, arguments: tuple[object, ...]) -> None:
        if event.startswith(PREFIXES):
            notes.append(f"{event} {arguments!r}")

    sys.addaudithook(note)
    from leafflow_ti.cli.main import invoke

    for line in sys.stdin:
        invoke(line.split())
    print(*notes, sep="\n", file=output)


if __name__ == "__main__":
    main()
