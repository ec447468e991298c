"""Results in a folder, one JSON file per experiment and its maps beside it: one can be run again without the others."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from perf.dissertation.measure import Result


def save(folder: Path, result: Result) -> None:
    """Write ``NAME.json``, and ``NAME.npz`` if the result has maps."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{result.experiment}.json"
    arrays = {"|".join((*where, name)): a for where, maps in result.maps.items() for name, a in maps.items()}
    if arrays:
        np.savez_compressed(path.with_suffix(".npz"), **arrays)
    path.write_text(json.dumps(result.to_json(), ensure_ascii=False, indent=0), encoding="utf-8")


def load(folder: Path, names: Iterable[str]) -> dict[str, Result]:
    """The results that the folder holds of these experiments."""
    return {name: _read(folder / f"{name}.json") for name in names if (folder / f"{name}.json").is_file()}


def _read(path: Path) -> Result:
    result = Result.from_json(json.loads(path.read_text(encoding="utf-8")))
    if path.with_suffix(".npz").is_file():
        with np.load(path.with_suffix(".npz")) as archive:
            for key in archive.files:
                panel, variant, name = key.split("|")
                result.maps.setdefault((panel, variant), {})[name] = archive[key]
    return result
