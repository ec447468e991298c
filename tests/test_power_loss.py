"""Power that fails, and a disk that is full, at any step of a run: the results open, and resume to equal bytes."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from perf.kills.faulty_disk import SURVIVALS, Recorder, Tree
from perf.kills.power import SCENARIOS, sweep

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be held open there")

MOST = 4
"""Trials of each kind; ``python -m perf power-loss`` makes all."""


@pytest.mark.parametrize("name", SCENARIOS)
def test_nothing_is_lost_at_any_step(name: str) -> None:
    found = sweep(SCENARIOS[name], MOST, mixtures=1)
    assert min(found.states, found.deaths, found.refusals) > 1
    assert found.defects == []


@pytest.mark.parametrize("step", ["chunk_files.flush", "results.flush_tree"])
def test_a_program_that_forgets_to_force_files_out_is_found(step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"leafflow_ti.{step}", lambda path: None)
    assert sweep(SCENARIOS["new store"], 2, mixtures=0).defects


def test_what_a_power_loss_leaves(tmp_path: Path) -> None:
    def left(recorder: Recorder, survival: str) -> Tree:
        return recorder.moments[-1].tree(SURVIVALS[survival])

    def flush(path: Path) -> None:
        handle = os.open(path, os.O_RDONLY)
        os.fsync(handle)
        os.close(handle)

    (tmp_path / "old").write_bytes(b"1")
    with Recorder(tmp_path) as unsynced:
        (tmp_path / "new").write_bytes(b"22")
        (tmp_path / "new").replace(tmp_path / "old")
    assert left(unsynced, "what was synced") == {"old": b"1"}
    assert left(unsynced, "all names") == {"old": b""}
    assert left(unsynced, "everything") == {"old": b"22"}
    assert unsynced.moments[-1].tree(lambda kind: 1 if kind == "names" else 0.5) == {"old": b"2"}
    with Recorder(tmp_path) as synced:
        (tmp_path / "folder").mkdir()
        (tmp_path / "folder" / "file").write_bytes(b"333")
        flush(tmp_path / "folder" / "file")
        flush(tmp_path)
    assert left(synced, "what was synced") == {"old": b"22", "folder": {}}
    assert left(synced, "all names") == {"old": b"22", "folder": {"file": b"333"}}
