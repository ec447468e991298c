"""The backend in a host's process: its threads, its engine, its settings; and what is compiled beforehand."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from leafflow_ti import backend
from leafflow_ti.backend.warming import CALLS
from leafflow_ti.errors import ConfigError

GUEST = Path(__file__).with_name("backend_guest.py")
NAMES = ["eig_special_2d", "epi_disparity"]


def told(mode: str, **environment: str) -> dict[str, Any]:
    """What the program says; it must say nothing else, and make no warning, but for Taichi's that a host imports."""
    path = os.pathsep.join(p for p in sys.path if p)
    done = subprocess.run(
        [sys.executable, *(("-W", "error") if mode != "host" else ()), GUEST, mode],
        capture_output=True, text=True, check=False, timeout=300,
        env={**os.environ, "PYTHONPATH": path, **environment},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


@pytest.fixture(scope="module")
def expected() -> str:
    """What this process finds."""
    sys.path.insert(0, str(GUEST.parent))
    from backend_guest import checksum

    return checksum()


@pytest.mark.parametrize("mode", ["first", "warm"])
def test_threads_at_the_same_time(mode: str, expected: str) -> None:
    """Before anything runs, one of them starts the engine and the others wait; after ``warm_up`` none waits."""
    found = told(mode)
    assert found["threads"] == [expected] * 4
    assert found["main"] == expected
    assert found.get("warmed", NAMES) == NAMES


def test_a_host_that_has_initialised_the_engine(expected: str) -> None:
    found = told("host")
    assert found == {"kept": [True] * 5, "threads": [expected] * 4, "main": expected}


def test_a_device_that_does_not_exist() -> None:
    code = """
import numpy as np
from leafflow_ti import backend
from leafflow_ti.errors import DeviceError
try:
    backend.eig_special_2d(np.zeros((3, 8, 9), np.float32))
except DeviceError as error:
    print(error)
"""
    path = os.pathsep.join(p for p in sys.path if p)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120,
        env={**os.environ, "PYTHONPATH": path, "LEAFFLOW_TI_ARCH": "gpu"},
    )  # fmt: skip
    assert done.stderr == ""
    (line,) = done.stdout.splitlines()
    assert "'gpu'" in line
    assert "cuda" in line


def test_every_function_can_be_warmed_up() -> None:
    assert set(CALLS) <= set(backend.__all__)
    functions = {name for name in backend.__all__ if name[0].islower() and callable(getattr(backend, name))}
    assert functions - {"warm_up"} == set(CALLS)


def test_warming_up_says_what_it_took() -> None:
    found = backend.warm_up("eig_special_2d", dtype=("float32", np.float32))
    assert list(found) == ["eig_special_2d"]
    assert found["eig_special_2d"] > 0.0
    with pytest.raises(ConfigError, match=r"'eig_special_4d'.*eig_special_3d"):
        backend.warm_up("eig_special_4d")


def test_entry_points_lead_to_the_shims() -> None:
    """As ``pyproject.toml`` has them, whichever version is installed."""
    import tomllib

    text = (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    group = tomllib.loads(text)["project"]["entry-points"]["leafflow.backends"]
    loaded = {name: EntryPoint(name, value, "leafflow.backends").load() for name, value in group.items()}
    assert loaded["arrays"] is backend
    assert hasattr(loaded["structure_tensor"], "structure_tensor_3d")
    assert hasattr(loaded["skimage.feature"], "structure_tensor_eigenvalues")
    assert hasattr(loaded["skimage.registration"], "optical_flow_ilk")
    assert set(loaded) == {"arrays", "cv2", "skimage.feature", "skimage.registration", "structure_tensor"}
