"""Texts of ``capture.toml`` in a folder with sound images: sensible ones with parts exchanged, and nonsense."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from leafflow_ti.capture import FileCapture, capture_doubts, open_capture
from leafflow_ti.errors import LeafflowError
from perf.fuzz.trial import Kind, Trial, refused

Value = TypeVar("Value")
FRAMES, CAMERAS, HEIGHT, WIDTH = 3, 3, 20, 24

SENSIBLE: dict[str, dict[str, str]] = {
    "images": {
        "pattern": '"c{sx}_{t:02d}.pgm"', "path": '"c0_00.pgm"', "axes": '"y x"', "order": '"t sx"',
        "shape": "{ t = 3, sx = 3 }", "select": "{ t = [0, 2] }", "channel": '"luminance"', "bit_depth": "8",
        "saturated": '"auto"', "dead": '"dead.pgm"',
    },
    "camera": {
        "focal_length_px": "100.0", "focal_length_mm": "12.0", "pixel_pitch_mm": "0.005",
        "principal_point_px": "[11.5, 9.5]", "calibration": '"camera.yml"',
    },
    "grid": {
        "baseline_mm": "5.0", "disparity_offset_px": "[0.0, 0.0]",
        "positions_mm": "[[0.0, 0.0], [5.0, 0.1], [10.1, 0.0]]",
    },
    "time": {"interval_s": "60.0", "stamps_s": "[0.0, 60.0, 121.0]", "stamps": '"times.txt"'},
}  # fmt: skip
"""Values that fit the images, each alone."""
CORE = {"pattern", "focal_length_px", "baseline_mm", "interval_s"}
"""Keys of a description that opens."""

HOSTILE = (
    "nan", "inf", "-inf", "0", "-1", "0.0", "-0.0", "1e308", "1e-308", "1e400", "5e-324", "9" * 19, "9" * 5000,
    "0x" + "f" * 2000, "true", "[]", "{}", '""', '" "', "''", "[[]]", "[1, 2, 3]", "{ a = { b = 1 } }", "1979-05-27",
    "07:32:00", '"~"', '".."', '"/"', '"/dev/zero"', '"/etc/passwd"', '"../{t}.pgm"', '"{t}"', '"{0}"',
    '"{t.__class__}"',
    '"{t!r}"', '"{t:01000000000d}"', '"{t:0{sx}d}"', '"{t:d}{sx:d}"', '"{t}{sx}"', '"{t:02d}{sx:03d}"', '"{"', '"}"',
    '"{{t}}"', '"(a+)+$"', '"[{t}"', '"c{sx}_{t}*.pgm"', '"c{t}_{t}.pgm"', r'"a\u0000b"', r'"a\nb"', r'"\u2028"',
    '"' + "a" * 5000 + '"', '"' + "a/" * 2000 + '"', "[" * 500, "[" * 50 + "]" * 50, '"camera.yml"', '"times.txt"',
    '"c0_00.pgm"', '"nul"', '"x y"', '"t y x"', '"sx sy t y x"', '"i"', '"c{i}.pgm"', "{ t = [0, 1000000000000000] }",
    "{ t = 1000000000 }", "{ sx = [-5, 5, 2] }", "[0.0, 0.0]", "[1e300, 1e300]", "[[1, 2], [3, 4], [5, 6]]",
    '"red"', "3",
    "65535", "b = 1", '"""', "# ", "",
)  # fmt: skip
"""Values that fit nowhere, or hardly."""

_values = st.one_of(
    st.sampled_from(HOSTILE),
    st.sampled_from([value for section in SENSIBLE.values() for value in section.values()]),
    st.floats().map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.text(max_size=12).map(lambda text: repr(text).replace("\\x", "\\u00")),
    st.lists(st.floats(-1e3, 1e3).map(repr), max_size=5).map(lambda items: f"[{', '.join(items)}]"),
)


@st.composite
def texts(draw: st.DrawFn) -> bytes:
    """A description of which some lines are wrong; sometimes its bytes as well."""
    lines = []
    changed = draw(st.sets(st.sampled_from([key for section in SENSIBLE.values() for key in section]), max_size=3))
    for section, keys in SENSIBLE.items():
        if draw(st.integers(0, 31)) == 31:
            continue
        lines.append(f"[{section}]")
        for key, value in keys.items():
            if key in changed:
                lines.append(f"{key} = {draw(_values)}")
            elif key in CORE:
                lines.append(f"{key} = {value}")
    if draw(st.integers(0, 9)) == 9:
        extra = draw(
            st.sampled_from((*lines, "[lens]", "a.b.c = 1", "[[images]]", "[images.shape]", "x" * 200, "\x00", "é"))
        )
        lines.insert(draw(st.integers(0, len(lines))), extra)
    content = "\n".join(lines).encode("utf-8", "surrogatepass")
    if draw(st.integers(0, 11)) == 11:
        at, junk = draw(st.integers(0, len(content))), draw(st.binary(max_size=6))
        content = content[:at] + junk + content[at + draw(st.integers(0, 6)) :]
    return draw(st.sampled_from((b"", b"", b"", b"", b"", b"", b"\xef\xbb\xbf", b"\xff\xfe"))) + content


def write_sound(folder: Path) -> None:
    """Images of a surface with texture, dead pixels, a calibration and stamps."""
    rng = np.random.default_rng(1)
    texture = rng.integers(60, 200, (HEIGHT, WIDTH + 2 * CAMERAS), np.uint8)
    for t in range(FRAMES):
        for k in range(CAMERAS):
            image = texture[:, 2 * k : 2 * k + WIDTH] + rng.integers(0, 9, (HEIGHT, WIDTH), np.uint8)
            write_pgm(folder / f"c{k}_{t:02d}.pgm", image)
    write_pgm(folder / "dead.pgm", np.eye(HEIGHT, WIDTH, dtype=np.uint8))
    (folder / "camera.yml").write_text(
        "camera_matrix: [[100.0, 0, 11.5], [0, 100.0, 9.5], [0, 0, 1]]\ndistortion_coefficients: [0.1, 0, 0, 0]\n"
    )
    (folder / "times.txt").write_text("0\n60\n121\n")


def write_pgm(path: Path, image: np.ndarray) -> None:
    """An 8-bit grey image."""
    path.write_bytes(f"P5 {image.shape[1]} {image.shape[0]} 255\n".encode() + image.tobytes())


def use(folder: Path, name: str) -> str:
    """Open the capture, look at it as ``run`` does, and read all images; the outcome."""
    try:
        capture = open_capture(folder)
        capture.fingerprint()
        capture_doubts(capture)
        read_all(capture)
    except LeafflowError as error:
        return refused(error, name)
    return "values"


def read_all(capture: FileCapture) -> None:
    """Every image, whole."""
    for t, row, col in np.ndindex(*capture.shape[:3]):
        capture.read(t, row, col, 0, capture.height, 0, capture.width)


def prepare(seeds: Path) -> Trial:
    """Sound files, copied for each trial."""
    write_sound(seeds)

    def trial(rng: np.random.Generator, folder: Path) -> str:
        shutil.copytree(seeds, folder, dirs_exist_ok=True)
        return one_example(texts(), rng, lambda content: _described(folder, content))

    return trial


def _described(folder: Path, content: bytes) -> str:
    (folder / "capture.toml").write_bytes(content)
    return use(folder, str(folder))


def one_example(values: st.SearchStrategy[Value], rng: np.random.Generator, judge: Callable[[Value], str]) -> str:
    """The outcome of one value that the random bytes stand for."""
    outcomes: list[str] = []

    @settings(database=None, deadline=None, suppress_health_check=list(HealthCheck))
    @given(values)
    def example(value: Value) -> None:
        outcomes.append(judge(value))

    while not outcomes:  # some bytes stand for no value
        example.hypothesis.fuzz_one_input(rng.bytes(8192))
    return outcomes[0]


KIND = Kind("description", prepare, memory=512 * 2**20)
