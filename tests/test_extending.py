"""What the documentation says about extensions: one more row in the table of models is a model that users can run."""

from __future__ import annotations

import re

import numpy as np
import pytest
from documentation import ROOT, blocks

import leafflow_ti as lf
from leafflow_ti import models
from leafflow_ti.synthetic.plane import PlaneScene, render

SCENE = PlaneScene(
    f_px=900.0, baseline_mm=(0.7, 0.7), n_frames=7, size=(72, 64), n_rows=1, n_cols=1, centre=(0.3, -0.2, 80.0),
    velocity=(0.04, -0.03, 0.2), acceleration=(0.02, -0.01, 0.0), wavelengths_mm=(1.2, 1.5), noise=0.0,
)  # fmt: skip


def documented_row() -> dict[str, models.Model]:
    """The rows that the page adds to the table, as it shows them."""
    page = ROOT / "docs/extending.md"
    (row,) = (block.text for block in blocks(page) if re.match(r'"[\w-]+": Model\(', block.text))
    found = eval(f"{{{row}}}", vars(models))
    assert isinstance(found, dict)
    return found


def test_a_row_of_the_table_is_a_model(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, model in documented_row().items():
        monkeypatch.setitem(models.MODELS, name, model)
        images = render(SCENE).astype(np.float32)
        capture = lf.capture_from_array(images)
        options = {"model": name, "window": 25, "size_time": 3, "noise": 0.1, "preshift": 0, "frames": "3:4"}
        plan = lf.plan_run(capture, lf.load_config(overrides=options))
        assert ", 9 columns," in plan.describe()  # (Ix, Iy) times (1, x, y, t), and It
        field = lf.estimate(capture, **options)
        true = SCENE.f_px * np.array([0.04, -0.03]) / 80.0  # px/frame at the principal point: f V / Z
        assert [float(field[f"flow_{axis}"][32, 36]) for axis in "xy"] == pytest.approx(true, abs=0.01)
