"""The one module that imports the engine: Taichi, or its API-compatible fork (``LEAFFLOW_TI_ENGINE=quadrants``)."""

import contextlib
import functools
import importlib
import os
import tempfile
import threading
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from leafflow_ti.errors import DeviceError
from leafflow_ti.kernels.unrolling import loops_as_written, unrolls_too_much
from leafflow_ti.stopping import ended_at_once

# Without these the engine prints a banner to stdout and asks a server for newer versions.
os.environ["TI_SKIP_VERSION_CHECK"] = "ON"
os.environ["ENABLE_TAICHI_HEADER_PRINT"] = "False"
os.environ["ENABLE_QUADRANTS_HEADER_PRINT"] = "False"
if os.name == "posix" and "HOME" not in os.environ:  # services have none, and without it the engine ends the process
    try:
        os.environ["HOME"] = str(Path.home())
    except RuntimeError:
        os.environ["HOME"] = tempfile.gettempdir()

ENGINE = os.environ.get("LEAFFLOW_TI_ENGINE", "taichi")
if ENGINE not in ("taichi", "quadrants"):
    raise DeviceError(f"LEAFFLOW_TI_ENGINE is '{ENGINE}': allowed are taichi and quadrants")


@contextlib.contextmanager
def _quiet_import():
    """Quadrants tells on standard error that standard output is a notebook's, or a test's; a level that was chosen
    stays."""
    chosen = "QD_LOG_LEVEL" in os.environ
    if not chosen:
        os.environ["QD_LOG_LEVEL"] = "error"
    try:
        with warnings.catch_warnings():  # what it does is not to be mended here, where hosts make errors of warnings
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    finally:
        if not chosen:
            del os.environ["QD_LOG_LEVEL"]


try:
    with _quiet_import():
        ti = importlib.import_module(ENGINE)
except ModuleNotFoundError as error:
    if error.name != ENGINE:
        raise
    raise DeviceError(
        f"LEAFFLOW_TI_ENGINE is '{ENGINE}', which is not installed: pip install {ENGINE}, or unset it for taichi"
        if ENGINE != "taichi"
        else "Taichi is not installed: pip install taichi, or set LEAFFLOW_TI_ENGINE=quadrants and install that"
    ) from None

_launching = threading.RLock()
"""The engine compiles and launches for one thread at a time; a launch holds the interpreter anyway."""
_forked = False


def running() -> bool:
    """Whether the engine is initialised in this process, by us or by a host."""
    runtime = ti.lang.impl.get_runtime()
    return (runtime.prog if ENGINE == "taichi" else runtime._prog) is not None


def forked() -> bool:
    """Whether this process was forked while the engine ran."""
    return _forked


def check_not_forked() -> None:
    """Raises DeviceError in a process that was forked while the engine ran: its threads are not there, and waiting for
    them has no end."""
    if _forked:
        raise DeviceError(
            "this process was forked after its parent had begun to compute, and the engine does not survive that: "
            "start processes by multiprocessing.get_context('spawn'), or fork before the first computation"
        )


def _after_fork() -> None:
    global _forked
    _forked = running()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _position(context, node):
    """Stands in for the front end's own: where a node stands, without a drawing of its source line."""
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:\n'


_quick = SimpleNamespace(lock=threading.Lock(), users=0, undo=contextlib.ExitStack())


@contextlib.contextmanager
def quick_front_end():
    """Kernels compiled inside load faster by a third.

    Whenever a function is inlined, the engine's front end reads its source file again, and it draws the source line of
    every node it visits, in case an error message should show it. Inside this block it remembers the sources and
    names the line alone; afterwards a host program finds everything as it was. Several threads may be inside.
    """
    with _quick.lock:
        _quick.users += 1
        if _quick.users == 1:
            _make_quick(_quick.undo)
    try:
        yield
    finally:
        with _quick.lock:
            _quick.users -= 1
            if not _quick.users:
                _quick.undo.close()


def _make_quick(undo):
    def plain(usual):
        return SimpleNamespace(fill=lambda line, **_: line.rstrip(), dedent=usual.dedent)

    quick = {
        "taichi": [
            ("lang.kernel_impl", "getsourcelines", functools.cache),
            ("lang.kernel_impl", "textwrap", plain),
            ("lang.ast.ast_transformer_utils", "ASTTransformerContext.get_pos_info", lambda usual: _position),
        ],
        "quadrants": [
            ("lang._func_base", "get_source_info_and_src", functools.cache),
            ("lang._func_base", "textwrap", plain),
            ("lang.ast.ast_transformer_utils", "ASTTransformerFuncContext._build_pos_info", lambda usual: _position),
        ],
    }
    for module, path, make in quick[ENGINE]:
        *classes, name = path.split(".")
        owner = functools.reduce(getattr, classes, importlib.import_module(f"{ENGINE}.{module}"))
        usual = getattr(owner, name, None)
        if usual is not None:
            setattr(owner, name, make(usual))
            undo.callback(setattr, owner, name, usual)


def lane_type(dtype, lanes):
    """The type of one element of every lane: a vector, or a plain number where there is one lane."""
    return dtype if lanes == 1 else ti.types.vector(lanes, dtype)


class Kernel:
    """A kernel as all of this package are: compiled under the same settings whoever has initialised the engine, and
    launched by one thread at a time.

    Settings belong to the whole engine and are looked at when a kernel is compiled and launched, so they are made for
    this kernel alone and taken back: those of a host that debugs, or computes with other default types, are not ours.
    ``settings``: what differs from ``SETTINGS``; ``front_end``: makes a context in which it is compiled.

    A signal that is to stop the program ends it while a kernel is compiled: no Python runs then, for up to seconds.
    """

    def __init__(self, function, front_end=contextlib.nullcontext, **settings):
        self._kernel = ti.kernel(function)
        self._front_end = front_end
        self._settings = {**SETTINGS, **settings}
        self._compiled = False

    def __call__(self, *arguments):
        check_not_forked()
        with _launching, contextlib.ExitStack() as undo:
            for owner, wanted in ((ti.lang.impl.current_cfg(), self._settings), (ti.lang.impl.get_runtime(), TYPES)):
                _set(owner, wanted, undo)
            if not self._compiled:
                undo.enter_context(ended_at_once())
            undo.enter_context(self._front_end())
            result = self._kernel(*map(_plain, arguments))
            self._compiled = True
            return result


def _plain(argument):
    """NumPy's numbers as Python's: Quadrants warns of others, and looks such launches up anew each time."""
    return argument.item() if isinstance(argument, np.generic) else argument


SETTINGS = {
    "debug": False,
    "check_out_of_bound": False,
    "fast_math": True,
    "advanced_optimization": True,
    "opt_level": 1,
}
"""What kernels are compiled with; the engine's own defaults."""
TYPES = {"default_fp": ti.f32, "default_ip": ti.i32, "default_up": ti.u32}
"""Types of what is not annotated."""


def _set(owner, wanted, undo):
    """Set attributes that differ, as far as they exist; ``undo`` gets what sets them back."""
    for name, value in wanted.items():
        usual = getattr(owner, name, value)
        if usual != value:
            setattr(owner, name, value)
            undo.callback(setattr, owner, name, usual)


def lane_kernel(lanes, long=False, numbers=False):
    """Decorator of kernels that work on ``lane_type`` values. Where there are several lanes, vectors stay whole: an
    operation on them is one vector instruction, not one per lane.

    The engine splits vectors into numbers unless told otherwise, and leaves it to its optimiser, which knows no
    processor younger than itself, to find them again: measured, a seventh of the speed.

    ``long``: without the engine's own search for what is computed twice and for what loops need not repeat. Its time
    grows with the square of the kernel's length, and the compiler behind it finds the same: measured on the refinement,
    compiled in 7 s instead of 28, and as fast. ``numbers``: the innermost loops are of plain numbers, of which the
    compiler makes vectors.

    What may not be written on vectors (the engine's own gaps): ``-v``, ``v -= w``, ``abs``, casts between precisions.
    Arrays of vectors must be aligned as ``runtime.Device.empty`` does.
    """
    if lanes == 1:
        return Kernel
    settings = {"real_matrix_scalarize": False}
    if long:
        settings["advanced_optimization"] = False
    if ENGINE == "taichi" and unrolls_too_much():
        settings["front_end"] = functools.partial(loops_as_written, ENGINE, innermost=not numbers)
    return functools.partial(Kernel, **settings)


__all__ = ["ENGINE", "Kernel", "check_not_forked", "forked", "lane_kernel", "lane_type", "quick_front_end"]
__all__ += ["running", "ti"]
