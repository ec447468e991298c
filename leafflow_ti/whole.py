"""Files and folders that appear under their names when they are whole; what fails or is interrupted leaves none."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from leafflow_ti.errors import RunError


@contextlib.contextmanager
def appearing(path: Path) -> Iterator[Path]:
    """Gives the place, beside ``path`` and with its suffix, at which to write the file or the folder ``path``.

    At the end it takes that name, in place of what had it; parents are created.
    Raises RunError where anything cannot be written.
    """
    scratch = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield scratch
        if path.is_dir():
            shutil.rmtree(path)
        scratch.replace(path)
    except OSError as error:
        # Libraries raise with the system's number and a text of their own, of several lines.
        reason = os.strerror(error.errno) if error.errno else " ".join(str(error).split())
        if isinstance(error, FileExistsError | NotADirectoryError):
            reason = f"{path.parent} is no folder"
        raise RunError(f"{path}: cannot be written ({reason}): mend that, or give another name") from error
    finally:
        with contextlib.suppress(OSError):  # what went wrong above is what matters
            _remove(scratch)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
