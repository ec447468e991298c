"""Image files, damaged: the values that independent readers give, or one line; in the memory that the image states.

Where our reader gives values they must be those of tifffile (whole page) and of Pillow, as far as these read the file
without a complaint.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

from leafflow_ti.capture.channels import ImageInfo
from leafflow_ti.capture.images import page_info, probe, read_gray, read_window
from leafflow_ti.errors import LeafflowError
from perf.fresh import peak_mib
from perf.fuzz.image_seeds import seeds
from perf.fuzz.mutations import mutate
from perf.fuzz.trial import Defect, Kind, Trial, refused

MEMORY = 2**30
_FREE_MIB = 96
"""What a trial may take whatever the file states: decoders' own, and one segment of the strongest compression."""
_PER_SAMPLE = 48
"""Bytes per stated sample: sums of colours are made in double precision."""
_COMPARED = 2**22
"""Pixels of the largest image that is compared."""
_SAME = {"L", "RGB", "P", "F", "I;16", "I;16B"}
"""Modes of Pillow whose values are those of the file."""
_PILLOW_TIFF = {(1, 1), (1, 2), (1, 3)}
"""Orientation and meaning of TIFF pages that Pillow leaves as they are, or gives colours. 16 bit are not inverted."""


def prepare(_folder: Path) -> Trial:
    """The trial; all seeds are kept in memory."""
    return damaging(seeds())


def damaging(files: dict[str, bytes]) -> Trial:
    """The trial that damages one of these files, by name, or now and then leaves it as it is."""
    names, contents = zip(*files.items(), strict=True)

    def trial(rng: np.random.Generator, folder: Path) -> str:
        chosen = int(rng.integers(len(names)))
        path = folder / f"input-{names[chosen]}"
        unharmed = rng.integers(20) == 0
        path.write_bytes(contents[chosen] if unharmed else mutate(rng, contents[chosen], contents))
        return check(rng, path)

    return trial


def check(rng: np.random.Generator, path: Path) -> str:
    """Outcome of reading one file: ``values`` (alike: compared), ``refused``."""
    stated = 0
    before = _memory_from_now()
    try:
        info = probe(path)
        page = int(rng.integers(info.pages))
        info = page_info(path, page)
        stated = info.height * info.width * info.samples
        channel = int(rng.integers(info.samples))
        values = read_gray(path, page, channel, np.float64)
    except LeafflowError as error:
        _check_memory(before, stated, path)
        if "more memory than there is" in str(error) and stated * _PER_SAMPLE < MEMORY:
            raise Defect(f"asked for more memory than {stated} samples need: {error}") from error
        return refused(error, path.name)
    _check_memory(before, stated, path)
    _check_values(rng, path, page, channel, info, values)
    readers = [reader for reader in (_tifffile, _pillow) if _agrees(reader(path, page, channel, info), values, reader)]
    return "values, alike" if readers else "values, no other reader"


def _check_values(
    rng: np.random.Generator, path: Path, page: int, channel: int, info: ImageInfo, values: np.ndarray
) -> None:
    if values.shape != (info.height, info.width):
        raise Defect(f"values of shape {values.shape}, the header states {info.height} x {info.width}")
    y0, x0 = int(rng.integers(info.height)), int(rng.integers(info.width))
    y1, x1 = int(rng.integers(y0, info.height)) + 1, int(rng.integers(x0, info.width)) + 1
    window = read_window(path, page, channel, y0, y1, x0, x1)
    if not np.array_equal(window.astype(np.float64), values[y0:y1, x0:x1], equal_nan=True):
        raise Defect(f"window y {y0}:{y1}, x {x0}:{x1} differs from the whole image")


def _agrees(theirs: np.ndarray | None, ours: np.ndarray, reader: object) -> bool:
    """Whether another reader read the file; raises Defect if it read something else."""
    if theirs is None:
        return False
    if theirs.shape != ours.shape or not np.array_equal(theirs.astype(np.float64), ours, equal_nan=True):
        raise Defect(f"{reader.__name__[1:]} reads other values, of shape {theirs.shape}, ours {ours.shape}")  # type: ignore[attr-defined]
    return True


def _tifffile(path: Path, page: int, channel: int, info: ImageInfo) -> np.ndarray | None:
    """Stored samples of a page, where their meaning is plain: grey or RGB, upright."""
    if path.read_bytes()[:2] not in (b"II", b"MM") or info.height * info.width > _COMPARED:
        return None
    try:
        with _complaints() as said, tifffile.TiffFile(path) as tif:
            pages = [p for p in tif.pages if isinstance(p, tifffile.TiffPage)]
            pages = [p for p in pages if not p.subfiletype & 0b101] or pages
            if page >= len(pages):
                return None  # pages behind one header
            source = pages[page]
            image = source.asarray()
            plain = int(source.tags.valueof(274, 1)) == 1 and source.photometric in (0, 1, 2, 6)
        if said or not plain:
            return None
        if source.planarconfig == 2 and source.samplesperpixel > 1:
            image = np.moveaxis(image, 0, -1)
        image = image.reshape(info.height, info.width, -1)[..., channel]
        return 2**info.bits - 1 - image.astype(np.int64) if source.photometric == 0 else image
    except Exception:
        return None


def _pillow(path: Path, page: int, channel: int, info: ImageInfo) -> np.ndarray | None:
    if info.height * info.width > _COMPARED or info.bits < 8:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with Image.open(path) as image:
                if page or image.mode not in _SAME or getattr(image, "n_frames", 1) > 1:
                    return None
                tags = getattr(image, "tag_v2", {})
                if tags and (tags.get(274, 1), tags.get(262)) not in _PILLOW_TIFF:
                    return None
                if image.format == "PPM" and b"255" not in path.read_bytes()[:60]:
                    return None  # scaled by the maximum
                found = np.asarray(image.convert("RGB") if image.mode == "P" else image)
        found = found.reshape(*found.shape[:2], -1)
        return found[..., channel] if found.shape[2] == info.samples and found.dtype == info.dtype else None
    except Exception:
        return None


@contextmanager
def _complaints() -> Iterator[list[str]]:
    """What tifffile logs."""
    said: list[str] = []

    class Heard(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())

    handler, logger = Heard(logging.WARNING), logging.getLogger("tifffile")
    logger.addHandler(handler)
    try:
        yield said
    finally:
        logger.removeHandler(handler)


def _memory_from_now() -> float:
    """Reset the process's peak of memory, where the system can; MiB in use."""
    reset = Path("/proc/self/clear_refs")
    if reset.exists():
        reset.write_text("5", encoding="ascii")
    return peak_mib()


def _check_memory(before: float, stated: int, path: Path) -> None:
    allowed = _FREE_MIB + (stated * _PER_SAMPLE + 100 * path.stat().st_size) / 2**20
    if (taken := peak_mib() - before) > allowed:
        raise Defect(f"took {taken:.0f} MiB for {stated} samples in {path.stat().st_size} bytes, {allowed:.0f} allowed")


KIND = Kind("image", prepare, MEMORY)
