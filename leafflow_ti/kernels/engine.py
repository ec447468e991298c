"""The one module that imports the engine: Taichi, or its API-compatible fork (``LEAFFLOW_TI_ENGINE=quadrants``)."""

import contextlib
import importlib
import os

# Without these the engine prints a banner to stdout and asks a server for newer versions.
os.environ["TI_SKIP_VERSION_CHECK"] = "ON"
os.environ["ENABLE_TAICHI_HEADER_PRINT"] = "False"

ENGINE = os.environ.get("LEAFFLOW_TI_ENGINE", "taichi")
if ENGINE not in ("taichi", "quadrants"):
    raise ImportError(f"LEAFFLOW_TI_ENGINE is '{ENGINE}': allowed are taichi and quadrants")
ti = importlib.import_module(ENGINE)


class _Unwrapped:
    """Stands in for ``textwrap.TextWrapper``: leaves every line as it is."""

    def __init__(self, width=0):
        pass

    def wrap(self, text):
        return [text] if text.strip() else []


@contextlib.contextmanager
def quick_front_end():
    """Kernels compiled inside load faster by a tenth.

    The engine's front end wraps the source line of every node it visits to 80 columns, in case an error message should
    show it. Inside this block it does not; afterwards a host program finds everything as it was.
    """
    front_end = importlib.import_module(f"{ENGINE}.lang.ast.ast_transformer_utils")
    usual = getattr(front_end, "TextWrapper", None)
    if usual is not None:
        front_end.TextWrapper = _Unwrapped
    try:
        yield
    finally:
        if usual is not None:
            front_end.TextWrapper = usual


def lane_type(dtype, lanes):
    """The type of one element of every lane: a vector, or a plain number where there is one lane."""
    return dtype if lanes == 1 else ti.types.vector(lanes, dtype)


class LaneKernel:
    """A kernel whose vectors stay whole: an operation on the lanes is one vector instruction, not one per lane.

    The engine splits vectors into numbers unless told otherwise, and leaves it to its optimiser, which knows no
    processor younger than itself, to find them again: measured, a seventh of the speed. The setting belongs to the
    whole engine and is looked at when a kernel is compiled, so it is made for this kernel alone.

    What may not be written on vectors (the engine's own gaps): ``-v``, ``v -= w``, ``abs``, casts between precisions.
    Arrays of vectors must be aligned as ``runtime.Device.empty`` does.
    """

    def __init__(self, function):
        self._kernel = ti.kernel(function)

    def __call__(self, *arguments):
        config = ti.lang.impl.current_cfg()
        usual = getattr(config, "real_matrix_scalarize", None)
        if usual is None:
            return self._kernel(*arguments)
        config.real_matrix_scalarize = False
        try:
            return self._kernel(*arguments)
        finally:
            config.real_matrix_scalarize = usual


def lane_kernel(lanes):
    """Decorator of kernels that work on ``lane_type`` values: a plain kernel where there is one lane."""
    return ti.kernel if lanes == 1 else LaneKernel


__all__ = ["ENGINE", "lane_kernel", "lane_type", "quick_front_end", "ti"]
