"""The real data, which does not belong to the project, and the captures that read it where it lies."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import FileCapture, open_capture
from leafflow_ti.capture.description import FILE_NAME, Description, write_description
from leafflow_ti.errors import InputError

VARIABLE = "LEAFFLOW_TI_DATA"


def data_folder(name: str) -> Path:
    """Folder of one data set, whether it exists or not: below ``LEAFFLOW_TI_DATA``, else ``shared/data`` beside the
    checkout."""
    root = os.environ.get(VARIABLE)
    return (Path(root) if root else Path(__file__).parents[2] / "shared" / "data") / name


def absent(name: str) -> str | None:
    """Why a data set cannot be used; None where its folder exists."""
    folder = data_folder(name)
    return None if folder.is_dir() else f"{folder} does not exist; set {VARIABLE} to the folder that holds {name}"


def described(folder: Path, description: dict[str, Any]) -> FileCapture:
    """Write ``folder/capture.toml`` and open it."""
    folder.mkdir(parents=True, exist_ok=True)
    write_description(folder / FILE_NAME, Description.model_validate(description))
    return open_capture(folder, outside=True)


def read_pfm(path: Path) -> NDArray[np.float64]:
    """Grey PFM image [y, x], y down (the file's rows run bottom-up). Raises InputError for another kind of file."""
    with path.open("rb") as file:
        if file.readline().strip() != b"Pf":
            raise InputError(f"{path}: not a grey PFM file")
        width, height = (int(n) for n in file.readline().split())
        order = "<f4" if float(file.readline()) < 0 else ">f4"
        values = np.frombuffer(file.read(), order)
    if values.size != width * height:
        raise InputError(f"{path}: {values.size} values, the header states {width} x {height}")
    return values.reshape(height, width)[::-1].astype(np.float64)
