"""The one module that imports the engine: Taichi, or its API-compatible fork (``LEAFFLOW_TI_ENGINE=quadrants``)."""

import contextlib
import functools
import importlib
import os
from types import SimpleNamespace

# Without these the engine prints a banner to stdout and asks a server for newer versions.
os.environ["TI_SKIP_VERSION_CHECK"] = "ON"
os.environ["ENABLE_TAICHI_HEADER_PRINT"] = "False"

ENGINE = os.environ.get("LEAFFLOW_TI_ENGINE", "taichi")
if ENGINE not in ("taichi", "quadrants"):
    raise ImportError(f"LEAFFLOW_TI_ENGINE is '{ENGINE}': allowed are taichi and quadrants")
ti = importlib.import_module(ENGINE)


def _position(context, node):
    """Stands in for the front end's own: where a node stands, without a drawing of its source line."""
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:\n'


@contextlib.contextmanager
def quick_front_end():
    """Kernels compiled inside load faster by a third.

    Whenever a function is inlined, the engine's front end reads its source file again, and it draws the source line of
    every node it visits, in case an error message should show it. Inside this block it remembers the sources and
    names the line alone; afterwards a host program finds everything as it was.
    """
    kernels = importlib.import_module(f"{ENGINE}.lang.kernel_impl")
    contexts = importlib.import_module(f"{ENGINE}.lang.ast.ast_transformer_utils")
    quick = [
        (kernels, "getsourcelines", lambda usual: functools.cache(usual)),
        (kernels, "textwrap", lambda usual: SimpleNamespace(fill=lambda line, **_: line.rstrip(), dedent=usual.dedent)),
        (contexts.ASTTransformerContext, "get_pos_info", lambda usual: _position),
    ]
    with contextlib.ExitStack() as stack:
        for owner, name, make in quick:
            usual = getattr(owner, name, None)
            if usual is not None:
                setattr(owner, name, make(usual))
                stack.callback(setattr, owner, name, usual)
        yield


def lane_type(dtype, lanes):
    """The type of one element of every lane: a vector, or a plain number where there is one lane."""
    return dtype if lanes == 1 else ti.types.vector(lanes, dtype)


class LaneKernel:
    """A kernel whose vectors stay whole: an operation on the lanes is one vector instruction, not one per lane.

    The engine splits vectors into numbers unless told otherwise, and leaves it to its optimiser, which knows no
    processor younger than itself, to find them again: measured, a seventh of the speed. Settings belong to the whole
    engine and are looked at when a kernel is compiled, so they are made for this kernel alone.

    ``long``: without the engine's own search for what is computed twice and for what loops need not repeat. Its time
    grows with the square of the kernel's length, and the compiler behind it finds the same: measured on the refinement,
    compiled in 7 s instead of 28, and as fast.

    What may not be written on vectors (the engine's own gaps): ``-v``, ``v -= w``, ``abs``, casts between precisions.
    Arrays of vectors must be aligned as ``runtime.Device.empty`` does.
    """

    def __init__(self, function, long=False):
        self._kernel = ti.kernel(function)
        self._off = ("real_matrix_scalarize", *(("advanced_optimization",) if long else ()))

    def __call__(self, *arguments):
        config = ti.lang.impl.current_cfg()
        usual = {name: getattr(config, name) for name in self._off if hasattr(config, name)}
        for name in usual:
            setattr(config, name, False)
        try:
            return self._kernel(*arguments)
        finally:
            for name, value in usual.items():
                setattr(config, name, value)


def lane_kernel(lanes, long=False):
    """Decorator of kernels that work on ``lane_type`` values: a plain kernel where there is one lane."""
    return ti.kernel if lanes == 1 else functools.partial(LaneKernel, long=long)


__all__ = ["ENGINE", "lane_kernel", "lane_type", "quick_front_end", "ti"]
