"""``python -m perf.fuzz.child KIND ROUND FOLDER``: numbers of trials come in, verdicts go out, one line each."""

from __future__ import annotations

import os
import resource
import shutil
import sys
import tempfile
from pathlib import Path

from perf.fuzz.trial import judge, load


def address_space() -> int:
    """Bytes of address space of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    return pages * resource.getpagesize()


def main(name: str, round_seed: str, out: str) -> None:
    """Answer until the input ends; the answers have a descriptor of their own, whatever the program prints."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    kind = load(name)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as scratch:
        seeds, folder = Path(scratch) / "seeds", Path(out)
        seeds.mkdir()
        trial = kind.prepare(seeds)
        resource.setrlimit(resource.RLIMIT_AS, (address_space() + kind.memory,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for line in sys.stdin:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            verdict = judge(trial, (int(round_seed), int(line)), folder)
            answers.write(verdict.to_line() + "\n")
            answers.flush()


if __name__ == "__main__":
    main(*sys.argv[1:4])
