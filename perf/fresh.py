"""``python -m perf.fresh CAPTURE OUT OPTIONS``: one run in a process of its own, and what it took, as JSON.

Memory can only be told of a fresh process, and a run's pace only unit by unit. Called by ``fresh_run``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leafflow_ti.errors import RunError


@dataclass(frozen=True)
class FreshRun:
    """``seconds`` of the whole run without compiling; ``units``: seconds at which each unit was finished;
    ``peak_mib``: peak memory of the process; ``planned_mib``: what the plan asked for one unit."""

    seconds: float
    compile_seconds: float
    units: tuple[float, ...]
    peak_mib: float
    planned_mib: float
    bands: int
    pixels: int


def fresh_run(capture: Path, out: Path, options: Mapping[str, Any]) -> FreshRun:
    """Run ``options`` on a capture in a new process; raises RunError with its last line if it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "perf.fresh", str(capture), str(out), json.dumps(options)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise RunError(f"a run of {capture} ended with code {done.returncode}: {' '.join(last)}")
    found = json.loads(done.stdout.splitlines()[-1])
    return FreshRun(**{**found, "units": tuple(found["units"])})


def peak_mib() -> float:
    """Peak memory of this process since it began: on Linux from its own address space, for the kernel's figure of
    ``getrusage`` counts that of the process it was started from, too."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 2**10
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # in bytes where there is no /proc


def main(capture: str, out: str, options: str) -> None:
    """Run and print."""
    import leafflow_ti as lf
    from leafflow_ti.api import plan_run
    from leafflow_ti.config import load_config

    opened, config = lf.open_capture(capture), load_config(overrides=json.loads(options))
    plan = plan_run(opened, config)
    units: list[float] = []
    began = time.perf_counter()
    summary = lf.run(opened, out, config, progress=lambda state: units.append(time.perf_counter() - began))
    print(
        json.dumps(
            {
                "seconds": summary.seconds - summary.compile_seconds, "compile_seconds": summary.compile_seconds,
                "units": units, "peak_mib": peak_mib(), "planned_mib": plan.bytes / 2**20, "bands": plan.bands,
                "pixels": len(plan.frames) * len(plan.y) * len(plan.x),
            }
        )
    )  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:4])
    sys.stdout.flush()
    os._exit(0)  # the engine's own shutdown is not part of the measurement
