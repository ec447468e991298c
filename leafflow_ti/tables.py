"""Tables: named columns of equal length, as CSV, Parquet or a pandas DataFrame, with the unit in each name.

CSV is what R (``read.csv``), pandas and spreadsheets take as it is: one line of names, comma, decimal point, empty
where a value is missing.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import MissingExtra, UsageError
from leafflow_ti.whole import appearing

if TYPE_CHECKING:
    import pandas

Columns = Mapping[str, NDArray[Any]]
"""Name -> values [n]: floating (NaN is missing), integers, bool, datetime64 (NaT is missing) or text."""

SUFFIXES = (".csv", ".parquet")


def column_name(name: str, unit: str) -> str:
    """Name of a column with its unit: ``growth``, ``%/h`` give ``growth_percent_per_h``; ``1`` adds nothing."""
    above, _, below = unit.partition("/")
    words = [name]
    if above != "1":
        words.append(above)
    if below:
        words += ["per", *below.strip("()").split()]
    return "_".join(words).replace("%", "percent").replace("°", "deg").replace("²", "2").replace("-", "_")


def check_table_path(path: str | Path, overwrite: bool = False) -> Path:
    """The path of a table that can be written.

    Raises UsageError for another suffix than those of ``SUFFIXES``, or where ``path`` exists and may not be replaced;
    MissingExtra for Parquet without pyarrow.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{path}: the table's format is not clear: let the name end in {' or '.join(SUFFIXES)}")
    if path.is_dir() or (path.exists() and not overwrite):
        raise UsageError(f"{path} exists: {'' if path.is_dir() else 'give --overwrite to replace it, or '}another name")
    if path.suffix.lower() == ".parquet":
        _parquet()
    return path


def write_table(columns: Columns, path: str | Path, overwrite: bool = False) -> Path:
    """Write the columns to ``path``, CSV or Parquet by its suffix; the file appears when it is whole.

    Raises like ``check_table_path``, and RunError when it cannot be written.
    """
    path = check_table_path(path, overwrite)
    with appearing(path) as scratch:
        if path.suffix.lower() == ".csv":
            with scratch.open("w", newline="", encoding="utf-8") as file:
                write_rows(file, columns)
        else:
            arrow, parquet = _parquet()
            table = arrow.table({name: arrow.array(values, from_pandas=True) for name, values in columns.items()})
            parquet.write_table(table, scratch)
    return path


def write_rows(file: TextIO, columns: Columns, header: bool = True) -> None:
    """Write the columns as lines of CSV to a file that was opened with ``newline=""``."""
    writer = csv.writer(file, lineterminator="\n")
    if header:
        writer.writerow(columns)
    writer.writerows(zip(*(_cells(values) for values in columns.values()), strict=True))


def to_pandas(columns: Columns) -> pandas.DataFrame:
    """The columns as a DataFrame; MissingExtra where pandas is not installed."""
    try:
        import pandas
    except ImportError:
        raise MissingExtra("pandas", "parquet", "a table as a DataFrame") from None
    return pandas.DataFrame(dict(columns))


def _cells(values: NDArray[Any]) -> list[Any]:
    """Values as the text of their cells, empty where one is missing."""
    if values.dtype.kind == "f":
        digits = 7 if values.dtype.itemsize <= 4 else 10
        return [f"{v:.{digits}g}" if v == v else "" for v in values.tolist()]
    if values.dtype.kind == "M":
        return ["" if text == "NaT" else text for text in np.datetime_as_string(values, unit="s").tolist()]
    return list(values.tolist())


def _parquet() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("pyarrow", "parquet", "writing Parquet") from None
    return pyarrow, pyarrow.parquet
