"""The perf runner: it lists its cases, refuses unknown ones, and shows figures as text and JSON."""

from __future__ import annotations

import importlib
import json
import math
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.api import estimate
from leafflow_ti.errors import InputError, RunError
from leafflow_ti.runtime import start
from leafflow_ti.synthetic.leaves import LeavesScene
from perf import compare, cotton, leaves, packages, ratio, scaling, scipy_twin, sequence, stages
from perf.__main__ import main
from perf.bench import Scene, Timed
from perf.cases import CASES, Case
from perf.figures import Figure, Outcome, to_json, to_text
from perf.fresh import fresh_run
from perf.inputs import VARIABLE, read_pfm
from perf.stage_tables import Tables

REAL = ("hci-cotton", "tsukuba", "yosemite", "hypocotyl")


def test_the_runner_lists_every_case(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [case.name for case in CASES]
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_case_has_its_function(case: Case) -> None:
    assert callable(case.load())


def test_an_unknown_case_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["table-3.2"])
    assert stopped.value.code == 2
    assert "table-3.1" in capsys.readouterr().err


@pytest.mark.parametrize("name", REAL)
def test_absent_data_is_skipped_with_a_reason(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert main([name, "--out", str(tmp_path)]) == 0
    assert f"{name}: skipped: {tmp_path}" in capsys.readouterr().out


def test_a_figure_is_met_up_to_its_reference_and_down_to_its_low() -> None:
    assert Figure("a", 1.0).met is None
    assert Figure("a", 1.0, reference=1.0).met is True
    assert Figure("a", 1.1, reference=1.0).met is False
    assert Figure("a", 0.5, reference=1.0, low=0.8).met is False
    assert Figure("a", math.nan, reference=1.0).met is False
    assert Figure("a", 21.0, low=20.0).met is True
    assert Figure("a", 19.0, low=20.0).met is False
    assert Figure("a", math.nan, low=20.0).met is False


def test_text_and_json_say_the_same() -> None:
    outcome = Outcome((Figure("error", 2.0, "mm", 1.0, "printed"), Figure("share", math.nan)), {"window": 9}, ("note",))
    text = to_text("case", outcome, 1.5)
    assert "NOT MET" in text
    assert "0 of 1 met" in text
    found = json.loads(to_json("case", outcome, 1.5))
    assert found["settings"] == {"window": 9}
    assert [figure["value"] for figure in found["figures"]] == [2.0, None]
    assert found["figures"][0]["met"] is False


SMALL = Scene(out_px=24, window=21, sigma=6.0)


def by_name(outcome: Outcome) -> dict[str, Figure]:
    """The figures, all of them numbers."""
    assert all(math.isfinite(figure.value) for figure in outcome.figures)
    return {figure.name: figure for figure in outcome.figures}


def job(stride: int) -> compare.Job:
    capture = SMALL.capture()
    return compare.Job(capture, SMALL.plan(capture, stride=stride), Timed(1, 1, 1, 1, 1, 5), stride)


@pytest.mark.parametrize("stride", [1, 3])
def test_numpy_and_scipy_find_our_maps(stride: int) -> None:
    one = job(stride)
    field = estimate(one.capture, **SMALL.options(one.capture, stride=stride))
    for windowing in (scipy_twin.by_correlation, scipy_twin.by_products):
        maps = scipy_twin.estimate(one.block(), one.plan, scipy_twin.Clock(), windowing)
        assert {"depth", "slope_y_std", "velocity_z_std", "rotation_x", "flow_y"} <= set(maps)
        for figure in compare._agreement(field, maps, ""):
            assert figure.met, figure


def test_numpy_and_scipy_time_every_stage() -> None:
    one, clock = job(1), scipy_twin.Clock()
    scipy_twin.estimate(one.block(), one.plan, clock)
    assert list(clock.seconds) == ["filter", "tensor", "null space", "errors and fit"]
    assert clock.total == pytest.approx(clock.stages + clock.seconds["errors and fit"])


@pytest.mark.parametrize("name", compare.TWINS)
@pytest.mark.parametrize("stride", [1, 3])
def test_twins_of_the_three_stages_find_our_tensors_and_parameters(name: str, stride: int) -> None:
    pytest.importorskip({"numba": "numba", "PyTorch": "torch"}[name])
    home, kind = compare.TWINS[name]
    one = job(stride)
    twin = getattr(importlib.import_module(home), kind)(one.plan, 1)
    images = one.block(2)[:, 0]
    maps = twin.stack([twin.filter(np.ascontiguousarray(images[i : i + 5])) for i in range(5)])
    tensor = twin.tensor(maps)
    assert compare._parameter_difference(twin.solve(tensor), np.asarray(tensor), one.plan) < compare.SAME_PARAMETERS
    columns, sampling, layout = one.plan.problem.columns, one.plan.problem.sampling, one.plan.layout
    channels = scipy_twin.derivatives(one.block(), columns, sampling)
    products = scipy_twin.products(channels, one.plan, sampling)
    exact = scipy_twin.windows(
        products, scipy_twin.texture(channels, sampling), one.plan, scipy_twin.by_correlation
    ).packed
    lower = [(i, j) for i in range(columns.n) for j in range(i + 1)]
    for entry, (i, j) in zip(layout.lower, lower, strict=True):
        diagonal = [exact[layout.lower[lower.index((k, k))]] for k in (i, j)]
        # Some 1e3 float32 roundings of 6e-8 each add up like a random walk.
        assert (np.abs(np.asarray(tensor[entry]) - exact[entry]) / np.sqrt(diagonal[0] * diagonal[1])).max() < 5e-6


def test_twins_refuse_models_that_they_do_not_cover() -> None:
    capture = SMALL.capture()
    with pytest.raises(ValueError, match="affine-4d with 5 taps"):
        Tables.of(SMALL.plan(capture, brightness="camera"))


@pytest.mark.parametrize("peer", [*packages.PEERS_2D, *packages.PEERS_3D], ids=lambda peer: peer.name)
def test_packages_compute_the_same_tensors(peer: packages._Peer) -> None:
    module = pytest.importorskip(peer.module)
    small = packages.Settings(image_px=96, volume_px=48, frames=24, repeats=1)
    channels = "xyt" if peer in packages.PEERS_3D else "xy"
    figures = {f.name: f for f in packages._compare(start(), small, peer, module, channels)}
    assert figures[f"{peer.name}: largest difference"].met


def test_stages_are_put_beside_the_ceilings() -> None:
    found = by_name(stages.measure(stages.Settings(SMALL, strides=(2,), brightness=("none",), repeats=1)))
    for letter in "ABC":
        assert found[f"{letter}, share of the multiply-add peak, 12 columns, stride 2"].value > 0
    for stage in ("splines", "refine"):
        assert 0 < found[f"{stage}, share of the multiply-add peak"].value < 1
    assert 1 <= found["refinement: steps of a pixel"].value <= 2 * 3


def test_a_fresh_process_tells_units_and_memory(tmp_path: Path) -> None:
    images = sequence.write_images(tmp_path / "images", (160, 64), 10)
    run = fresh_run(images, tmp_path / "out.zarr", {**sequence.MODEL, "window": 15, "stride": 4, "tile": 16})
    assert len(run.units) == 2
    assert run.bands == 1
    assert run.pixels == 2 * 40 * 16
    assert 0 < run.units[0] < run.units[1]
    assert run.peak_mib > run.planned_mib > 0


def test_a_fresh_process_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"missing\.toml"):
        fresh_run(tmp_path / "missing.toml", tmp_path / "out.zarr", sequence.MODEL)


def test_both_models_of_the_ratio_are_timed() -> None:
    found = by_name(ratio.measure(ratio.Settings(SMALL, strides=(4,), repeats=1)))
    one, other = (found[f"{model}, stride 4"].value for model in ratio.MODELS)
    assert found["affine-scene-flow over affine-4d, stride 4"].value == pytest.approx(other / one)


def test_leaves_are_put_beside_themselves_alone(tmp_path: Path) -> None:
    scene = LeavesScene(
        size=(101, 81), n_cols=3, n_frames=5, leaves=1, disparity_px=(3.0, 6.0), motion_px=2.0, supersampling=1
    )
    outcome = leaves.measure(leaves.Settings(scene, window=17, stride=6, refine=0), tmp_path)
    found = by_name(outcome)
    assert 50 < found["all leaves, depth"].value <= 100
    assert found["leaf 1, depth: error of the leaf alone, rms"].value < 0.01 * scene.plants[0].surface.centre[2]
    assert outcome.pictures[0].exists()


def test_discontinuities_are_where_the_truth_jumps() -> None:
    truth = np.tile(np.where(np.arange(40) < 20, 0.0, 0.5), (30, 1)) + 0.01 * np.arange(40)
    near = cotton.discontinuities(truth, 3)
    assert near[:, 16:24].all()
    assert not near[:, :15].any()
    assert not near[:, 25:].any()


def test_scaling_draws_every_panel(tmp_path: Path) -> None:
    small = scaling.Settings(
        16, (16, 24), (9,), (17,), (1,), (5.0, 6.0), 2, (("flow", {"model": "flow"}),), repeats=1
    )  # fmt: skip
    outcome = scaling.measure(small, tmp_path)
    by_name(outcome)
    text = outcome.pictures[0].read_text(encoding="utf-8")
    assert text.count('id="axes_') == 6


def test_pfm_rows_run_bottom_up(tmp_path: Path) -> None:
    path = tmp_path / "map.pfm"
    path.write_bytes(b"Pf\n2 2\n-1.0\n" + np.array([[3, 4], [1, 2]], "<f4").tobytes())
    np.testing.assert_array_equal(read_pfm(path), [[1, 2], [3, 4]])
    path.write_bytes(b"PF\n2 2\n-1.0\n")
    with pytest.raises(InputError, match=r"map\.pfm: not a grey PFM"):
        read_pfm(path)
