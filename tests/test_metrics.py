"""Error measures on cases computed by hand, and the command ``evaluate``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from leafflow_ti.cli.evaluate import format_reports
from leafflow_ti.cli.main import main
from leafflow_ti.errors import InputError
from leafflow_ti.metrics import (
    aae,
    angle,
    coverage,
    endpoint_error,
    erode,
    evaluate,
    label_regions,
    normal_error,
    principal,
    read_truth,
    sample_maps,
    summarise,
)
from leafflow_ti.results import ResultStore


def test_aae_of_flow_and_motion() -> None:
    np.testing.assert_allclose(aae([[0.0, 0.0], [1.0, 0.0]], [[1.0, 0.0], [1.0, 0.0]]), [45.0, 0.0], atol=1e-12)
    assert aae([1.0, 0.0], [0.0, 1.0]) == pytest.approx(60.0)
    assert aae([1.0, 1.0, 1.0], [0.0, 0.0, 0.0]) == pytest.approx(60.0)
    assert np.isnan(aae([np.nan, 0.0, 0.0], [0.0, 0.0, 0.0]))


def test_small_angles_are_exact() -> None:
    assert aae([1e-10, 0.0], [0.0, 0.0]) == pytest.approx(np.degrees(1e-10), rel=1e-6)
    assert angle([1.0, 0.0], [-1.0, 0.0]) == pytest.approx(180.0)


def test_endpoint_and_normal_errors() -> None:
    np.testing.assert_allclose(endpoint_error([[3.0, 4.0], [1.0, 1.0]], [[0.0, 0.0], [1.0, 1.0]]), [5.0, 0.0])
    assert normal_error(1.0, 0.0, 0.0, 0.0) == pytest.approx(45.0)
    assert normal_error(1.0, 0.0, -1.0, 0.0) == pytest.approx(90.0)


def test_summary() -> None:
    found = summarise([-1.0, 2.0, 5.0, np.nan, np.inf])
    assert found is not None
    assert (found.n, found.mean, found.median, found.median_abs) == (3, 2.0, 2.0, 2.0)
    assert found.std == pytest.approx(np.sqrt(6.0))
    assert found.p95_abs == pytest.approx(4.7)
    assert summarise([np.nan]) is None


def test_coverage() -> None:
    found = coverage(
        [1.5, -1.0, 4.0, 1.0, 9.0, 9.0], [1.0, 1.0, 1.0, np.nan, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0, 0.0, np.nan]
    )
    assert found is not None
    assert found.n == 3
    assert found.mean == pytest.approx(0.5)
    assert found.std == pytest.approx(np.std([0.5, -2.0, 3.0]))
    assert (found.within_1, found.within_2) == (pytest.approx(1 / 3), pytest.approx(2 / 3))
    assert coverage([1.0], [1.0], [0.0]) is None


def test_erode() -> None:
    mask = np.ones((6, 7), np.bool_)
    mask[0, 3] = False
    wanted = np.ones((6, 7), np.bool_)
    wanted[:3, 1:6] = False
    np.testing.assert_array_equal(erode(mask, 2), wanted)
    np.testing.assert_array_equal(erode(mask, 0), mask)
    assert not erode(mask, 9).any()


def test_regions_are_labels_with_and_without_border() -> None:
    face = np.array([[0, 1, 1, 1, 2]] * 3)
    regions = label_regions({"face": face, "depth": face * 1.0}, margin=1)
    assert list(regions) == ["all", "face 1", "face 1, interior", "face 2", "face 2, interior"]
    np.testing.assert_array_equal(regions["face 1, interior"], [[False, False, True, False, False]] * 3)
    np.testing.assert_array_equal(regions["face 2"], face == 2)
    assert not regions["face 2, interior"].any()
    assert list(label_regions({"region": face}, margin=0)) == ["all", "region 1", "region 2"]


def test_evaluate_by_hand() -> None:
    shape = (2, 2)
    truth = {
        "depth": np.array([[10.0, 10.0], [10.0, np.nan]]),
        "zx": np.zeros(shape),
        "zy": np.zeros(shape),
        "velocity": np.zeros((*shape, 3)),
        "omega": np.zeros((*shape, 3)),
    }
    estimate = {
        "depth": np.array([[11.0, 9.0], [np.nan, 5.0]]),
        "depth_std": np.full(shape, 0.8),
        "slope_x": np.ones(shape),
        "slope_y": np.zeros(shape),
        "velocity_x": np.ones(shape),
        "velocity_y": np.zeros(shape),
        "velocity_z": np.zeros(shape),
        "velocity_z_std": np.ones(shape),
        "rotation_x": np.zeros(shape),
    }
    masks = {"all": np.ones(shape, np.bool_), "left": np.array([[True, False]] * 2), "none": np.zeros(shape, np.bool_)}
    reports = evaluate(estimate, truth, masks)
    assert list(reports) == ["all", "left"]
    report = reports["all"]
    assert report.pixels == 4
    assert set(report.errors) == {
        "velocity_aae_deg",
        "velocity_endpoint_mm",
        "depth_mm",
        "slope_x_deg",
        "slope_y_deg",
        "normal_deg",
    }
    assert report.errors["depth_mm"].n == 2
    assert report.errors["depth_mm"].mean == pytest.approx(0.0)
    assert report.errors["depth_mm"].median_abs == pytest.approx(1.0)
    assert report.errors["velocity_aae_deg"].mean == pytest.approx(45.0)
    assert report.errors["velocity_endpoint_mm"].mean == pytest.approx(1.0)
    assert report.errors["slope_x_deg"].mean == pytest.approx(45.0)
    assert report.errors["slope_y_deg"].std == 0.0
    assert report.errors["normal_deg"].mean == pytest.approx(45.0)
    assert set(report.coverage) == {"depth", "velocity_z"}
    assert report.coverage["depth"].std == pytest.approx(1.25)
    assert report.coverage["depth"].within_1 == 0.0
    assert report.coverage["depth"].within_2 == 1.0
    assert reports["left"].errors["depth_mm"].mean == pytest.approx(1.0)


def test_growth_is_compared_in_percent() -> None:
    estimate = {"growth_rate": np.array([[0.5, 0.1]]), "growth_rate_std": np.array([[0.2, 0.1]])}
    report = evaluate(estimate, {"growth_rate": np.zeros((1, 2))}, {"all": np.ones((1, 2), np.bool_)})["all"]
    assert (report.errors["growth_rate_percent"].mean, report.errors["growth_rate_percent"].std) == pytest.approx(
        (0.3, 0.2)
    )
    assert report.coverage["growth_rate"].mean == pytest.approx(1.75)
    row = next(line for line in format_reports({"all": report}) if "growth_rate [%/frame]" in line)
    assert row.split()[2:4] == ["2", "0.3"]


def test_strain_is_compared_by_component() -> None:
    estimate = {"strain_rate_22": np.array([[0.3, 0.1]]), "strain_rate_22_std": np.array([[0.1, 0.1]])}
    truth = {"strain_rate": np.array([[[0.0, 0.1, 0.0], [0.0, 0.1, 5.0]]])}
    report = evaluate(estimate, truth, {"all": np.ones((1, 2), np.bool_)})["all"]
    assert set(report.errors) == {"strain_rate_22_percent"}
    assert report.errors["strain_rate_22_percent"].mean == pytest.approx(0.1)
    assert report.coverage["strain_rate_22"].mean == pytest.approx(1.0)


def test_principal_axes_of_a_known_tensor() -> None:
    for turn in (-1.5, -0.4, 0.0, 0.7, 1.5):
        c, s = np.cos(turn), np.sin(turn)
        tensor = np.array([0.3 * c * c + 0.1 * s * s, 0.3 * s * s + 0.1 * c * c, 0.2 * c * s])
        np.testing.assert_allclose(principal(tensor), [0.3, 0.1, turn], atol=1e-12)
    assert principal([0.2, 0.2, 0.0]).tolist()[:2] == [0.2, 0.2]
    assert np.isnan(principal([0.2, 0.2, 0.0])[2])


def test_growth_from_motion_is_compared_with_its_truth() -> None:
    """Area, surface strain and both sets of principal axes; directions are the same after half a turn."""
    truth = {
        "growth_rate": np.array([[0.1, 0.1, 0.1]]),
        "strain_rate": np.array([[[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.05, 0.05, 0.0]]]),
        "surface_strain": np.array([[[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.05, 0.05, 0.0]]]),
    }
    estimate = {
        "area_rate": np.array([[0.12, 0.1, 0.09]]),
        "surface_strain_11": np.array([[0.13, 0.0, 0.05]]),
        "surface_principal_1": np.array([[0.13, 0.1, 0.05]]),
        "surface_angle": np.array([[0.1, -np.pi / 2 + 0.2, 1.0]]),
        "surface_angle_std": np.array([[0.1, 0.1, 0.1]]),
        "principal_rate_2": np.array([[0.02, 0.02, 0.05]]),
        "principal_rate_2_std": np.array([[0.01, 0.01, 0.01]]),
        "principal_angle": np.array([[3.0, 1.5, np.nan]]),
    }
    report = evaluate(estimate, truth, {"all": np.ones((1, 3), np.bool_)})["all"]
    means = {name: (found.n, round(found.mean, 9)) for name, found in report.errors.items()}
    assert means == {
        "area_rate_percent": (3, round(0.01 / 3, 9)),
        "surface_strain_11_percent": (3, 0.01),
        "surface_principal_1_percent": (3, 0.01),
        "surface_angle_deg": (2, round(np.degrees(0.15), 9)),  # none where strain is alike in all directions
        "principal_rate_2_percent": (3, round(0.04 / 3, 9)),
        "principal_angle_deg": (2, round(np.degrees(0.5 * (3.0 - np.pi + 1.5 - np.pi / 2)), 9)),
    }
    assert report.coverage["surface_angle"].mean == pytest.approx(1.5)
    assert report.coverage["principal_rate_2"].within_1 == pytest.approx(1 / 3)
    table = "\n".join(format_reports({"all": report}))
    assert "surface_angle [°]" in table
    assert "area_rate [%/frame]" in table


def test_evaluate_needs_something_in_common() -> None:
    everywhere = {"all": np.ones((1, 1), np.bool_)}
    with pytest.raises(InputError, match="nothing to compare"):
        evaluate({"flow_x": np.zeros((1, 1))}, {"depth": np.zeros((1, 1))}, everywhere)
    with pytest.raises(InputError, match="no pixel of all has truth"):
        evaluate({"depth": np.zeros((1, 1))}, {"depth": np.full((1, 1), np.nan)}, everywhere)


def test_one_omega_belongs_to_the_pixels_with_truth(tmp_path: Path) -> None:
    np.savez(tmp_path / "truth.npz", depth=np.array([[1.0, np.nan]]), omega=np.array([1.0, 2.0, 3.0]))
    truth = read_truth(tmp_path / "truth.npz")
    np.testing.assert_array_equal(truth["omega"], [[[1.0, 2.0, 3.0], [np.nan] * 3]])


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"colour": np.zeros((2, 2))}, "none of depth"),
        ({"omega": np.zeros(3)}, "no map per pixel"),
        ({"depth": np.zeros((2, 2)), "velocity": np.zeros((2, 2))}, r"velocity has the shape \(2, 2\)"),
        ({"depth": np.zeros((2, 2)), "zx": np.zeros((2, 3))}, "zx has the shape"),
        ({"depth": np.zeros((2, 2)), "omega": np.zeros((3, 2))}, "omega has the shape"),
        ({"depth": np.zeros((2, 2)), "face": np.zeros((2, 2))}, "labels are integers"),
        ({"depth": np.array([["a", None]], dtype=object)}, "no readable"),
    ],
)
def test_truth_is_checked(arrays: dict[str, Any], says: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "truth.npz", **arrays)
    with pytest.raises(InputError, match=says):
        read_truth(tmp_path / "truth.npz")


@pytest.mark.parametrize("content", [None, b"", b"no archive"])
def test_truth_must_be_readable(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "truth.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"truth\.npz"):
        read_truth(tmp_path / "truth.npz")


def test_truth_may_be_a_lone_array(tmp_path: Path) -> None:
    np.save(tmp_path / "truth.npy", np.zeros((2, 2)))
    with pytest.raises(InputError, match="no readable"):
        read_truth(tmp_path / "truth.npy")


def test_sampling_at_the_positions_of_a_result() -> None:
    truth = {"depth": np.arange(12.0).reshape(3, 4), "f_px": np.array(1.0)}
    np.testing.assert_array_equal(
        sample_maps(truth, np.array([0, 2]), np.array([1, 3]))["depth"], [[1.0, 3.0], [9.0, 11.0]]
    )
    with pytest.raises(InputError, match="4 x 3"):
        sample_maps(truth, np.array([0, 3]), np.array([1]))


# --- evaluate --------------------------------------------------------------------------------------------------------


@pytest.fixture
def case(tmp_path: Path) -> Path:
    """Folder with results of frames 3 and 4 at stride 2, 0.5 mm wrong in frame 4, and a truth of frame 4."""
    y, x = np.arange(0, 6, 2), np.arange(1, 9, 2)
    names = ["depth", "depth_std"]
    config = "[window]\nsize = 5\n"
    store = ResultStore.create(
        tmp_path / "o.zarr", frames=[3, 4], y=y, x=x, names=names, chunk=(1, 3, 4), attrs={"config": config}
    )
    for index, error in enumerate((7.0, 0.5)):
        maps = {"depth": np.full((3, 4), 100.0 + error, np.float32), "depth_std": np.full((3, 4), 1.0, np.float32)}
        store.write_unit(index, index, slice(0, 3), maps, np.zeros((3, 4), np.uint8))
    face = np.zeros((6, 9), np.int32)
    face[:, 4:] = 1
    np.savez(tmp_path / "truth.npz", depth=np.full((6, 9), 100.0), face=face, frame=4)
    return tmp_path


def run_evaluate(case: Path, *args: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["evaluate", str(case / "o.zarr"), "--truth", str(case / "truth.npz"), *args])
    return int(end.value.code or 0)


def test_command_as_json(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_evaluate(case, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["frame"], found["margin_px"]) == (4, 2)
    assert {name: region["pixels"] for name, region in found["regions"].items()} == {
        "all": 12,
        "face 1": 6,
        "face 1, interior": 3,
    }
    assert found["regions"]["all"]["errors"]["depth_mm"]["mean"] == 0.5
    assert found["regions"]["all"]["coverage"]["depth"]["mean"] == 0.5
    assert run_evaluate(case, "--json", "--frame", "3", "--margin", "0") == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found["regions"]) == ["all", "face 1"]
    assert found["regions"]["all"]["errors"]["depth_mm"]["mean"] == 7.0


def test_command_as_table(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_evaluate(case) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "frame 4; interior: at least 2 px" in lines[0]
    assert "face 1, interior: 3 px with truth" in lines
    row = next(line.split() for line in lines if line.startswith("  depth [mm]"))
    assert row == ["depth", "[mm]", "12", "0.5", "0", "0.5", "0.5", "0.5"]
    row = next(line.split() for line in lines if line.startswith("  depth  "))
    assert row == ["depth", "12", "0.500", "0.000", "100.0%", "100.0%"]


def test_command_refuses(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_evaluate(case, "--frame", "9") == 4
    assert "holds frames 3..4, not 9" in capsys.readouterr().err
    assert run_evaluate(case, "--margin", "-1") == 2
    np.savez(case / "truth.npz", depth=np.zeros((6, 9)))
    assert run_evaluate(case) == 2
    assert "give --frame" in capsys.readouterr().err
    (case / "truth.npz").unlink()
    assert run_evaluate(case) == 4
    assert capsys.readouterr().err.count("\n") == 1
