"""Who may write a store: one run alone, or shards of one run; what is left behind by the killed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.errors import RunError, UsageError
from leafflow_ti.kernel_cache import LOCKS, remove_stale_lock
from leafflow_ti.locks import FOLDER, abandoned, alone, as_shard
from leafflow_ti.placing import put_in_place, remove_abandoned
from leafflow_ti.results import ResultStore


def make(path: Path, overwrite: bool = False) -> ResultStore:
    rows, columns = np.arange(4), np.arange(3)
    return ResultStore.create(
        path, frames=[0], y=rows, x=columns, names=["depth"], chunk=(1, 4, 3), attrs={}, overwrite=overwrite
    )


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return make(tmp_path / "out.zarr").path


def test_one_run_alone(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("leafflow_ti.locks.PATIENCE_S", 0.1)
    with alone(store):
        with pytest.raises(RunError, match=r"out\.zarr is being written by another run: wait"), alone(store):
            pass
        with pytest.raises(RunError, match="another run"), as_shard(store, 1, 2):
            pass
        with pytest.raises(RunError, match="another run"):
            make(store, overwrite=True)
    with alone(store):
        pass
    assert ResultStore.open(store).names == ("depth",)


def test_shards_of_one_run_together(store: Path) -> None:
    with as_shard(store, 1, 2), as_shard(store, 2, 2):
        for other, by in (
            (lambda: as_shard(store, 1, 2), "shard 1 of 2 already"),
            (lambda: as_shard(store, 3, 3), "shard 1 of 2"),
            (lambda: alone(store), "shard 1 of 2"),
        ):
            refused(other, by)
    with as_shard(store, 3, 3), pytest.raises(RunError, match="shard 3 of 3"), alone(store):
        pass
    with alone(store):
        pass


def refused(entered: Callable[[], AbstractContextManager[None]], by: str) -> None:
    with pytest.raises(RunError, match=by), entered():
        pass


HOLD = """
import sys
from pathlib import Path
from leafflow_ti.locks import alone
with alone(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_the_killed_hold_nothing(store: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(store)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(RunError, match="another run"), alone(store):
            pass
        assert not abandoned(store)
        other.kill()
        other.wait()
    with alone(store):
        pass


def test_a_second_new_store_does_not_replace_the_first(store: Path, tmp_path: Path) -> None:
    """Two runs have found no store, and both have made one."""
    later = make(tmp_path / "other").path
    assert not put_in_place(later, store, overwrite=False)
    assert ResultStore.open(later).path.exists()
    with pytest.raises(UsageError, match="exists"):
        make(store)


def test_what_the_killed_left_beside_a_store_goes(store: Path, tmp_path: Path) -> None:
    left = make(tmp_path / "made").path.rename(tmp_path / ".out.zarr.12345-0123abcd")
    old = make(tmp_path / "old").path.rename(tmp_path / ".out.zarr.12345-0123abce.old")
    young = tmp_path / ".out.zarr.12345-0123abcf"  # killed before it had its lock, or about to have it
    forgotten = tmp_path / ".out.zarr.12345-0123abc0"
    foreign = tmp_path / ".out.zarr.my-backup"
    for folder in (young, forgotten, foreign):
        folder.mkdir()
    os.utime(forgotten, (0, 0))
    os.utime(foreign, (0, 0))
    with alone(left):
        remove_abandoned(store)
    assert [p.exists() for p in (left, old, young, forgotten, foreign)] == [True, False, True, False, True]
    remove_abandoned(store)
    assert not left.exists()
    assert store.exists()


def test_locks_are_out_of_the_way_of_readers(store: Path) -> None:
    with alone(store):
        assert FOLDER.parts[0] == "status"
        assert ResultStore.open(store).done() == set()


@pytest.mark.parametrize("name", LOCKS)
def test_the_engine_s_lock_that_a_killed_process_has_left(name: str, tmp_path: Path) -> None:
    lock = tmp_path / name
    lock.parent.mkdir(exist_ok=True)
    lock.touch()
    remove_stale_lock(tmp_path)
    assert lock.exists()  # somebody may hold it
    os.utime(lock, (0, 0))
    remove_stale_lock(tmp_path)
    assert not lock.exists()
    remove_stale_lock(tmp_path)
