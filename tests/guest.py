"""``python tests/guest.py CAPTURE``: a host program that makes it hard for its guest; what came of it, as JSON."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import sys
import threading

import numpy as np

import leafflow_ti as lf
from leafflow_ti.errors import DeviceError
from leafflow_ti.runtime import start

OPTIONS = {"model": "flow", "window": 7, "stride": 4, "preshift": (0, 0)}


def measured(capture: str) -> str:
    """A checksum of all maps."""
    field = lf.estimate(capture, **OPTIONS)
    return hashlib.sha256(b"".join(np.ascontiguousarray(field[name]).tobytes() for name in field)).hexdigest()


def in_threads(capture: str, n: int) -> list[str]:
    """The checksums of so many threads that work at the same time."""
    found: list[str] = []
    threads = [threading.Thread(target=lambda: found.append(measured(capture))) for _ in range(n)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


async def in_a_loop(capture: str) -> str:
    """As in a notebook, where an event loop runs."""
    return measured(capture)


def in_a_fork(capture: str) -> str:
    """What a forked child says."""
    out, into = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            said = measured(capture)
        except DeviceError as error:
            said = str(error)
        os.write(into, said.encode())
        os._exit(0)
    os.waitpid(child, 0)
    return os.read(out, 4096).decode()


def main(capture: str) -> None:
    """Measure in every way."""
    found = {
        "threads": in_threads(capture, 3),  # they start the engine, and compile
        "main": measured(capture),
        "loop": asyncio.run(in_a_loop(capture)),
        "fork": in_a_fork(capture),
        "device": start().arch,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
