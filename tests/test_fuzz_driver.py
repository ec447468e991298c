"""The driver of ``python -m perf fuzz`` sees trials that fail, hang, die and take too much memory, and goes on."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("resource", reason="caps on memory need POSIX")
from perf.fuzz import driver

KIND = """
import os, time
from leafflow_ti.errors import InputError
from perf.fuzz.trial import Defect, Kind, refused

def prepare(seeds):
    numbers = iter(range(9))
    def trial(rng, folder):
        (folder / "number").write_text(str(rng.integers(1000)))
        way = int(os.environ["WAYS"].split()[next(numbers)])
        if way == 1:
            raise ValueError("escaped")
        if way == 2:
            os.kill(os.getpid(), 9)
        if way == 3:
            time.sleep(60)
        if way == 4:
            bytearray(2**30)
        if way == 5:
            try:
                raise InputError("two\\nlines")
            except InputError as error:
                return refused(error, "lines")
        return "values"
    return trial

KIND = Kind("hostile", prepare, memory=2**28)
"""


def test_whatever_a_trial_does_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hostile_kind.py").write_text(KIND, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(driver.__file__).parents[2]}")
    monkeypatch.setattr(driver, "TIMEOUT_S", 1.0)
    monkeypatch.setattr(driver, "STARTUP_S", 60.0)
    monkeypatch.setenv("WAYS", "0 1 4 5 3")
    tally = driver.fuzz("hostile_kind:KIND", 5, 7, tmp_path / "kept")
    assert tally.outcomes == {"values": 1, "defect": 4}
    assert [text.splitlines()[-1] for text in tally.defects.values()] == [
        "ValueError: escaped",
        "asked for more memory than the cap",
        "an error that is not one readable line: 'two\\nlines'",
        "no answer within 1 s",
    ]
    kept = tmp_path / "kept" / "hostile_kind:KIND-7-1"
    assert (kept / "number").exists()
    assert "Traceback" in (kept / "defect.txt").read_text(encoding="utf-8")
    monkeypatch.setenv("WAYS", "2")
    assert driver.fuzz("hostile_kind:KIND", 1, 7, tmp_path / "kept").defects == {0: "the process died: SIGKILL"}
