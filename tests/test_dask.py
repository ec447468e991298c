"""Runs on Dask clusters: who computed what, and who died over it, changes no byte."""

from __future__ import annotations

import contextlib
import json
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import dask_faults
import numpy as np
import pytest
from small_plane import SCENE, capture_of, config, files_of
from test_cli import call

import leafflow_ti as lf
from leafflow_ti.errors import ConfigError, InputError, MissingExtra, PartlyDone, RunError, UsageError
from leafflow_ti.executors import cluster, cluster_client, cluster_worker
from leafflow_ti.progress import Progress
from leafflow_ti.results import ResultStore
from leafflow_ti.synthetic.write import write_scene
from leafflow_ti.worker import Job

distributed = pytest.importorskip("distributed")
HANG_S = 120.0
"""How long something is waited for that must happen: a busy machine takes its time."""
needs_kill = pytest.mark.skipif(os.name == "nt", reason="kills by a signal of POSIX")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of which five frames can be measured."""
    folder = tmp_path_factory.mktemp("dask") / "capture"
    write_scene(replace(SCENE, bits=8), folder)
    return folder


@pytest.fixture(scope="module")
def workers(folder: Path) -> Iterator[Any]:
    """A cluster of two workers, 0 and 1, that compute nothing: see ``dask_faults``."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, memory_limit=None, silence_logs=logging.CRITICAL,
        scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
        preload=[dask_faults.__file__], env={dask_faults.VARIABLE: str(folder.parent / "faults.json")},
    ) as found:  # fmt: skip
        yield found


@pytest.fixture
def client(workers: Any) -> Iterator[Any]:
    with distributed.Client(workers, set_as_default=False) as found:
        found.wait_for_workers(2, HANG_S)
        yield found


@pytest.fixture
def faults(folder: Path) -> Iterator[Callable[..., None]]:
    """Says what goes wrong in the workers: see ``dask_faults``."""
    path = folder.parent / "faults.json"
    yield lambda **kinds: path.write_text(json.dumps(kinds)) and None
    path.unlink(missing_ok=True)


def wait_until(what: Callable[[], bool]) -> None:
    end = time.monotonic() + HANG_S
    while not what():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.02)


def assert_whole(out: Path) -> ResultStore:
    """Every unit was computed, wherever that was."""
    store = ResultStore.open(out)
    depth = store.read("depth")
    rows = np.arange(store.y.size) // store.unit_rows
    units = np.arange(len(store.frames))[:, None] * store.bands + rows
    np.testing.assert_array_equal(depth, np.broadcast_to(units[:, :, None], depth.shape))
    return store


@needs_kill
def test_real_workers_write_the_same_bytes_even_if_one_is_killed(folder: Path, tmp_path: Path) -> None:
    """Nothing remains of a local cluster."""
    before = set(multiprocessing.active_children())

    def ours() -> list[Any]:
        return [child for child in multiprocessing.active_children() if child not in before]

    def kill_one(progress: Progress) -> None:
        if progress.done_units == 1:
            os.kill(ours()[0].pid, signal.SIGKILL)

    lf.run(folder, tmp_path / "alone.zarr", config(tile=16))
    lf.run(folder, tmp_path / "out.zarr", config(tile=16, workers=2), dask="local", progress=kill_one)
    assert files_of(tmp_path / "out.zarr") == files_of(tmp_path / "alone.zarr")
    assert ours() == []


@needs_kill
def test_a_unit_that_kills_its_workers_is_left_out(
    folder: Path, client: Any, faults: Callable[..., None], tmp_path: Path
) -> None:
    """The cluster survives it, and the client stays its user's."""
    out = tmp_path / "out.zarr"
    faults(deadly=[7])
    with pytest.raises(PartlyDone, match=r"1 of 15 units .*: its worker died; mend that"):
        lf.run(folder, out, config(tile=16), dask=client)
    (missing,) = ResultStore.open(out).attrs["missing"]
    assert (missing["unit"], missing["attempts"]) == (7, 3)
    assert client.status == "running"
    faults()
    lf.run(folder, out, config(tile=16), dask=client, resume=True)
    attrs = assert_whole(out).attrs
    assert [r["ended"] for r in attrs["runs"]] == ["partly done", "done"]
    assert attrs["runs"][1]["timings"]["stages"]["write"] == 1.0
    assert attrs["missing"] == []
    assert "127.0.0.1" not in json.dumps(attrs), "addresses have no place there"


def test_workers_that_do_not_see_the_capture_are_not_used(
    folder: Path, client: Any, faults: Callable[..., None], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    faults(blind=[0], slow=0.1)
    with caplog.at_level(logging.WARNING, "leafflow_ti"):
        summary = lf.run(folder, tmp_path / "out.zarr", config(tile=16), dask=client)
    assert (summary.device, summary.compile_seconds) == ("2 x nothing", 1.0)
    record = assert_whole(tmp_path / "out.zarr").attrs["runs"][0]
    assert record["executor"] == "Dask, 2 workers"
    assert record["timings"]["stages"] == {"compile": 1.0, "write": 15.0}
    assert "goes on without a worker: worker tcp://" in caplog.text
    faults(blind=[0, 1])
    with pytest.raises(InputError, match=r"worker tcp://.*capture\.toml: no such file .workers must see"):
        lf.run(folder, tmp_path / "none.zarr", config(tile=16), dask=client)
    assert not (tmp_path / "none.zarr").exists()


def test_an_interrupted_run_leaves_its_cluster_idle(
    folder: Path, client: Any, faults: Callable[..., None], tmp_path: Path
) -> None:
    """What was computed meanwhile is kept."""
    out = tmp_path / "out.zarr"
    faults(slow=0.3)

    def interrupt(progress: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lf.run(folder, out, config(tile=16), dask=client.scheduler.address, progress=interrupt)
    wait_until(lambda: not any(client.processing().values()))
    faults()
    lf.run(folder, out, config(tile=16), dask=client, resume=True)
    runs = assert_whole(out).attrs["runs"]
    assert [r["ended"] for r in runs] == ["interrupted", "done"]
    assert runs[0]["timings"]["units"] < 15


# --- what cannot be asked for ----------------------------------------------------------------------------------------


def test_nobody_answers(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_client, "ANSWER_S", 0.5)
    with pytest.raises(RunError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9 within 0\.5 s: start one"):
        lf.run(folder, tmp_path / "out.zarr", config(), dask="tcp://127.0.0.1:9")
    assert not (tmp_path / "out.zarr").exists()


@pytest.mark.parametrize("address", ["nonsense", "", "http://", "127.0.0.1", "tls://127.0.0.1:9"])
def test_what_is_no_address(folder: Path, tmp_path: Path, address: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("run", folder, "-o", tmp_path / "out.zarr", "--refine=0", "--preshift=0", "--dask", address) == 2
    assert capsys.readouterr().err.startswith("error: --dask ")


def test_a_cluster_without_workers(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "WORKERLESS_S", 0.2)
    with (
        distributed.LocalCluster(
            n_workers=0, silence_logs=logging.CRITICAL,
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
        ) as empty,
        pytest.raises(RunError, match=r"the Dask cluster at tcp://.* had no worker for 0\.2 s: start some"),
    ):  # fmt: skip
        lf.run(folder, tmp_path / "out.zarr", config(), dask=empty.scheduler_address)


@pytest.mark.parametrize("deaths", [2, 3])
def test_local_workers_that_die_before_they_are_there(deaths: int, monkeypatch: pytest.MonkeyPatch) -> None:
    usual, starts = distributed.LocalCluster, []

    def dying(**options: Any) -> Any:
        starts.append(options)
        if len(starts) <= deaths:
            raise RuntimeError("Nanny failed to start.")  # as Dask says it
        return usual(**options)

    monkeypatch.setattr(distributed, "LocalCluster", dying)
    with contextlib.ExitStack() as inside:
        if deaths == 3:
            inside.enter_context(pytest.raises(RunError, match=r"started 3 times, .* \(Nanny failed to start\): use"))
        client = inside.enter_context(cluster_client.connected("local", config(workers=1).plan))
        assert len(client.nthreads()) == 1
    assert len(starts) == 3


def test_what_workers_cannot_share(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out.zarr"
    with pytest.raises(ConfigError, match="images in memory cannot be shared"):
        lf.run(capture_of(SCENE), out, config(), dask="local")
    with pytest.raises(UsageError, match="--shard and --dask exclude each other"):
        lf.run(folder, out, config(), dask="local", shard=(1, 2))
    with pytest.raises(ConfigError, match=r"output\.mask = 'mask\.tif': workers of a cluster have other current"):
        cluster._check_paths(config(mask="mask.tif"))
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"leafflow-ti\[dask\]"):
        lf.run(folder, out, config(), dask="local")


# --- inside a worker -------------------------------------------------------------------------------------------------


@pytest.fixture
def order(monkeypatch: pytest.MonkeyPatch) -> cluster_worker.Order:
    monkeypatch.setattr(cluster_worker, "Worker", dask_faults.FakeWorker)
    monkeypatch.setattr(cluster_worker, "_kept", None)
    return "run", Job("capture.toml", "out.zarr", "").to_json()


def test_a_batch_that_nobody_wants_ends_after_a_unit(
    order: cluster_worker.Order, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_faults.ResultStore, "open", lambda out: out)
    monkeypatch.setattr(dask_faults, "write", lambda store, unit: None)
    unwanted = threading.Event()
    answer = cluster_worker._computed(order, [3, 4], unwanted)
    assert answer["done"] == [3, 4]
    assert answer["seconds"] == {"compile": 1.0, "write": 2.0}
    unwanted.set()
    answer = cluster_worker._computed(order, [5, 6], unwanted)
    assert answer["done"] == [5]
    assert cluster_worker._kept is None, "nor does anybody want what was prepared for it"


def test_a_process_that_took_the_place_of_another_computes_nothing(order: cluster_worker.Order) -> None:
    answer = cluster_worker.compute(order, "one that died", [3])
    assert set(answer) == {"process"}
    assert answer["process"] != "one that died"


def test_what_was_prepared_belongs_to_one_run(order: cluster_worker.Order) -> None:
    """The same capture may hold other images when it is measured again."""
    first = cluster_worker._run(order)
    assert cluster_worker._run(order) is first
    assert cluster_worker._run(("later", order[1])) is not first
    assert first.untold()["compile"] == 1.0
    assert first.untold()["compile"] == 0.0


def wait_for_cancelling(began: str, ended: str) -> None:
    """A task."""
    cancelled = cluster_worker._task_cancelled()
    Path(began).touch()
    wait_until(cancelled)
    Path(ended).touch()


def test_a_task_learns_that_it_is_cancelled(client: Any, tmp_path: Path) -> None:
    began, ended = tmp_path / "began", tmp_path / "ended"
    task = client.submit(wait_for_cancelling, str(began), str(ended))
    wait_until(began.exists)
    task.cancel()
    wait_until(ended.exists)
