"""``python tests/backend_guest.py first|warm|host``: a program that computes by ``leafflow_ti.backend`` in threads,
before anything is compiled or after ``warm_up``, or that has initialised the engine as it likes; what came of it, as
JSON."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import sys
import threading

import numpy as np

from leafflow_ti import backend

N_THREADS = 4
NAMES = ("epi_disparity", "eig_special_2d")


def checksum() -> str:
    """Of eigenvectors and of disparities of some noise."""
    random = np.random.default_rng(1)
    values, vectors = backend.eig_special_2d(random.standard_normal((3, 40, 50)).astype(np.float32))
    disparity = backend.epi_disparity(random.standard_normal((5, 32, 33)).astype(np.float32))
    return hashlib.sha256(values.tobytes() + vectors.tobytes() + disparity.tobytes()).hexdigest()


def in_threads() -> list[str]:
    """What so many threads find that begin at the same time."""
    found: list[str] = []
    together = threading.Barrier(N_THREADS)

    def work() -> None:
        together.wait()
        found.append(checksum())

    threads = [threading.Thread(target=work) for _ in range(N_THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def as_host() -> list[bool]:
    """Whether a host finds its field, its settings and its kernels again."""
    ti = importlib.import_module(os.environ.get("LEAFFLOW_TI_ENGINE", "taichi"))
    ti.init(
        arch=ti.cpu, debug=True, default_fp=ti.f64, default_ip=ti.i64, fast_math=False, cpu_max_num_threads=1,
        offline_cache=False, log_level=ti.ERROR,
    )  # fmt: skip
    field = ti.field(ti.f64, shape=(5,))

    @ti.kernel
    def fill():  # type: ignore[no-untyped-def]
        for i in field:
            field[i] = 1.0 / (3.0 + i)  # in the host's own precision

    fill()
    before = field.to_numpy()
    found = [checksum(), *in_threads()]
    kept = np.array_equal(field.to_numpy(), before)
    fill()
    exact = np.array_equal(field.to_numpy(), 1.0 / (3.0 + np.arange(5)))
    return [len(set(found)) == 1, kept, exact, bool(ti.cfg.debug), not ti.cfg.fast_math]


def main(mode: str) -> None:
    """Compute in one way."""
    told: dict[str, object] = {}
    if mode == "host":
        told["kept"] = as_host()
    if mode == "warm":
        told["warmed"] = sorted(backend.warm_up(*NAMES))
    told["threads"] = in_threads()
    told["main"] = checksum()
    print(json.dumps(told))


if __name__ == "__main__":
    main(sys.argv[1])
