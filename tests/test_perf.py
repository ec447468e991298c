"""The perf runner: it lists its cases, refuses unknown ones, and shows figures as text and JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.errors import InputError
from perf import stages
from perf.__main__ import main
from perf.cases import CASES, Case
from perf.figures import Figure, Outcome, to_json, to_text
from perf.inputs import VARIABLE, read_pfm

REAL = ("hci-cotton", "yosemite", "hypocotyl")


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


def test_text_and_json_say_the_same() -> None:
    outcome = Outcome((Figure("error", 2.0, "mm", 1.0, "printed"), Figure("share", math.nan)), {"window": 9}, ("note",))
    text = to_text("case", outcome, 1.5)
    assert "NOT MET" in text
    assert "0 of 1 met" in text
    found = json.loads(to_json("case", outcome, 1.5))
    assert found["settings"] == {"window": 9}
    assert [figure["value"] for figure in found["figures"]] == [2.0, None]
    assert found["figures"][0]["met"] is False


def test_the_scipy_twin_computes_what_is_timed() -> None:
    settings = stages.Settings(out_px=8, window=21, sigma=6.0, strides=(1,), repeats=1, crop_px=6)
    figures = {figure.name: figure for figure in stages.measure(settings).figures}
    assert figures["largest difference of the disparities"].met
    assert all(math.isfinite(figure.value) for figure in figures.values())


def test_pfm_rows_run_bottom_up(tmp_path: Path) -> None:
    path = tmp_path / "map.pfm"
    path.write_bytes(b"Pf\n2 2\n-1.0\n" + np.array([[3, 4], [1, 2]], "<f4").tobytes())
    np.testing.assert_array_equal(read_pfm(path), [[1, 2], [3, 4]])
    path.write_bytes(b"PF\n2 2\n-1.0\n")
    with pytest.raises(InputError, match=r"map\.pfm: not a grey PFM"):
        read_pfm(path)
