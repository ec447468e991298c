"""The cache of decoded images: bounded, shared by threads, and no source of other values."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from test_capture import FILES, IMAGES, describe, write_files

from leafflow_ti.capture import open_capture
from leafflow_ti.capture.cache import ImageCache
from leafflow_ti.errors import InputError


@pytest.mark.parametrize("options", [{}, {"tile": (16, 16)}, {"compression": "zlib"}])
def test_bounded_cache_gives_the_same_values_from_several_threads(tmp_path: Path, options: dict[str, object]) -> None:
    write_files(tmp_path, **options)
    describe(tmp_path, FILES)
    capture = open_capture(tmp_path, cache_bytes=5 * IMAGES[0, 0, 0].nbytes)
    failures: list[str] = []

    def reader(seed: int) -> None:
        rng = np.random.default_rng(seed)
        for t, sy, sx in rng.integers(0, IMAGES.shape[:3], (60, 3)):
            if not np.array_equal(capture.read(t, sy, sx, 2, 15, 3, 20), IMAGES[t, sy, sx, 2:15, 3:20]):
                failures.append(f"{t} {sy} {sx}")

    threads = [threading.Thread(target=reader, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    if "compression" in options:
        assert 0 < capture._cache.used <= capture._cache.limit
    else:
        assert capture._cache.used == 0  # windows are read as such


def test_cache_forgets_the_least_recently_used() -> None:
    cache, loads = ImageCache(limit=20), []

    def load(key: str, size: int = 8) -> np.ndarray:
        def fresh() -> np.ndarray:
            loads.append(key)
            return np.zeros(size, np.uint8)

        return cache.get(key, fresh)

    for key in "abacab":  # c drives b out, as a was used later
        load(key)
    assert "".join(loads) == "abcb"
    assert cache.used == 16
    load("huge", 21)
    assert cache.used == 16
    with pytest.raises(ValueError, match="read-only"):
        load("a")[0] = 1


def test_cache_with_a_lower_limit_forgets_at_once() -> None:
    cache = ImageCache(limit=20)
    for key in "ab":
        cache.get(key, lambda: np.zeros(8, np.uint8))
    cache.set_limit(15)
    assert cache.used == 8
    assert cache.get("b", lambda: np.ones(8, np.uint8)).sum() == 0  # the older one went
    cache.set_limit(0)
    assert cache.get("c", lambda: np.ones(8, np.uint8)).sum() == 8
    assert cache.used == 0


@pytest.mark.parametrize(
    ("options", "worth"), [({}, 0), ({"compression": "zlib", "rowsperstrip": 5}, 0), ({"compression": "zlib"}, 1)]
)
def test_only_images_that_are_decoded_whole_are_worth_keeping(
    tmp_path: Path, options: dict[str, object], worth: int
) -> None:
    write_files(tmp_path, **options)
    describe(tmp_path, FILES)
    capture = open_capture(tmp_path)
    assert capture.cacheable_bytes == worth * IMAGES.nbytes
    capture.block(range(3), range(2), range(4), 2, 15, 3, 20)
    assert capture._cache.used == worth * IMAGES.nbytes
    capture.keep_decoded(0)
    assert capture._cache.used == 0


def test_a_failed_load_can_be_tried_again() -> None:
    cache = ImageCache(limit=20)

    def fail() -> np.ndarray:
        raise InputError("damaged")

    with pytest.raises(InputError, match="damaged"):
        cache.get("a", fail)
    assert cache.get("a", lambda: np.ones(2, np.uint8)).sum() == 2
