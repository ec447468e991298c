"""What the soak tells of a series of samples: flat ones pass, each kind of leak is seen, what settles first is not."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from perf.soak import Sample, figures_of

N = 200


def flat(n: int) -> Sample:
    """A process that takes more memory now and then, and files while it writes."""
    return Sample(0.2 * n, 0.1 * n, 170.0 + (n % 7 == 0), 7 + n % 3, 9)


LEAKS: dict[str, Callable[[int], Sample]] = {
    "memory": lambda n: Sample(0.2 * n, 0.1 * n, 170.0 + 0.05 * n, 7, 9),
    "open files": lambda n: Sample(0.2 * n, 0.1 * n, 170.0, 7 + n // 30, 9),
    "threads": lambda n: Sample(0.2 * n, 0.1 * n, 170.0, 7, 9 + n // 100),
    "CPU time": lambda n: Sample(0.2 * n, 0.1 * n * (1 + n / N), 170.0, 7, 9),
}


def missed(sample: Callable[[int], Sample]) -> list[str]:
    return [f.name.removeprefix("s: ") for f in figures_of("s", [sample(n) for n in range(N)]) if not f.met]


@pytest.mark.skipif(sys.platform != "linux", reason="memory and open files are told by Linux alone")
def test_a_sample_tells_of_this_process(tmp_path: Path) -> None:
    before = Sample.now(time.perf_counter())
    with (tmp_path / "open").open("w"):
        after = Sample.now(time.perf_counter() - 1.0)
    assert after.seconds >= 1.0
    assert after.cpu >= before.cpu > 0.0
    assert after.rss_mib > 10.0
    assert after.files == before.files + 1
    assert after.threads >= 1


def test_flat_series_pass() -> None:
    assert missed(flat) == []
    assert missed(lambda n: flat(n) if n >= N // 10 else Sample(0.3 * n, 0.1 * n, 30.0 * n, 99, 99)) == []


@pytest.mark.parametrize("leak", LEAKS)
def test_leaks_are_seen(leak: str) -> None:
    found = missed(LEAKS[leak])
    assert len(found) == 1
    assert found[0].startswith(leak)
