"""``info`` of a results store at a glance: its runs, what was given up and why, what was said."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_cli import call

from leafflow_ti.progress import Timings
from leafflow_ti.results import ResultStore

REASON = "cam_02/frame_010.tif: ends early, 120 of 4000 bytes"


def record(started: str, ended: str, units: int, python: str = "3.11.7") -> dict[str, Any]:
    """A row of the attribute ``runs``."""
    timings = Timings(12.5, {"solve": 9.0}, units, 6 * units, units / 2, 1, "cpu (2 threads)")
    return {"id": started, "started": started, "executor": "2 processes", "versions": {"python": python},
            "timings": timings.to_json(), "ended": ended}  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> ResultStore:
    """Two frames of two units each, one of them given up, after two runs."""
    runs = [record("2026-05-31T20:00:00+00:00", "", 1), record("2026-06-01T07:30:00+00:00", "partly done", 2)]
    missing = [{"unit": 3, "frame": 8, "rows": [12, 13], "reason": REASON, "attempts": 3}]
    store = ResultStore.create(
        tmp_path / "out.zarr", frames=[7, 8], y=[10, 11, 12, 13], x=[0, 1, 2], names=["depth"], chunk=(1, 2, 3),
        attrs={"config": 'model = "depth"', "runs": runs, "missing": missing, "warnings": ["images are dark"],
               "input_files": "eNp9"},
    )  # fmt: skip
    for unit in range(3):
        first = unit % 2 * 2
        maps = {"depth": np.full((2, 3), 100.0, np.float32)}
        store.write_unit(unit, unit // 2, slice(first, first + 2), maps, np.zeros((2, 3), np.uint8))
    return store


def test_runs_and_missing_units_are_tables(store: ResultStore, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("info", store.path) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "units        3 of 4 done: go on with run --resume" in lines
    assert "warning      images are dark" in lines
    at = lines.index("runs")
    assert lines[at + 1 : at + 4] == [
        "  started                    executor     device           units  seconds  ended",
        "  2026-05-31T20:00:00+00:00  2 processes  cpu (2 threads)  1      12.5     works, or was killed",
        "  2026-06-01T07:30:00+00:00  2 processes  cpu (2 threads)  2      12.5     partly done",
    ]
    at = lines.index("units that were given up")
    assert lines[at + 1].split() == ["unit", "frame", "rows", "attempts", "reason"]
    assert lines[at + 2] == f"  3     8      12 to 13  3         {REASON}"
    assert '  model = "depth"' in lines
    assert not {"warnings", "missing", "measured_maps", "timings", "input_files", "  eNp9"} & set(lines)


def test_json_has_all(store: ResultStore, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("info", store.path, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["attributes"] == store.attrs
    assert facts["attributes"]["missing"][0]["reason"] == REASON
    assert (facts["units_done"], facts["units"]) == (3, 4)


def test_other_versions_are_told(store: ResultStore, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("info", store.path) == 0
    assert "not all with the same versions" not in capsys.readouterr().out
    store.update_attrs({"runs": [record("a", "done", 1), record("b", "done", 1, python="3.12.1")]})
    assert call("info", store.path) == 0
    assert "not all with the same versions" in capsys.readouterr().out


def test_many_warnings_are_cut_short(store: ResultStore, capsys: pytest.CaptureFixture[str]) -> None:
    store.update_attrs({"warnings": [f"image {n} is dark" for n in range(20)]})
    assert call("info", store.path) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
    assert lines[0] == "warning      image 0 is dark"
    assert (len(lines), lines[-1]) == (10, "warning      ... 11 more: see --json")
