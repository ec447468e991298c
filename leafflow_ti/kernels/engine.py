"""The one module that imports the engine: Taichi, or its API-compatible fork (``LEAFFLOW_TI_ENGINE=quadrants``)."""

import importlib
import os

# Without these the engine prints a banner to stdout and asks a server for newer versions.
os.environ["TI_SKIP_VERSION_CHECK"] = "ON"
os.environ["ENABLE_TAICHI_HEADER_PRINT"] = "False"

ENGINE = os.environ.get("LEAFFLOW_TI_ENGINE", "taichi")
if ENGINE not in ("taichi", "quadrants"):
    raise ImportError(f"LEAFFLOW_TI_ENGINE is '{ENGINE}': allowed are taichi and quadrants")
ti = importlib.import_module(ENGINE)

__all__ = ["ENGINE", "ti"]
