"""Runs that search every frame: what is stored about them, resuming, their profile, and what ``info`` says."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from small_plane import capture_of, files_of
from test_cli import call
from test_trace import assert_nested, events_of

import leafflow_ti as lf
from leafflow_ti.capture import Capture
from leafflow_ti.cli.profile import format_profile
from leafflow_ti.config import load_config
from leafflow_ti.errors import RunError
from leafflow_ti.profiling import profile
from leafflow_ti.progress import Progress
from leafflow_ti.synthetic.leaves import LeavesScene
from leafflow_ti.synthetic.plane import PlaneScene
from leafflow_ti.synthetic.write import write_scene
from leafflow_ti.trace import STAGES

SCENE = PlaneScene(
    f_px=900.0, baseline_mm=(0.3, 0.3), n_cols=3, n_frames=5, size=(93, 77), centre=(0.3, -0.2, 80.0), zx=0.3, zy=-0.2,
    velocity=(0.15, -0.05, 0.06), texture="noise", wavelengths_mm=(0.6, 3.0), amplitude=25.0, noise=1.0,
)  # fmt: skip
OPTIONS: dict[str, Any] = {
    "model": "affine-4d", "taps": "3", "size_time": 1, "preshift": "adaptive", "window": 15, "stride": 4, "tile": 10,
    "disparity_range": (-6.0, 0.0), "motion_range": 4.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def capture() -> Capture:
    return capture_of(SCENE)


def stopping_after(units: int) -> Callable[[Progress], None]:
    def die(progress: Progress) -> None:
        if progress.done_units == units:
            raise KeyboardInterrupt

    return die


def test_a_resumed_run_ends_with_the_same_bytes(capture: Capture, tmp_path: Path) -> None:
    """It stops inside the first frame, whose search is then made again."""
    wanted = load_config(overrides={**OPTIONS, "frames": "1:3"})
    with pytest.raises(KeyboardInterrupt):
        lf.run(capture, tmp_path / "out.zarr", wanted, progress=stopping_after(1))
    lf.run(capture, tmp_path / "out.zarr", wanted, resume=True)
    lf.run(capture, tmp_path / "whole.zarr", wanted)
    assert files_of(tmp_path / "out.zarr") == files_of(tmp_path / "whole.zarr")
    stages = lf.ResultStore.open(tmp_path / "whole.zarr").attrs["timings"]["stages"]
    assert {"search", "filter", "tensor", "estimate"} <= set(stages) <= set(STAGES)


@pytest.mark.parametrize("changed", [{"disparity_range": (-7.0, 0.0)}, {"motion_range": "auto"}, {"preshift": -3}])
def test_another_search_is_not_resumed(capture: Capture, tmp_path: Path, changed: dict[str, Any]) -> None:
    one_frame = {**OPTIONS, "frames": "1:2"}
    with pytest.raises(KeyboardInterrupt):
        lf.run(capture, tmp_path / "out.zarr", load_config(overrides=one_frame), progress=stopping_after(1))
    with pytest.raises(RunError, match=r"cannot be resumed, it belongs to another run: (config|preshift|search|plan)"):
        lf.run(capture, tmp_path / "out.zarr", load_config(overrides={**one_frame, **changed}), resume=True)


def test_results_say_that_they_were_searched_for(
    capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field = lf.estimate(capture, 2, **OPTIONS)
    assert field.attrs["plan"]["preshift_px"] == "adaptive"
    lf.run(capture, tmp_path / "out.zarr", load_config(overrides={**OPTIONS, "frames": "1:2"}))
    assert call("info", tmp_path / "out.zarr") == 0
    text = capsys.readouterr().out
    assert "preshift_px: adaptive" in text
    assert "search " in next(line for line in text.splitlines() if line.startswith("stages"))


def test_profile_of_a_searched_capture(capture: Capture, tmp_path: Path) -> None:
    options = {**OPTIONS, "refine": 2, "refine_window": 15, "thin": 1}
    found = profile(capture, load_config(overrides=options), 2, tmp_path / "trace.json")
    assert found.searched
    assert found.unit == (20, 24)
    assert found.frames_measured == 2
    stages = {cost.stage: cost for cost in found.stages}
    assert {"search", "filter", "tensor", "estimate", "splines", "refine", "write", "host"} <= set(stages)
    assert found.limit in (*stages, "disk", "decoding")
    whole = found.prediction
    assert (whole.frames, whole.units) == (3, 6)
    assert whole.seconds == pytest.approx(found.compile_seconds + 3 * found.seconds_per_unit)
    assert whole.frames_read > 3 * 3
    assert found.effort is not None
    assert found.effort.refined > 0.3
    json.dumps(found.to_json(), allow_nan=False)
    text = "\n".join(format_profile(found))
    assert "2 frames of 20 x 24 pixels, each searched for what its pixels need" in text
    assert "= compiling + frames x frame" in text
    spans, _ = events_of(tmp_path / "trace.json")
    assert_nested(spans)
    assert sum(e["cat"] == "search" for e in spans) == 2


def test_info_of_a_capture_of_several_depths(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = LeavesScene(n_cols=3, n_frames=1, size=(201, 151), f_px=600.0, disparity_px=(3.0, 20.0), supersampling=1)
    write_scene(scene, tmp_path / "leaves")
    assert call("info", tmp_path / "leaves") == 0
    text = capsys.readouterr().out
    assert "--preshift auto" in text
    assert "searche" in text
    write_scene(replace(SCENE, n_frames=1), tmp_path / "plane")
    assert call("info", tmp_path / "plane") == 0
    assert "--preshift auto" not in capsys.readouterr().out


def test_every_frame_is_searched_where_no_preshift_is_clear(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neighbours that show different textures: no disparity, and the line says what happens without one."""
    scene = replace(SCENE, n_frames=1)
    write_scene(scene, tmp_path / "c")
    random = np.random.default_rng(0)
    for path in (tmp_path / "c").rglob("*.tif"):
        tifffile.imwrite(path, random.integers(0, 255, scene.size[::-1]).astype(np.uint8))
    assert call("info", tmp_path / "c") == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("distance"))
    assert "no clear disparity" in line
    assert "every frame is searched pixel by pixel" in line
