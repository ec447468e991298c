"""Nothing is sent, nothing is executed that lies in data, and results say no more of a machine than the docs do."""

from __future__ import annotations

import json
import os
import pickle
import platform
import re
import socket
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import zarr
from no_network import SYSCALLS

from leafflow_ti.cli.main import main

COMMANDS = """\
simulate cube cube --size 72x48 --cameras 3 --frames 5
run cube -o out.zarr --model affine-4d --refine 0 --window 11 --log-file log.jsonl
growth out.zarr
evaluate out.zarr --truth cube/truth.npz
export out.zarr --to netcdf -o out.nc
export out.zarr --to csv -o out-csv
report out.zarr -o out.html
info out.zarr
"""
ENGINES = {"taichi", "quadrants"}
"""Their folders of the user's cache, which they make when they are imported."""
EXPLAINED = (
    r"ctypes\.dlopen \(None,\)",  # the C library that is there already
    r"subprocess\.Popen \('uname', \['uname', '-p'\], None, None\)",  # platform.processor()
    r"subprocess\.Popen \('fc-list', .*",  # matplotlib looks for fonts, once per user
    r"socket\.__new__ \(<socket\.socket fd=-1, .*>, 1, 1, 0\)",  # AF_UNIX: asyncio wakes itself, inside zarr
)


@pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() not in SYSCALLS, reason="filters of system calls are Linux's"
)
def test_nothing_is_sent_and_nothing_private_is_written(tmp_path: Path) -> None:
    home = tmp_path / "home-of-somebody"
    home.mkdir()
    secret = {"HOME": str(home), "USER": "somebody-private", "LOGNAME": "somebody-private", "TOKEN": "secret-4711"}
    kept = os.environ.get("LEAFFLOW_TI_CACHE") or str(Path.home() / ".cache/leafflow-ti/kernels")
    work = tmp_path / "work"
    work.mkdir()
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("no_network.py")], input=COMMANDS, capture_output=True, text=True,
        cwd=work, check=False, timeout=300,
        env={**os.environ, **secret, "LEAFFLOW_TI_CACHE": kept, "PYTHONPATH": os.pathsep.join(sys.path),
             "MPLCONFIGDIR": matplotlib.get_cachedir()},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    if done.stdout.startswith("skip"):
        pytest.skip(done.stdout)
    unexplained = [line for line in done.stdout.splitlines() if line and not any(map(_match(line), EXPLAINED))]
    assert unexplained == []

    private = [*secret.values(), str(tmp_path), socket.gethostname()]
    private = [text.encode() for text in private if len(text) > 3]  # a host called "vm" would be found anywhere
    written = [path for path in work.rglob("*") if path.is_file()]
    assert {"out.nc", "out.html", "log.jsonl", "zarr.json"} <= {path.name for path in written}
    for path in written:
        assert [text for text in private if text in path.read_bytes()] == [], path
    assert [path for path in home.rglob("*") if path.is_file() and not ENGINES & {*path.parts}] == []
    assert sorted(path.name for path in (work / "cube").iterdir() if not path.name.startswith("cam_")) == [
        "capture.toml",
        "truth.npz",
    ]


def _match(line: str) -> Callable[[str], object]:
    return lambda pattern: re.fullmatch(pattern, line)


class Bomb:
    """Unpickled, it writes a file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[object, ...]:
        return Path.write_text, (self.file, "executed")


def _truth_with_objects(folder: Path, bomb: Bomb) -> list[str]:
    with zipfile.ZipFile(folder / "truth.npz", "w") as archive, archive.open("depth.npy", "w") as file:
        np.lib.format.write_array(file, np.array([[bomb]], object), allow_pickle=True)
    return ["evaluate", str(_store(folder)), "--truth", str(folder / "truth.npz")]


def _truth_that_is_a_pickle(folder: Path, bomb: Bomb) -> list[str]:
    (folder / "truth.npz").write_bytes(pickle.dumps(bomb))
    return ["evaluate", str(_store(folder)), "--truth", str(folder / "truth.npz")]


def _labels_with_objects(folder: Path, bomb: Bomb) -> list[str]:
    np.save(folder / "labels.npy", np.array([[bomb]], object), allow_pickle=True)
    return ["regions", str(_store(folder)), "--labels", str(folder / "labels.npy"), "-o", str(folder / "out.csv")]


def _calibration_with_code(folder: Path, bomb: Bomb) -> list[str]:
    (folder / "camera.yml").write_text(f"camera_matrix: !!python/object/apply:os.system ['touch {bomb.file}']\n")
    (folder / "capture.toml").write_text(
        '[images]\npattern = "cam_{sx}.tif"\n[camera]\ncalibration = "camera.yml"\n[grid]\nbaseline_mm = [1.0, 1.0]\n'
    )
    return ["info", str(folder)]


def _store_with_pickles(folder: Path, bomb: Bomb) -> list[str]:
    """A chunk that is a pickle, and metadata that say so."""
    store = _store(folder)
    metadata = store / "x" / "zarr.json"
    about = json.loads(metadata.read_text())
    about["codecs"] = [{"name": "numcodecs.pickle", "configuration": {"id": "pickle"}}]
    metadata.write_text(json.dumps(about))
    (store / "x" / "c" / "0").write_bytes(pickle.dumps(bomb))
    return ["info", str(store)]


def _old_store_with_pickles(folder: Path, bomb: Bomb) -> list[str]:
    """A store of Zarr's earlier format, which has a codec of pickles."""
    group = zarr.create_group(folder / "old.zarr", zarr_format=2, attributes={"leafflow_ti_format": 1})
    for axis in ("t", "y", "x", "status"):
        group.create_array(axis, shape=(1,), dtype="i8")
        metadata = folder / "old.zarr" / axis / ".zarray"
        about = json.loads(metadata.read_text())
        metadata.write_text(json.dumps({**about, "dtype": "|O", "filters": [{"id": "pickle"}], "compressor": None}))
        (folder / "old.zarr" / axis / "0").write_bytes(pickle.dumps(np.array([bomb], object)))
    return ["info", str(folder / "old.zarr")]


def _store(folder: Path) -> Path:
    """An empty results store of 4 x 4 pixels."""
    from leafflow_ti.results import ResultStore

    ResultStore.create(folder / "out.zarr", frames=[0], y=range(4), x=range(4), names=["depth"], chunk=(1, 4, 4),
                       attrs={})  # fmt: skip
    return folder / "out.zarr"


HOSTILE = (
    _truth_with_objects,
    _truth_that_is_a_pickle,
    _labels_with_objects,
    _calibration_with_code,
    _store_with_pickles,
    _old_store_with_pickles,
)


@pytest.mark.parametrize("make", HOSTILE, ids=lambda make: make.__name__.strip("_"))
def test_data_is_never_executed(
    make: Callable[[Path, Bomb], list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bomb = Bomb(tmp_path / "executed")
    words = make(tmp_path, bomb)
    with pytest.raises(SystemExit) as end:
        main(words)
    text = capsys.readouterr().err
    assert not bomb.file.exists()
    assert end.value.code == 4, text
    assert text.startswith("error: ")
    assert text.count("\n") == 1
    assert "unexpected" not in text
