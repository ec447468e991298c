"""The profile: counts of the prediction against a real run, its JSON, its trace, and what it refuses."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from small_plane import SCENE, capture_of, config
from test_cli import call
from test_trace import assert_nested, events_of

import leafflow_ti as lf
from leafflow_ti.capture import Capture
from leafflow_ti.cli import options
from leafflow_ti.cli.profile import format_profile
from leafflow_ti.errors import ConfigError, UsageError
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.profile_cases import CASES, find_case
from leafflow_ti.profiling import Profile, predict, profile
from leafflow_ti.refine_work import count_refinement
from leafflow_ti.runtime import start
from leafflow_ti.synthetic.write import write_scene
from leafflow_ti.trace import STAGES, Trace


@pytest.fixture(scope="module")
def capture() -> Capture:
    return capture_of(SCENE)


@pytest.fixture(scope="module")
def measured(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> tuple[Profile, Path]:
    """A profile of three units, and its trace."""
    path = tmp_path_factory.mktemp("profile") / "trace.json"
    return profile(capture, config(tile=16), 3, path), path


@pytest.mark.parametrize("options", [{"tile": 16}, {"tile": 2, "frames": "5:7"}, {"tile": 16, "model": "depth"}])
def test_predicted_counts_are_those_of_a_run(capture: Capture, options: dict[str, object]) -> None:
    """Bands of two rows at the image's border are all border: nothing is read for them."""
    plan = lf.plan_run(capture, config(**{**options, "motion": "auto"}))
    trace = Trace(keep=True)
    pipeline = Pipeline(plan, capture, start(), trace)
    units: list[int] = []
    pipeline.run(lambda unit, maps, status: units.append(unit.index))
    assert trace.events is not None
    found = Counter(event.stage for event in trace.events)
    whole = predict(pipeline, plan.bands // 2, 1.0, 1.0, {}, 0.0)
    assert (whole.units, whole.frames * whole.bands) == (len(units), len(units))
    assert whole.frames_read == found["host"]


def test_prediction_adds_up_what_the_bands_cost(capture: Capture) -> None:
    """Equal bands: one filling and a unit per frame each, and the compiling."""
    plan = lf.plan_run(capture, config(tile=43, frames="4:7"))
    pipeline = Pipeline(plan, capture, start())
    whole = predict(pipeline, 0, 10.0, 2.0, {"filter": 0.5}, 7.0)
    assert whole.seconds == pytest.approx(7.0 + 10.0 + 3 * 2.0)
    assert (whole.frames, whole.bands, whole.units, whole.frames_read) == (3, 1, 3, 3 + 8)


def test_prediction_scales_with_the_rows(capture: Capture) -> None:
    """Bands of 16, 16 and 11 rows, of which those whose windows reach beyond the image are border."""
    plan = lf.plan_run(capture, config(tile=16, frames="6:7"))
    pipeline = Pipeline(plan, capture, start())
    rows = [rows.stop - rows.start for rows, _ in map(pipeline.extent, range(3))]
    assert max(rows) > min(rows) > 0
    halo = plan.problem.sampling.y.radius + plan.problem.sampling.y.filter_radius
    whole = predict(pipeline, rows.index(max(rows)), 3.0, 5.0, {"filter": 1.0}, 0.0)
    images = [n + 2 * halo for n in rows]
    expected = sum((3.0 + 1.0) * wide / max(images) + 4.0 * n / max(rows) for n, wide in zip(rows, images, strict=True))
    assert whole.seconds == pytest.approx(expected)


def test_profile_names_every_stage_and_is_json(measured: tuple[Profile, Path]) -> None:
    found = json.loads(json.dumps(measured[0].to_json(), allow_nan=False))
    stages = {cost["stage"]: cost for cost in found["stages"]}
    assert {"decode", "filter", "tensor", "solve", "fit", "write", "host"} <= set(stages) <= set(STAGES)
    assert found["model"] == "affine-4d"
    assert found["frames_measured"] == 3
    assert found["prediction"]["units"] == 15
    rows, cols = found["unit"]
    for cost in stages.values():
        assert cost["us_per_pixel"] == pytest.approx(1e6 * cost["seconds"] / (rows * cols))
        assert cost["share"] == pytest.approx(cost["seconds"] / found["seconds_per_unit"])
    for stage in ("filter", "tensor", "solve", "fit"):
        assert stages[stage]["limit"] in ("compute", "memory", "launches")
        peak = found["ceilings"]["gflops_f32" if stage in ("filter", "tensor") else "gflops_f64"]
        assert stages[stage]["share_of_flops"] == pytest.approx(stages[stage]["gflops"] / peak)
        assert 0 < stages[stage]["share_of_flops"] < 1
    assert stages["write"]["limit"] == "disk"
    assert found["limit"] in ("compute", "memory", "launches", "disk", "decoding")
    assert 0 <= found["overlap"] <= 1
    assert found["peak_bytes"] is None or found["peak_bytes"] > found["planned_bytes"]


def test_stages_of_a_unit_fit_into_its_time(measured: tuple[Profile, Path]) -> None:
    """Means over three units against their median: within a factor, whatever else the machine does."""
    found = measured[0]
    computing = sum(c.seconds for c in found.stages if c.stage not in ("read", "decode", "write"))
    assert 0.1 * found.seconds_per_unit < computing < 10 * found.seconds_per_unit


def test_trace_of_a_profile_holds_its_frames(measured: tuple[Profile, Path]) -> None:
    spans, _ = events_of(measured[1])
    assert_nested(spans)
    names = Counter(e["name"] for e in spans if e["cat"] == "host")
    assert names == Counter(f"frame {t}" for t in range(4 - 4, 6 + 4 + 1))
    assert sum(e["cat"] == "write" for e in spans) == 3
    assert sum(e["cat"] == "tensor" for e in spans) == 3
    assert sum(e["cat"] == "compile" for e in spans) == 1


def test_profile_in_words(measured: tuple[Profile, Path]) -> None:
    text = "\n".join(format_profile(measured[0]))
    assert "15 units (5 frames x 3 bands, 39 frames read)" in text
    for stage in ("filter", "tensor", "solve", "fit", "(decode)", "(write)"):
        assert any(line.startswith(f"{stage} ") for line in text.splitlines()), stage


def test_profile_of_a_refinement(capture: Capture) -> None:
    """Its stages stand beside the others with what they reached, and its effort lies within the plan's."""
    wanted = config(model="affine-scene-flow", refine=3, thin=1, window=21, stride=8, frames="5:6", motion="auto")
    found = profile(capture, wanted, 1)
    stages = {cost.stage: cost for cost in found.stages}
    plan = lf.plan_run(capture, wanted)
    assert found.effort is not None
    assert 1 <= found.effort.refined <= 2
    assert found.effort.refined <= found.effort.samplings <= found.effort.passes <= 3 * found.effort.refined
    assert stages["refine"].flops_per_pixel == count_refinement(plan, found.effort)["refine"].flops
    for stage in ("splines", "refine"):
        assert stages[stage].limit in ("compute", "memory", "launches")
        assert 0 < (stages[stage].share_of_flops or 0) < 1
    text = "\n".join(format_profile(found))
    assert f"in {found.effort.passes:.2f} steps" in text
    assert all(f"\n{stage} " in text for stage in ("splines", "refine"))


def test_prediction_filters_a_bands_rows_for_the_refinement(capture: Capture) -> None:
    """Spline coefficients grow with the rows of images, as filters do."""
    plan = lf.plan_run(capture, config(tile=16, frames="6:7"))
    pipeline = Pipeline(plan, capture, start())
    filtered, splines = (predict(pipeline, 1, 3.0, 5.0, {stage: 1.0}, 0.0) for stage in ("filter", "splines"))
    assert filtered == splines


def test_nothing_to_measure_is_refused(capture: Capture) -> None:
    with pytest.raises(ConfigError, match="no pixel can be measured"):
        profile(capture, config(window=61))


@pytest.mark.parametrize("name", list(CASES))
def test_cases_are_what_their_settings_describe(name: str) -> None:
    case = CASES[name]
    made = case.capture(1)
    plan = lf.plan_run(made, lf.load_config(sets=case.settings))
    assert plan.model == ("affine-scene-flow" if name == "refined" else name.removesuffix("-stride4"))
    assert (plan.refine is not None) == (name == "refined")
    stride = plan.config.window.stride
    assert (len(plan.y), len(plan.x)) == (-(-300 // stride), -(-300 // stride))
    assert len(plan.frames) == 1
    pipeline = Pipeline(plan, made, start())
    covered = sum(rows.stop - rows.start for rows, _ in map(pipeline.extent, range(plan.bands)))
    # All of it is measured, and the rows around each band where the windows of those lie inside the images.
    reach, last = plan.reach("y"), made.height - 1
    around = (
        sum(reach <= first + sign * n * stride <= last - reach for n in range(1, plan.margin + 1))
        for first, sign in ((plan.y[0], -1), (plan.y[-1], 1))
    )
    assert covered == len(plan.y) + sum(around) + 2 * plan.margin * (plan.bands - 1)
    assert np.ptp(made.read(0, 0, 0, 0, 9, 0, 9)) > 0


def test_unknown_case_names_the_known() -> None:
    with pytest.raises(UsageError, match="--case cube: there is no such case; choose affine-4d, affine-4d-stride4"):
        find_case("cube")


def test_profile_has_the_options_of_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("profile", "--help") == 0
    text = capsys.readouterr().out
    measured = [name for name in options.SETTINGS if name != "workers"]  # it measures in this process
    assert all(f"--{name.replace('_', '-')} " in text for name in (*measured, "config", "set"))
    assert all(name in text.replace("\n", " ") for name in CASES)


@pytest.mark.parametrize(
    ("args", "code", "part"),
    [
        ([], 2, "give CAPTURE or --case NAME"),
        (["x", "--case", "depth"], 2, "give CAPTURE or --case NAME"),
        (["--case", "cube"], 2, "there is no such case"),
        (["absent"], 4, "absent"),
        (["--case", "depth", "--window", "64"], 3, "window.size = '64'"),
        (["FOLDER", "--trace", "absent/t.json", "--model", "depth", "--preshift", "-3"], 6, "name another file"),
    ],
)
def test_refusals_are_one_line(
    args: list[str], code: int, part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(SCENE, tmp_path / "capture")
    assert call("profile", *[str(tmp_path / "capture") if arg == "FOLDER" else arg for arg in args]) == code
    text = capsys.readouterr().err
    assert part in text
    assert text.startswith("error: ")
    assert text.count("\n") == 1


def test_command_prints_json_and_leaves_the_folder_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_scene(SCENE, tmp_path / "capture")
    before = sorted(tmp_path.rglob("*"))
    line = ["profile", tmp_path / "capture", "--json", "--frames", 1, "--model", "depth", "--preshift", "-3"]
    assert call(*line, "--window", 9, "--set", "output.frames=2:9") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["prediction"]["frames"] == 7
    assert found["frames_measured"] == 1
    assert any(cost["stage"] == "read" for cost in found["stages"])
    assert sorted(tmp_path.rglob("*")) == before
