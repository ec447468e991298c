"""Results stores in napari: the manifest leads to the reader, and its layers show what the store holds."""

from __future__ import annotations

import importlib
import tomllib
from pathlib import Path

import numpy as np
import pytest
import yaml

import leafflow_ti
from leafflow_ti.napari_reader import get_reader, read_layers
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

MANIFEST = Path(leafflow_ti.__file__).with_name("napari.yaml")
PROJECT = Path(__file__).parents[1] / "pyproject.toml"
NAMES = ("depth", "depth_std", "velocity_x", "identified")


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Two frames of 3 x 4 pixels at stride 4 from (20, 8); depth rises along x, the velocity has both signs."""
    shape = (2, 3, 4)
    made = ResultStore.create(
        tmp_path / "out.zarr", frames=(5, 6), y=8 + 4 * np.arange(3), x=20 + 4 * np.arange(4), names=NAMES,
        chunk=(1, 3, 4), attrs={}, interval_s=60.0,
    )  # fmt: skip
    depth = np.broadcast_to(np.arange(100.0, 104.0, dtype=np.float32), shape)
    for t in range(2):
        maps = {
            "depth": depth[t] + t, "depth_std": np.full(shape[1:], 0.5, np.float32),
            "velocity_x": depth[t] - 101.5, "identified": np.full(shape[1:], 5, np.uint8),
        }  # fmt: skip
        status = np.zeros(shape[1:], np.uint8)
        status[0, 0] = Status.MASKED
        made.write_unit(t, t, slice(0, 3), maps, status)
    return tmp_path / "out.zarr"


def test_the_manifest_leads_to_the_reader() -> None:
    manifest = yaml.safe_load(MANIFEST.read_text(encoding="utf-8"))
    (command,) = manifest["contributions"]["commands"]
    (reader,) = manifest["contributions"]["readers"]
    module, _, function = command["python_name"].partition(":")
    assert getattr(importlib.import_module(module), function) is get_reader
    assert reader["command"] == command["id"]
    assert command["id"].startswith(f"{manifest['name']}.")  # npe2 demands it
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    assert project["entry-points"]["napari.manifest"] == {project["name"]: f"leafflow_ti:{MANIFEST.name}"}


def test_only_results_stores_are_taken(store: Path, tmp_path: Path) -> None:
    assert get_reader(str(store)) is read_layers
    (tmp_path / "other.zarr").mkdir()
    assert get_reader(str(tmp_path / "other.zarr")) is None
    assert get_reader([str(store), str(store)]) is None


def test_layers_hold_the_maps_with_units_and_limits(store: Path) -> None:
    layers = {options["name"]: (data, options, kind) for data, options, kind in read_layers(str(store))}
    assert list(layers) == ["status", "depth_std [mm]", "velocity_x [mm/frame]", "depth [mm]"]
    data, options, kind = layers["depth [mm]"]
    assert kind == "image"
    np.testing.assert_array_equal(np.asarray(data)[:, 0], [[100, 101, 102, 103], [101, 102, 103, 104]])
    low, high = options["contrast_limits"]  # of the middle frame, the second
    assert 101 <= low < 101.2
    assert 103.8 < high <= 104
    assert options["metadata"] == {"unit": "mm", "long_name": "depth of the surface along the optical axis",
                                   "interval_s": 60.0}  # fmt: skip
    signed = layers["velocity_x [mm/frame]"][1]
    assert signed["contrast_limits"][0] == -signed["contrast_limits"][1]
    assert [options["colormap"] for _, options, kind in layers.values() if kind == "image"] == [
        "cividis", "coolwarm", "viridis",
    ]  # fmt: skip


def test_layers_lie_on_the_reference_image(store: Path) -> None:
    for _, options, _ in read_layers(str(store)):
        assert options["scale"] == (1.0, 4.0, 4.0)
        assert options["translate"] == (5.0, 8.0, 20.0)
    shown = [options["name"] for _, options, _ in read_layers(str(store)) if options.get("visible", True)]
    assert shown == ["status", "depth [mm]"]


def test_the_status_is_a_labels_layer_with_names(store: Path) -> None:
    data, options, kind = read_layers(str(store))[0]
    assert kind == "labels"
    assert np.asarray(data)[0, 0, 0] == Status.MASKED
    names = dict(zip(options["features"]["index"], options["features"]["status"], strict=True))
    assert names[Status.MASKED] == "masked"
    assert names[Status.OK] == "ok"
