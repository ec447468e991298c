"""The programs and the package of ``examples`` run as they are."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import structure_tensor

EXAMPLES = Path(__file__).parents[1] / "examples"
PROGRAMS = sorted(EXAMPLES.glob("*.py"))
NEEDS = {"torch_kernels": "torch"}
CONSUMER = EXAMPLES / "leafflow-consumer"
SCRIPT = """
import sys
import numpy as np
from leafflow_consumer import implementation, orientation
image = np.load(sys.argv[1])
np.save(sys.argv[2], orientation(image, 1.0, 2.5))
print(implementation().__name__, sorted({name.partition(".")[0] for name in sys.modules} & {"leafflow_ti", "fast"}))
"""
REGISTERED = """\
def structure_tensor_2d(image, sigma, rho):
    import structure_tensor
    return structure_tensor.structure_tensor_2d(image, sigma, rho)


def eig_special_2d(tensors):
    import structure_tensor
    return structure_tensor.eig_special_2d(tensors)
"""


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_a_program_runs(program: Path, tmp_path: Path) -> None:
    if program.stem in NEEDS and importlib.util.find_spec(NEEDS[program.stem]) is None:
        pytest.skip(f"{NEEDS[program.stem]} is not installed")
    path = os.pathsep.join(p for p in sys.path if p)
    done = subprocess.run(
        [sys.executable, program], capture_output=True, text=True, cwd=tmp_path, check=False, timeout=300,
        env={**os.environ, "PYTHONPATH": path, "MPLBACKEND": "agg"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.strip()


def consumed(image: np.ndarray, folder: Path, *visible: Path, hidden: bool = True) -> tuple[np.ndarray, str]:
    """What the example package computes where leafflow-ti is ``hidden`` and these folders are visible; and by what."""
    np.save(folder / "image.npy", image)
    code = f"import sys\nsys.path += {[str(CONSUMER), *map(str, visible)]!r}\n{SCRIPT}"
    done = subprocess.run(
        [sys.executable, "-c", (HIDING if hidden else "") + code, folder / "image.npy", folder / "angle.npy"],
        capture_output=True, text=True, check=False, timeout=120, env={**os.environ, "PYTHONPATH": ""}, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return np.load(folder / "angle.npy"), done.stdout.strip()


HIDING = """
import importlib.metadata, sys
class Absent:
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] == "leafflow_ti":
            raise ModuleNotFoundError("hidden", name=name)
sys.meta_path.insert(0, Absent)
usual = importlib.metadata.Distribution.discover
def visible(**options):
    return (d for d in usual(**options) if d.metadata["Name"] != "leafflow-ti")
importlib.metadata.Distribution.discover = visible
importlib.metadata.distributions = visible
"""


@pytest.fixture
def image() -> np.ndarray:
    """Waves whose orientation changes across the image."""
    y, x = np.mgrid[:24, :31].astype(float)
    return np.sin(0.5 * x + 0.02 * y * y) + 0.1 * np.cos(0.9 * y)


def test_the_consumer_without_a_backend(image: np.ndarray, tmp_path: Path) -> None:
    """Nothing of leafflow-ti is visible: its own code finds the same as the package structure-tensor."""
    angle, by = consumed(image, tmp_path)
    assert by == "leafflow_consumer.own []"
    _, along = structure_tensor.eig_special_2d(structure_tensor.structure_tensor_2d(image, 1.0, 2.5))
    expected = np.arctan2(along[0], along[1])
    assert np.abs(np.sin(angle - expected)).max() < 1e-9  # the same direction, either way round
    assert np.ptp(angle) > 0.5


def test_the_consumer_with_a_registered_backend(image: np.ndarray, tmp_path: Path) -> None:
    """What any package registers under the name is used."""
    info = tmp_path / "packages" / "fast-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fast\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[leafflow.backends]\nstructure_tensor = fast\n")
    (info.parent / "fast.py").write_text(REGISTERED)
    fast, by = consumed(image, tmp_path, info.parent)
    assert by == "fast ['fast']"
    own, _ = consumed(image, tmp_path)
    assert np.abs(np.sin(fast - own)).max() < 1e-9


def test_the_consumer_with_leafflow_ti(image: np.ndarray, tmp_path: Path) -> None:
    """As it would be installed: by the entry points that ``pyproject.toml`` states."""
    import tomllib

    root = EXAMPLES.parent
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = tmp_path / "packages" / "ours-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: ours\nVersion: 1.0\n")
    lines = [f"{name} = {value}" for name, value in project["entry-points"]["leafflow.backends"].items()]
    (info / "entry_points.txt").write_text("\n".join(["[leafflow.backends]", *lines, ""]))
    fast, by = consumed(image, tmp_path, info.parent, root, hidden=False)
    assert by == "leafflow_ti.backend.compat.structure_tensor ['leafflow_ti']"
    own, _ = consumed(image, tmp_path)
    assert np.abs(np.sin(fast - own)).max() < 1e-6
