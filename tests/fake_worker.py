"""A worker that computes nothing, for tests of what its parent does: ``python fake_worker.py BEHAVIOUR``, as JSON.

``start``: a line of Python that it runs first. ``dies``, ``fails``, ``hangs``: units at which it kills itself, reports
an error (by unit: message and exit code), or stays. ``warns``: what it warns of. All it prints beside its messages must
not matter.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from typing import Any


def say(kind: str, **facts: Any) -> None:
    print(json.dumps({"kind": kind, **facts}), flush=True)


def compute(units: list[int], behaviour: dict[str, Any]) -> None:
    for unit in units:
        if unit in behaviour.get("dies", ()):
            print('{"kind": "unit", "un', end="", flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        if unit in behaviour.get("hangs", ()):
            time.sleep(600)
        if str(unit) in behaviour.get("fails", {}):
            message, code = behaviour["fails"][str(unit)]
            say("failed", message=message, exit_code=code)
            return
        say("unit", unit=unit, seconds={"estimate": 1.0 + unit})
    say("ended", seconds={"estimate": 1.0})


def main() -> None:
    behaviour = json.loads(sys.argv[1])
    json.loads(sys.stdin.readline())
    exec(behaviour.get("start", ""))
    print("[engine] a banner\n17", flush=True)
    print("a driver complains " * 20_000, file=sys.stderr, flush=True)
    if "warns" in behaviour:
        say("warning", message=behaviour["warns"], facts={})
    say("ready", device=f"gpu {os.environ.get('CUDA_VISIBLE_DEVICES')}", seconds={"compile": 2.0})
    for line in sys.stdin:
        compute(json.loads(line), behaviour)


main()
