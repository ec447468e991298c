"""Damaged results stores: one line, no wrong number; ``info --verify`` says what is damaged, a run mends it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_cli import call

from leafflow_ti.errors import InputError
from leafflow_ti.events import warnings_said
from leafflow_ti.results import UNFINISHED, ResultStore
from leafflow_ti.store_check import damaged, mend
from leafflow_ti.unit_marks import marked_maps

ROWS, COLS, BAND = 8, 16, 4
STD = 3
"""A unit in which no pixel has a standard error."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames of two units each; all are done."""
    path, rng = tmp_path_factory.mktemp("whole") / "out.zarr", np.random.default_rng(0)
    store = ResultStore.create(
        path, frames=[4, 5], y=np.arange(ROWS) + 10, x=np.arange(COLS), names=["depth", "depth_std"],
        chunk=(1, BAND, COLS), attrs={"device": "cpu"},
    )  # fmt: skip
    for unit in range(4):
        maps = {name: rng.normal(size=(BAND, COLS)).astype(np.float32) for name in store.names}
        if unit == STD:
            maps["depth_std"][:] = np.nan
        first = unit % 2 * BAND
        store.write_unit(unit, unit // 2, slice(first, first + BAND), maps, np.zeros((BAND, COLS), np.uint8))
    return path


@pytest.fixture
def path(whole: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(whole, tmp_path / "out.zarr"))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def lose(path: Path) -> None:
    path.unlink()


SPOILS = (cut, flip, empty, lose)


def line_of_info(path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """The one line that ``info`` answers with, exit code 4."""
    assert call("info", path, *options) == 4
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {path}")
    return line


@pytest.mark.parametrize("spoil", SPOILS)
@pytest.mark.parametrize("name", ["zarr.json", "depth/zarr.json", "status/zarr.json", "t/zarr.json", "y/c/0", "t/c/0"])
def test_a_store_that_cannot_be_opened_is_one_line(
    path: Path, name: str, spoil: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(path / name)
    said = line_of_info(path, capsys)
    assert "is damaged (" in said
    assert said.endswith("): restore it from a copy, or run again with --overwrite")
    with pytest.raises(InputError):
        ResultStore.open(path)


@pytest.mark.parametrize("content", ["null", "[]", '{"zarr_format": 3, "node_type": "group", "attributes": []}'])
def test_metadata_of_another_kind_is_one_line(path: Path, content: str, capsys: pytest.CaptureFixture[str]) -> None:
    (path / "zarr.json").write_text(content, encoding="utf-8")
    assert "is damaged (" in line_of_info(path, capsys)


def test_a_map_of_another_size_is_one_line(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No memory is taken for it, however large."""
    metadata = json.loads((path / "depth/zarr.json").read_text())
    metadata["shape"] = [2, ROWS, 10**12]
    (path / "depth/zarr.json").write_text(json.dumps(metadata))
    assert "its array depth has another form" in line_of_info(path, capsys)


def test_lost_markers_are_one_line(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(path / "status" / ".done")
    line_of_info(path, capsys)


@pytest.mark.parametrize("spoil", [cut, flip, empty])
@pytest.mark.parametrize("name", ["depth", "status"])
def test_a_spoilt_chunk_is_never_read(
    path: Path, name: str, spoil: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(path / name / "c/1/0/0")
    assert line_of_info(path, capsys).endswith(f"'leafflow-ti info {path} --verify' says which units are")
    store = ResultStore.open(path)
    assert np.isfinite(store.read(name, 0)).all()
    with pytest.raises(InputError, match="is damaged"):
        store.read(name, 1)


@pytest.mark.parametrize("spoil", SPOILS)
def test_verify_says_which_units_are_damaged(
    path: Path, spoil: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(path / "depth/c/0/1/0")
    spoil(path / "status/c/1/0/0")
    assert call("info", path, "--verify") == 4
    said = capsys.readouterr()
    _, first, second = said.out.splitlines()
    reason = "has lost its file" if spoil is lose else "cannot be decoded: its file was cut, or has changed since"
    assert first.split()[:5] == ["1", "4", "14", "to", "17"]
    assert f"depth {reason}" in first
    assert second.split()[:5] == ["2", "5", "10", "to", "13"]
    assert f"status {reason}" in second
    assert said.err.startswith(f"error: {path}: 2 of 4 units are damaged; 'run --resume --verify' with the same")
    assert call("info", path, "--verify", "--json") == 4
    found = json.loads(capsys.readouterr().out)["damaged"]
    assert [(d["unit"], d["frame"], d["rows"], d["array"]) for d in found] == [
        (1, 4, [14, 17], "depth"), (2, 5, [10, 13], "status"),
    ]  # fmt: skip


def test_a_chunk_of_another_size_is_damage(path: Path) -> None:
    shutil.copy(path / "status/c/0/0/0", path / "depth/c/0/0/0")
    (found,) = damaged(ResultStore.open(path))
    assert found.reason == f"holds {BAND * COLS} bytes instead of {4 * BAND * COLS}"


def test_whole_results_are_said_to_be(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Maps without values have no file; foreign entries are nobody's damage."""
    assert not (path / "depth_std/c/1/1/0").exists()
    (path / "notes.txt").write_text("mine")
    (path / "pictures").mkdir()
    (path / "status/.done/99").touch()
    assert damaged(ResultStore.open(path)) == []
    assert call("info", path, "--verify") == 0
    said = capsys.readouterr()
    assert "units        4 of 4 done\nfiles        all that the units have written is whole" in said.out
    assert said.err == ""
    assert call("info", path, "--verify", "--json") == 0
    assert json.loads(capsys.readouterr().out)["damaged"] == []


def test_only_what_is_done_is_verified(path: Path) -> None:
    cut(path / "depth/c/0/0/0")
    (path / "status/.done/0").unlink()
    assert damaged(ResultStore.open(path)) == []


def test_markers_list_the_files_of_a_unit(path: Path) -> None:
    assert marked_maps(path, 0) == {"depth", "depth_std", "status"}
    assert marked_maps(path, STD) == {"depth", "status"}


def test_mending_makes_damaged_units_undone(path: Path) -> None:
    store = ResultStore.open(path)
    with warnings_said() as said:
        mend(store)
    assert (said, store.done()) == ([], {0, 1, 2, 3})
    flip(path / "depth/c/0/1/0")
    lose(path / "depth_std/c/0/1/0")
    with warnings_said() as said:
        mend(store)
    assert store.done() == {0, 2, 3}
    assert len(said) == 2
    assert "depth_std of unit 1 (frame 4) has lost its file; it is computed again" in said[1]


def test_maps_that_were_added_must_be_made_again(path: Path) -> None:
    """What was derived from a unit that is computed again, and what is spoilt itself; the run's own units stay."""
    store = ResultStore.open(path).add_maps(["area_rate"])
    for t in range(2):
        store.write_maps(t, {"area_rate": np.ones((ROWS, COLS), np.float32)})
    store = store.finish_maps({})
    flip(path / "area_rate/c/1/1/0")
    mend(store)
    assert store.done() == {0, 1, 2, 3}
    assert store.attrs[UNFINISHED] == ["area_rate"]
    mended = ResultStore.open(path)
    assert mended.names == ("depth", "depth_std")
    assert any("leafflow-ti growth" in remark for remark in mended.remarks)


def test_verify_is_for_stores(tmp_path: Path, path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "capture.toml").write_text("")
    assert call("info", tmp_path / "capture.toml", "--verify") == 2
    assert "--verify reads the files of a results store" in capsys.readouterr().err
    assert call("run", tmp_path, "-o", path, "--verify") == 2
    assert "give --resume, too" in capsys.readouterr().err


def test_a_damaged_store_can_be_replaced(path: Path) -> None:
    attributes: dict[str, Any] = {"device": "cpu"}
    empty(path / "zarr.json")
    ResultStore.create(
        path, frames=[0], y=[0], x=[0, 1], names=["depth"], chunk=(1, 1, 2), attrs=attributes, overwrite=True
    )
    assert ResultStore.open(path).frames == (0,)
