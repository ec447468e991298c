"""What the commands say to a network, as ``strace`` sees it: every ``socket`` call of all their processes and threads.

Sockets of the same machine (AF_UNIX) are what event loops wake themselves with; internet sockets must not be there.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from leafflow_ti.errors import RunError
from perf.cases import Options
from perf.figures import Figure, Outcome

COMMANDS = (
    "simulate cube cube --size 120x80 --cameras 5 --frames 9",
    "check cube",
    "run cube -o out.zarr --window 21",
    "run cube -o workers.zarr --window 21 --workers 2 --refine 0 --no-quicklook",
    "growth out.zarr",
    "evaluate out.zarr --truth cube/truth.npz",
    "export out.zarr --to netcdf -o out.nc",
    "report out.zarr -o out.html",
    "info out.zarr",
    "demo demo",
)
INTERNET = re.compile(r"AF_INET6?\b")


def sockets(words: list[str], folder: Path) -> Counter[str]:
    """Family -> how often a command's ``socket`` and ``connect`` calls name it; RunError if it fails."""
    log = folder / "strace.log"
    done = subprocess.run(
        ["strace", "-f", "-qq", "-e", "trace=socket,connect,socketpair", "-o", str(log), sys.executable, "-m",
         "leafflow_ti.cli.main", *words], cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise RunError(f"leafflow-ti {words[0]} ended with code {done.returncode}: {done.stderr.strip()[-200:]}")
    return Counter(re.findall(r"\bAF_[A-Z0-9]+", log.read_text(encoding="utf-8")))


def run(options: Options) -> Outcome:
    """The case; quick: without the demo."""
    if shutil.which("strace") is None:
        return Outcome(skipped="strace is not installed")
    with tempfile.TemporaryDirectory() as name:
        commands = COMMANDS[:-1] if options.quick else COMMANDS
        found = {line: sockets(line.split(), Path(name)) for line in commands}
    figures = tuple(
        Figure(f"internet sockets: {' '.join(line.split()[:2])}", sum(n for f, n in count.items() if INTERNET.match(f)),
               "", 0, note=", ".join(f"{n} {family}" for family, n in sorted(count.items())))
        for line, count in found.items()
    )  # fmt: skip
    return Outcome(figures)
