"""Command lines with values that make no sense; nothing is computed: ``run`` makes its plan."""

from __future__ import annotations

import contextlib
import io
import shutil
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from leafflow_ti.cli.main import main
from leafflow_ti.cli.options import SETTINGS
from leafflow_ti.profile_cases import CASES
from perf.fuzz.descriptions import CORE, SENSIBLE, one_example, write_sound
from perf.fuzz.trial import Defect, Kind, Trial

CODES = {0, 2, 3, 4, 5, 6, 7}
"""Exit codes of the contract; 130 is for the interrupted."""

VALUES = (
    "", " ", "0", "-1", "1", "3", "7", "33", "64", "65", "1e9", "1e400", "nan", "inf", "-inf", "9" * 25, "0x10",
    "1_000", "auto",
    "none", "all", "True", "ols", "f32", "f64", "cpu", "cuda", "flow", "affine-4d", "depth", "scene-flow",
    "range-flow",
    "0:1", "1:0", "-3:", ":", "0:99", "0:1:2", "a:b", "0,0,8,8", "8,8,0,0", "0,0,1e9,1e9", "-1,-1,99,99", "1,2,3",
    ",,,",
    "-3,0", "-3", "99999,0", "nan,nan", "8G", "0G", "-8G", "1T", "1e999G", "8", "G", "..", "/", "/dev/zero",
    "/dev/null", "~",
    "capture.toml", "c0_00.pgm", "dead.pgm", "times.txt", "pipe", "nothing", "{t}", "{t.__class__}", "%s%n",
    "a\nb", "é", "\udcff",
    "a" * 3000, "--", "-o", "rotation", "accurate", "fast", "2d+b5", "u+as", "spatial", "jacobi", "[1,2]",
    "model.name=flow",
    "plan.tile=0", "output.arrays=x", "window.size=33", "window.size=[", "a.b.c.d=1", "=", "model=1", "x=y",
)  # fmt: skip
"""Of options and ``--set``."""
COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "run": (
        ("capture.toml", "--dry-run"),
        (*(f"--{name.replace('_', '-')}" for name in SETTINGS), "--set", "--config"),
    ),
    "info": (("capture.toml",), ("--json", "--outside")),
    "export": (("nothing.zarr",), ("--to", "-o", "--frames")),
    "evaluate": (("nothing.zarr",), ("--truth", "--json")),
    "report": (("nothing.zarr",), ("-o",)),
    "growth": (("nothing.zarr",), ("-o",)),
    "track": (("nothing.zarr",), ("-o", "--points")),
    "regions": (("nothing.zarr",), ("--labels", "-o")),
    "profile": ((), ("--case",)),
}
"""Command -> what it is called with, and the options that hostile values are given to."""
WHOLE = ("--json", "--outside")


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """A command with up to four options."""
    command = draw(st.sampled_from(("run", "run", "run", *COMMANDS)))
    arguments, options = COMMANDS[command]
    line = [command, *arguments]
    if draw(st.integers(0, 5)) == 0 and len(line) > 1:
        line[1] = draw(st.sampled_from(VALUES))
    if command == "profile":
        return [
            *line,
            "--case",
            draw(st.sampled_from([value for value in VALUES if value not in CASES])),
        ]
    for _ in range(draw(st.integers(1, 4))):
        option = draw(st.sampled_from(options))
        line.append(option)
        if option not in WHOLE:
            line.append(draw(st.one_of(st.sampled_from(VALUES), st.text(max_size=8), st.floats().map(str))))
    return line


def prepare(seeds: Path) -> Trial:
    """A sound capture, in which each command is called."""
    write_sound(seeds)
    lines = [
        (section, [f"{key} = {value}" for key, value in keys.items() if key in CORE])
        for section, keys in SENSIBLE.items()
    ]
    text = "\n".join(f"[{section}]\n" + "\n".join(keys) for section, keys in lines)
    (seeds / "capture.toml").write_text(text + "\n")

    def trial(rng: np.random.Generator, folder: Path) -> str:
        shutil.copytree(seeds, folder, dirs_exist_ok=True)
        with contextlib.chdir(folder):
            return one_example(command_lines(), rng, called)

    return trial


def called(line: list[str]) -> str:
    """The exit code in words, once it is right: one line of error, none of a traceback."""
    Path("line.txt").write_text("\n".join(map(ascii, line)), encoding="utf-8")
    said, errors, code = io.StringIO(), io.StringIO(), None
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(errors):
        try:
            main(line)
        except SystemExit as end:
            code = end.code or 0
    text = errors.getvalue()
    told = [one for one in text.splitlines() if one.lower().startswith("error: ")]
    if code not in CODES:
        raise Defect(f"{line} ends with {code}: {text[-1000:]}")
    if code and (len(told) != 1 or "Traceback" in text or "error: unexpected" in text):
        raise Defect(f"{line} ends with {code} and says {text[-1000:]!r}")
    if not code and text and not all(one.startswith("warning: ") for one in text.splitlines()):
        raise Defect(f"{line} ends well and says {text[-1000:]!r}")
    return f"exit {code}"


KIND = Kind("command", prepare, memory=2**30)
