"""A good guest: under every host, in every environment, the same results, or one clear error."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from leafflow_ti import kernel_cache
from leafflow_ti.cli.main import main
from leafflow_ti.kernel_cache import cache_folder
from leafflow_ti.runtime import start

HERE = Path(__file__).parent
NEEDED = ("PATH", "SYSTEMROOT", "LD_LIBRARY_PATH")
"""Variables that a Python process cannot do without."""
QUADRANTS = ("kernel_compilation_manager", "qdc", "qdcache.qdb")
"""Where that engine keeps its kernels, how their names end, and what it knows of them."""


def said(script: str, *arguments: str, python: tuple[str, ...] = (), **more: Any) -> dict[str, Any]:
    """What a script of this folder prints."""
    done = subprocess.run(
        [sys.executable, *python, HERE / script, *arguments], capture_output=True, text=True, check=False, timeout=300,
        **more,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small cube, in a folder with blanks and letters of many languages."""
    folder = tmp_path_factory.mktemp("guest") / "ein Würfel 立方体"
    with pytest.raises(SystemExit) as end:
        main(["simulate", "cube", str(folder), "--size", "48x36", "--cameras", "3", "--frames", "5"])
    assert not end.value.code
    return folder


@pytest.fixture(scope="module")
def cache() -> str:
    """The folder of compiled kernels, so that tests share them."""
    folder = cache_folder()
    assert folder is not None
    return str(folder)


@pytest.fixture(scope="module")
def measured(capture: Path) -> str:
    """What this process measures."""
    sys.path.insert(0, str(HERE))
    from guest import measured

    return measured(str(capture))


@pytest.mark.skipif(sys.platform == "win32", reason="fork, and folders that are removed while they are used")
def test_threads_loops_forks_and_a_poor_environment(capture: Path, cache: str, measured: str, tmp_path: Path) -> None:
    """Warnings are errors, assertions are off, nothing is known of a home or a language, the current folder is gone,
    the standard input closed, new files are for their owner alone, and Taichi is told to use another device."""
    gone = tmp_path / "gone"
    gone.mkdir()

    def leave() -> None:
        os.chdir(gone)
        gone.rmdir()
        os.close(0)
        os.umask(0o077)

    environment = {name: os.environ[name] for name in NEEDED if name in os.environ}
    environment |= {"LC_ALL": "C", "TERM": "dumb", "NO_COLOR": "1", "TI_ARCH": "vulkan", "QD_ARCH": "vulkan",
                    "LEAFFLOW_TI_ARCH": "cpu", "LEAFFLOW_TI_ENGINE": os.environ.get("LEAFFLOW_TI_ENGINE", "taichi"),
                    "LEAFFLOW_TI_CACHE": cache, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}  # fmt: skip
    found = said("guest.py", str(capture), python=("-O", "-W", "error"), env=environment, preexec_fn=leave)
    fork = found.pop("fork")
    assert "spawn" in fork
    assert found == {"threads": [measured] * 3, "main": measured, "loop": measured, "device": "cpu"}


def test_a_host_that_has_initialised_the_engine(capture: Path, cache: str, measured: str, tmp_path: Path) -> None:
    own = shutil.copytree(cache, tmp_path / "kernels")  # what a host keeps is not ours to check
    path = os.pathsep.join([str(HERE), *(p for p in sys.path if p)])
    found = said("adopting_host.py", str(capture), str(own), env={**os.environ, "PYTHONPATH": path})
    assert found == {"main": measured, "threads": 1, "kept": [True, False, True, True]}


def test_kernels_are_kept_in_a_folder_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("LEAFFLOW_TI_CACHE", str(tmp_path / "new" / "kernels"))
    assert cache_folder() == tmp_path / "new" / "kernels"
    if os.name == "posix":
        assert (tmp_path / "new" / "kernels").stat().st_mode & 0o077 == 0
    assert caplog.records == []


@pytest.mark.parametrize("case", ["a file", "below a file", "for everybody"])
def test_a_folder_that_cannot_be_used_is_said(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    folder = {"a file": tmp_path / "file", "below a file": tmp_path / "file" / "kernels"}.get(case, tmp_path / "all")
    if case == "for everybody":
        if os.name != "posix":
            pytest.skip("modes are POSIX's")
        folder.mkdir()
        folder.chmod(0o777)
    monkeypatch.setenv("LEAFFLOW_TI_CACHE", str(folder))
    with caplog.at_level(logging.WARNING):
        assert cache_folder() is None
    (record,) = caplog.records
    assert str(folder) in record.message
    assert "LEAFFLOW_TI_CACHE" in record.message


@pytest.mark.parametrize(("below", "ending", "index"), [(".", "tic", kernel_cache.INDEX), QUADRANTS])
def test_damaged_kernels_are_removed(
    below: str, ending: str, index: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Bytes that change on a disk, which the engine would execute."""
    kernels = [tmp_path / below / name for name in (f"T1.{ending}", f"T2.{ending}", index)]
    kernel_cache.remove_damaged(tmp_path)

    def flush() -> None:
        (tmp_path / below).mkdir(exist_ok=True)
        for file in kernels:
            file.write_bytes(file.name.encode() * 1000)

    kernel_cache.write(tmp_path, flush)
    kernel_cache.remove_damaged(tmp_path)
    earlier = tmp_path / below / f"T3.{ending}"
    earlier.write_bytes(b"of an earlier version, without a checksum")
    kernel_cache.remove_damaged(tmp_path)
    assert all(file.exists() for file in kernels)
    assert caplog.records == []
    kernels[1].write_bytes(kernels[1].read_bytes()[:-1] + b"?")
    with caplog.at_level(logging.WARNING):
        kernel_cache.remove_damaged(tmp_path)
    assert f"T2.{ending}" in caplog.records[0].message
    assert not any(file.exists() for file in [*kernels, earlier])
    kernel_cache.write(tmp_path, flush)
    (tmp_path / kernel_cache.SUMS).write_text("[not JSON")
    kernel_cache.remove_damaged(tmp_path)
    assert all(file.exists() for file in kernels)


def test_the_engines_threads_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked for more than it was started with, it still has as many."""
    assert start("cpu", threads=1).threads == 1
    assert start("cpu", threads=4096).threads < 4096


STREAMS = {
    "a reader that leaves": "{program} info {capture} | true",
    "closed standard streams": "{program} info {capture} <&- >&- 2>&-",
}


@pytest.mark.skipif(sys.platform == "win32", reason="a POSIX shell")
@pytest.mark.parametrize("case", STREAMS)
def test_streams_that_nobody_reads(case: str, capture: Path) -> None:
    line = STREAMS[case].format(program=f"'{sys.executable}' -m leafflow_ti.cli.main", capture=f"'{capture}'")
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(("engine", "way_out"), [("tachi", "taichi and quadrants"), ("quadrants", "pip install")])
def test_an_engine_that_is_not_there(engine: str, way_out: str, tmp_path: Path) -> None:
    """Chosen by a name that no engine has, or not installed."""
    code = """
import sys
sys.modules["quadrants"] = None
from leafflow_ti.errors import DeviceError
from leafflow_ti.runtime import start
try:
    start("cpu")
except DeviceError as error:
    print(error)
"""
    environment = {**os.environ, "LEAFFLOW_TI_ENGINE": engine, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert done.stderr == ""
    (line,) = done.stdout.splitlines()
    assert f"'{engine}'" in line
    assert way_out in line
