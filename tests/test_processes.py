"""What the parent of worker processes does with all they may do. The workers here compute nothing: ``fake_worker``."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from small_plane import SCENE, capture_of, config

import leafflow_ti as lf
from leafflow_ti.errors import ConfigError, DeviceError, InputError, LeafflowError, RunError
from leafflow_ti.events import warnings_said
from leafflow_ti.executors.processes import DEATHS, STARTS, Processes, visible_gpus
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.schedule import ATTEMPTS, Schedule
from leafflow_ti.synthetic.write import write_scene

FAKE = Path(__file__).parent / "fake_worker.py"
UNITS = range(8)
Make = Callable[..., Processes]


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, lf.Capture]:
    folder = tmp_path_factory.mktemp("processes") / "capture"
    write_scene(SCENE, folder)
    capture = lf.open_capture(folder)
    return make_plan(capture, config()), capture


@pytest.fixture
def make(planned: tuple[Plan, lf.Capture], tmp_path: Path) -> Make:
    """``make(workers, start=..., dies=..., ...)``: workers that behave so."""

    def make(workers: int = 2, **behaviour: Any) -> Processes:
        command = [sys.executable, str(FAKE), json.dumps(behaviour)]
        return Processes(*planned, tmp_path / "out.zarr", workers, command)

    return make


@dataclass
class Run:
    """Units that were done, in their order, and a schedule of four batches."""

    done: list[int] = field(default_factory=list)
    marked: Iterable[int] = ()
    """Units that are done in the store, whoever says so."""

    def __post_init__(self) -> None:
        self.schedule = Schedule([UNITS], self.done.append, workers=2, fill=4)

    def work(self, executor: Processes) -> None:
        store: Any = SimpleNamespace(done=lambda: {*self.done, *self.marked})
        executor.work(self.schedule, store)

    @property
    def missing(self) -> dict[int, tuple[str, int]]:
        return {m.unit: (m.failure.message, m.attempts) for m in self.schedule.missing}


def pids(executor: Processes) -> list[int]:
    return [seat.child.pid for seat in executor._seats if seat.child]


def assert_gone(pids: list[int]) -> None:
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_units_are_computed_once_whatever_workers_print(make: Make) -> None:
    run = Run()
    with warnings_said() as said, make(warns="dust on the lens") as executor:
        executor.wait_for(2)
        run.work(executor)
        workers = pids(executor)
    assert sorted(run.done) == list(UNITS)
    assert run.missing == {}
    assert said == ["dust on the lens"]
    assert executor.compile_seconds == 2.0
    assert_gone(workers)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_unit_that_kills_its_workers_is_given_up(make: Make, workers: int) -> None:
    run = Run()
    with make(workers, dies=[3]) as executor:
        run.work(executor)
    assert sorted(run.done) == [0, 1, 2, 4, 5, 6, 7]
    message, attempts = run.missing[3]
    assert message.startswith("its worker died (signal 9: ")
    assert attempts == ATTEMPTS


def test_what_a_worker_had_done_before_it_died_is_not_computed_again(make: Make) -> None:
    run = Run(marked=[3])
    with make(dies=[3]) as executor:
        run.work(executor)
    assert sorted(run.done) == list(UNITS)
    assert not run.schedule.disturbed


def test_failures_come_through(make: Make) -> None:
    run = Run()
    broken = "cam_00/frame_003.tif: cut off"
    with make(fails={"3": (broken, 4), "4": (broken, 4), "6": ("unexpected KeyError: 'x'", None)}) as executor:
        run.work(executor)
    assert sorted(run.done) == [0, 1, 2, 5, 7]
    assert {unit: message for unit, (message, _) in run.missing.items()} == {
        3: broken,
        4: broken,
        6: "unexpected KeyError: 'x'",
    }
    assert isinstance(run.schedule.missing[0].failure.error(), InputError)


def test_what_spoils_every_unit_ends_the_run(make: Make) -> None:
    with make(fails={"2": ("out.zarr: cannot be written (No space left on device)", 6)}) as executor:
        workers = pids(executor)
        with pytest.raises(RunError, match="No space left"):
            Run().work(executor)
    assert_gone(workers)


def test_workers_that_die_and_die_end_a_run_without_results(make: Make) -> None:
    run = Run()
    with make(1, dies=list(UNITS)) as executor, pytest.raises(RunError, match=rf"{DEATHS} workers have died.*signal 9"):
        run.work(executor)
    assert run.done == []


@pytest.mark.parametrize(
    ("start", "error", "text"),
    [
        ("raise MemoryError('tables')", RunError, f"started {STARTS} times.*exit code 1: MemoryError: tables"),
        ("say('failed', message='cuda: no device', exit_code=5); sys.exit()", DeviceError, "^cuda: no device$"),
        ("say('failed', message='x.tif: gone', exit_code=4); sys.exit()", InputError, r"^x\.tif: gone$"),
    ],
)
def test_workers_that_cannot_begin_are_an_error(make: Make, start: str, error: type[LeafflowError], text: str) -> None:
    with pytest.raises(error, match=text):
        make(start=start).__enter__()


def test_a_run_goes_on_with_the_workers_that_can_begin(make: Make, tmp_path: Path) -> None:
    """Only whoever makes the file does."""
    run = Run()
    with warnings_said() as said, make(start=f"open({str(tmp_path / 'only')!r}, 'x')") as executor:
        run.work(executor)
        while not said:
            executor._listen()
    assert sorted(run.done) == list(UNITS)
    assert len(said) == 1
    assert "goes on without worker" in said[0]


def test_an_interrupt_ends_workers_that_are_busy(make: Make) -> None:
    executor, run = make(hangs=[1, 3, 5, 7]), Run()
    workers: list[int] = []

    def interrupt(unit: int) -> None:
        workers.extend(pids(executor))
        raise KeyboardInterrupt

    run.schedule = Schedule([UNITS], interrupt, workers=2, fill=4)
    with pytest.raises(KeyboardInterrupt), executor:
        run.work(executor)
    assert len(workers) == 2
    assert_gone(workers)


def test_a_program_that_cannot_be_started(planned: tuple[Plan, lf.Capture], tmp_path: Path) -> None:
    with pytest.raises(RunError, match="a worker cannot be started"):
        Processes(*planned, tmp_path / "out.zarr", 2, [str(tmp_path / "nowhere")]).__enter__()


def test_images_in_memory_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"plan\.workers at 1"):
        lf.run(capture_of(SCENE), tmp_path / "out.zarr", config(workers=2))
    assert list(tmp_path.iterdir()) == []


def test_gpus_are_dealt_out(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,GPU-5f")
    assert visible_gpus() == ["3", "GPU-5f"]
    with make(3) as executor:
        executor.wait_for(3)
        devices = [seat.device for seat in executor._seats]
    assert devices == ["gpu 3", "gpu GPU-5f", "gpu 3"]


@pytest.mark.skipif(os.name == "nt", reason="the program is a shell script")
def test_gpus_are_counted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    program = tmp_path / "nvidia-smi"
    for lines, found in (("GPU 0: H\nGPU 1: H", ["0", "1"]), ("No devices were found", [])):
        program.write_text(f"#!/bin/sh\necho '{lines}'\n")
        program.chmod(0o755)
        assert visible_gpus() == found


@pytest.mark.parametrize(("workers", "threads", "each"), [(1, "auto", 8), (3, "auto", 2), (16, "auto", 1), (3, 4, 4)])
def test_the_machine_is_shared(workers: int, threads: object, each: int) -> None:
    plan = config(workers=workers, threads=threads, max_memory="3G").plan
    assert plan.threads_each(8) == each
    assert plan.memory_for_all(plan.memory_each) == pytest.approx(3 * 2**30, abs=workers)
    assert plan.memory_each > 0.9 * 3 * 2**30 / workers


def test_the_limit_that_is_asked_for_is_enough(planned: tuple[Plan, lf.Capture]) -> None:
    with pytest.raises(ConfigError, match=r"need \d+M in 3 workers") as refused:
        make_plan(planned[1], config(workers=3, max_memory="500M"))
    least = int(re.findall(r"need (\d+)M", str(refused.value))[0])
    make_plan(planned[1], config(workers=3, max_memory=f"{least}M"))
    with pytest.raises(ConfigError):
        make_plan(planned[1], config(workers=3, max_memory=f"{least - 3}M"))


@pytest.mark.parametrize("workers", [0, -1, "auto", 1.5, True])
def test_workers_are_counted_in_whole_ones(workers: object) -> None:
    with pytest.raises(ConfigError, match=r"plan\.workers = .*must be an integer >= 1"):
        config(workers=workers)
