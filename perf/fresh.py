"""``python -m perf.fresh CAPTURE OUT OPTIONS``: one run in a process of its own, and what it took, as JSON.

Memory can only be told of a fresh process, and a run's pace only unit by unit. Called by ``fresh_run``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leafflow_ti.errors import RunError


@dataclass(frozen=True)
class FreshRun:
    """``seconds`` of the whole run without compiling; ``units``: seconds at which each unit was finished.

    ``peak_mib``: peak memory of the process, or of it and its workers together; ``planned_mib``: what the plan asked
    for one unit; ``base_mib``: memory of the process with all kernels, before any array; ``compiling_mib``: its peak
    until then.
    """

    seconds: float
    compile_seconds: float
    units: tuple[float, ...]
    peak_mib: float
    planned_mib: float
    base_mib: float
    compiling_mib: float
    bands: int
    pixels: int


def fresh_run(
    capture: Path, out: Path, options: Mapping[str, Any], pictures: bool = False, cache: Path | None = None
) -> FreshRun:
    """Run ``options`` on a capture in a new process, with quick looks at the end if ``pictures``.

    ``cache``: folder of compiled kernels, where it is not the usual one. Raises RunError with its last line if the
    process fails.
    """
    done = subprocess.run(
        [sys.executable, "-m", "perf.fresh", str(capture), str(out), json.dumps(options), *["pictures"] * pictures],
        env=os.environ if cache is None else {**os.environ, "LEAFFLOW_TI_CACHE": str(cache)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise RunError(f"a run of {capture} ended with code {done.returncode}: {' '.join(last)}")
    found = json.loads(done.stdout.splitlines()[-1])
    return FreshRun(**{**found, "units": tuple(found["units"])})


def status_mib(key: str) -> float | None:
    """One of the sizes that Linux tells of this process, e.g. ``VmRSS``; None elsewhere."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    line = next(line for line in status.read_text(encoding="ascii").splitlines() if line.startswith(key))
    return int(line.split()[1]) / 2**10


def peak_mib() -> float:
    """Peak memory of this process since it began: on Linux from its own address space, for the kernel's figure of
    ``getrusage`` counts that of the process it was started from, too."""
    peak = status_mib("VmHWM")
    if peak is not None:
        return peak
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # in bytes where there is no /proc


def tree_mib(pid: int) -> float:
    """Memory of a process and of all that it has started, now; of one that has ended, none."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    except OSError:
        return 0.0
    own = sum(int(line.split()[1]) / 2**10 for line in status if line.startswith("VmRSS"))
    return own + sum(tree_mib(int(child)) for child in children)


class TreeWatch(threading.Thread):
    """Looks at the memory of this process and its children, all the time; ``peak_mib``: the most that it saw."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.peak_mib = 0.0

    def run(self) -> None:
        """Until the process ends."""
        while True:
            self.peak_mib = max(self.peak_mib, tree_mib(os.getpid()))
            time.sleep(0.05)


def main(capture: str, out: str, options: str, pictures: str = "") -> None:
    """Run and print."""
    import leafflow_ti as lf
    from leafflow_ti.api import plan_run
    from leafflow_ti.config import load_config
    from leafflow_ti.pipeline import Pipeline
    from leafflow_ti.worker import start_device

    opened, config = lf.open_capture(capture), load_config(overrides=json.loads(options))
    plan = plan_run(opened, config)
    compile_seconds = 0.0
    if config.plan.workers == 1:  # else this process computes nothing
        compile_seconds = Pipeline(plan, opened, start_device(config)).warm_up()
    base, compiling = status_mib("VmRSS") or peak_mib(), peak_mib()
    watch = TreeWatch()
    if config.plan.workers > 1:  # else the system's own figure is exact
        watch.start()
    units: list[float] = []
    began = time.perf_counter()
    summary = lf.run(opened, out, config, progress=lambda state: units.append(time.perf_counter() - began))
    if pictures:
        from leafflow_ti.cli.run import write_pictures

        write_pictures(Path(out))
    print(
        json.dumps(
            {
                "seconds": summary.seconds - summary.compile_seconds, "compile_seconds": compile_seconds,
                "units": units, "peak_mib": max(peak_mib(), watch.peak_mib), "planned_mib": plan.bytes / 2**20,
                "base_mib": base, "compiling_mib": compiling, "bands": plan.bands,
                "pixels": len(plan.frames) * len(plan.y) * len(plan.x),
            }
        )
    )  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:5])
