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


__all__ = ["ENGINE", "quick_front_end", "ti"]
