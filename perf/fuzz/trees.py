"""Folders of a capture with what does not belong there: links in circles and out of it, pipes, gaps, odd images."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np

from leafflow_ti.capture import capture_doubts, open_capture
from leafflow_ti.errors import LeafflowError
from perf.fuzz.descriptions import CAMERAS, FRAMES, HEIGHT, WIDTH, write_pgm, write_sound
from perf.fuzz.trial import Defect, Kind, Trial, refused

Change = Callable[[np.random.Generator, Path, Path], object]
"""Of one file of a folder, the second path."""

LEVEL = 255
"""Grey value of what lies outside the folder: it must not be read."""
DESCRIPTION = """[images]
pattern = "%s"
[camera]
%s
[grid]
baseline_mm = 5.0
[time]
%s
"""
LAYOUTS = (
    ("c{sx}_{t:02d}.pgm", "{name}"),
    ("{sx}/{t:02d}.pgm", "{k}/{t:02d}.pgm"),
    ("{sx}/x/{t}/i{sx}.pgm", "{k}/x/{t}/i{k}.pgm"),
)


def _outside(folder: Path) -> Path:
    return folder.parent / f"{folder.name}-outside"


def _replaced(path: Path) -> Path:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    return path


def _socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # names of sockets are short
    try:
        with socket.socket(socket.AF_UNIX) as found:
            found.bind(path.name)
    finally:
        os.chdir(here)


def _image(rng: np.random.Generator, path: Path, shape: tuple[int, int]) -> None:
    write_pgm(_replaced(path), rng.integers(0, 255, shape, np.uint8))


def _frame_more(rng: np.random.Generator, path: Path) -> None:
    """An image of a frame with a number of up to 17 digits."""
    head, _, _ = path.stem.rpartition("_")
    number = 10 ** int(rng.integers(0, 18))
    _image(rng, path.with_name(f"{head}_{number:02d}.pgm" if head else f"{number:02d}.pgm"), (HEIGHT, WIDTH))


def _folder_linked(folder: Path, path: Path, target: Path) -> None:
    if path.parent != folder:
        _replaced(path.parent).symlink_to(target)


def _crowded(rng: np.random.Generator, path: Path) -> None:
    for name in ("a\nb.pgm", "c\udcff.pgm", "c9_99.pgm\n", *(f"{k}.txt" for k in rng.integers(10**9, size=300))):
        (path.parent / name).touch()


CHANGES: dict[str, Change] = {
    "missing": lambda _, folder, path: _replaced(path),
    "link to itself": lambda _, folder, path: _replaced(path).symlink_to(path.name),
    "link to another": lambda rng, folder, path: _replaced(path).symlink_to(_other(rng, folder, path)),
    "link to nothing": lambda _, folder, path: _replaced(path).symlink_to("nothing"),
    "link outside": lambda _, folder, path: _replaced(path).symlink_to(_outside(folder) / "image.pgm"),
    "link to a device": lambda _, folder, path: _replaced(path).symlink_to("/dev/zero"),
    "link to a process": lambda _, folder, path: _replaced(path).symlink_to("/proc/self/mem"),
    "hard link": lambda rng, folder, path: os.link(_other(rng, folder, path), _replaced(path)),
    "pipe": lambda _, folder, path: os.mkfifo(_replaced(path)),
    "socket": lambda _, folder, path: _socket(_replaced(path)),
    "folder": lambda _, folder, path: _replaced(path).mkdir(),
    "empty": lambda _, folder, path: _replaced(path).touch(),
    "text": lambda _, folder, path: _replaced(path).write_text("no image"),
    "cut": lambda rng, folder, path: os.truncate(path, int(rng.integers(0, max(1, path.stat().st_size)))),
    "other size": lambda rng, folder, path: _image(rng, path, (HEIGHT, WIDTH + 1)),
    "black": lambda _, folder, path: write_pgm(_replaced(path), np.zeros((HEIGHT, WIDTH), np.uint8)),
    "copy of another": lambda rng, folder, path: shutil.copy(_other(rng, folder, path), path),
    "one more frame": lambda rng, folder, path: _frame_more(rng, path),
    "crowded": lambda rng, folder, path: _crowded(rng, path),
    "folder is a link to the whole": lambda _, folder, path: _folder_linked(folder, path, folder),
    "folder is a link outside": lambda _, folder, path: _folder_linked(folder, path, _outside(folder)),
}
"""What is done to a file."""


def _other(rng: np.random.Generator, folder: Path, path: Path) -> Path:
    others = [other for other in _files(folder) if other != path]
    return others[rng.integers(len(others))]


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*.pgm") if path.is_file() and not path.is_symlink())


def prepare(seeds: Path) -> Trial:
    """Sound files, put in one of the layouts and changed for each trial."""
    write_sound(seeds)

    def trial(rng: np.random.Generator, folder: Path) -> str:
        outside = _outside(folder)
        shutil.rmtree(outside, ignore_errors=True)
        outside.mkdir()
        write_pgm(outside / "image.pgm", np.full((HEIGHT, WIDTH), LEVEL, np.uint8))
        for t in range(FRAMES):
            shutil.copy(outside / "image.pgm", outside / f"{t:02d}.pgm")
        pattern, name = LAYOUTS[rng.integers(len(LAYOUTS))]
        camera, time = "focal_length_px = 100.0", "interval_s = 60.0"
        named = {"camera.yml": 'calibration = "camera.yml"', "times.txt": 'stamps = "times.txt"'}
        kept = [key for key in named if rng.random() < 0.3]
        for key in kept:
            shutil.copy(seeds / key, folder / key)
        for t in range(FRAMES):
            for k in range(CAMERAS):
                target = folder / name.format(name=f"c{k}_{t:02d}.pgm", k=k, t=t)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(seeds / f"c{k}_{t:02d}.pgm", target)
        text = DESCRIPTION % (
            pattern,
            named["camera.yml"] if "camera.yml" in kept else camera,
            named["times.txt"] if "times.txt" in kept else time,
        )
        (folder / "capture.toml").write_text(text)
        for change in rng.choice(list(CHANGES), rng.integers(1, 4)):
            _change(str(change), rng, folder, kept)
        try:
            return _used(folder)
        finally:
            shutil.rmtree(outside, ignore_errors=True)

    return trial


def _change(name: str, rng: np.random.Generator, folder: Path, kept: list[str]) -> None:
    """Change one file; one that an earlier change has taken away stays away."""
    files = [*_files(folder), *(folder / key for key in kept if (folder / key).is_file())]
    if len(files) > 1:
        CHANGES[name](rng, folder, files[rng.integers(len(files))])


def _used(folder: Path) -> str:
    """Open, look and read; what lies outside must not show."""
    try:
        capture = open_capture(folder)
        capture.fingerprint()
        capture_doubts(capture)
        for t, row, col in np.ndindex(*capture.shape[:3]):
            if (capture.read(t, row, col, 0, capture.height, 0, capture.width) == LEVEL).all():
                raise Defect(f"an image outside the folder was read: {capture.image_name(t, row, col)}")
    except LeafflowError as error:
        return refused(error, str(folder))
    return "values"


KIND = Kind("tree", prepare, memory=512 * 2**20)
