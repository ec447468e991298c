"""Records beside printed values and goals: cells of the tables, checks of the diagrams, the goals of the project."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from perf.dissertation.experiment import QUANTITIES, Diagram, Experiment, Printed, Selection, Statistic, Table
from perf.dissertation.measure import Record, Result
from perf.figures import Figure


@dataclass(frozen=True)
class Cell:
    """One value of a table or a diagram beside its references.

    ``value`` is compared, ``text`` is shown; NaN where nothing was measured, and ``note`` says why. ``reference`` is
    what is printed, in the same statistic; ``goal`` an upper limit of this project.
    """

    row: str
    column: str
    value: float
    text: str
    unit: str = ""
    printed: str = ""
    reference: float | None = None
    goal: float | None = None
    note: str = ""
    reason: str = ""

    @property
    def measured(self) -> bool:
        """Whether there is a value."""
        return math.isfinite(self.value)

    @property
    def better(self) -> bool | None:
        """Whether the value is at most the printed one; None where nothing is printed."""
        return None if self.reference is None else self._within(self.reference)

    @property
    def met(self) -> bool | None:
        """Whether the goal is met; None where there is none."""
        return None if self.goal is None else self._within(self.goal)

    def _within(self, limit: float) -> bool:
        return self.measured and self.value <= limit

    def to_json(self) -> dict[str, Any]:
        """The cell as plain values."""
        value = self.value if math.isfinite(self.value) else None
        return {**asdict(self), "value": value, "better": self.better, "met": self.met}

    def figures(self, experiment: str) -> Iterator[Figure]:
        """The cell as figures of the case, one for the print and one for the goal."""
        name, note = f"{experiment}: {self.row}, {self.column}", self.text if "±" in self.text else self.note
        for limit, kind in ((self.reference, "printed"), (self.goal, "goal")):
            if limit is not None:
                yield Figure(name, self.value, self.unit, limit, "printed" if kind == "printed" else "goal", note=note)


def number(value: float) -> str:
    """Three digits; whole numbers from 1000 on."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"


def select(result: Result | None, selection: Selection) -> Record | None:
    """The record whose fields have the selected values; None if there is none."""
    fields = {key: value for key, value in selection.items() if key != "statistic"}
    records = result.records if result else []
    return next((r for r in records if all(getattr(r, k) == v for k, v in fields.items())), None)


def table_cells(table: Table, result: Result) -> list[list[Cell]]:
    """The cells of a table, row by row."""
    return [[_cell(table, row, column, result) for column in table.columns] for row in table.rows]


def _cell(table: Table, row: str, column: str, result: Result) -> Cell:
    selection = {**table.rows[row], **table.columns[column]}
    statistic: Statistic = selection.get("statistic", "mean")
    record = select(result, selection)
    if record is None and result.quick and not _failure(result, selection):
        return Cell(row, column, math.nan, "–", note="not in the quick version")
    printed = table.printed.get((row, column))
    cell = _measured(row, column, record, statistic, _failure(result, selection))
    cell = replace(
        cell,
        printed=_text(printed.value, printed.std) if printed else "",
        reference=_comparable(printed, statistic) if printed else None,
        goal=table.goals.get((row, column)),
    )
    reason = table.reasons.get((row, column), table.reasons.get(row, ""))
    return replace(cell, reason=reason if cell.better is False or cell.met is False else "")


def _measured(row: str, column: str, record: Record | None, statistic: Statistic, failure: str) -> Cell:
    if record is None:
        return Cell(row, column, math.nan, "–", note=failure)
    text = number(record.std) if statistic == "std" else _text(record.mean, record.std)
    note = f"{record.share:.0%} of the pixels" if record.share < 0.995 else ""
    return Cell(row, column, record.statistic(statistic), text, QUANTITIES[record.quantity].unit, note=note)


def _failure(result: Result, selection: Selection) -> str:
    for failure in result.failures:
        if all(getattr(failure, k) == selection[k] for k in ("panel", "variant", "x") if k in selection):
            return "not measured, see below"
    return ""


def _text(mean: float, std: float | None) -> str:
    return number(mean) if std is None else f"{number(mean)} ± {number(std)}"


def _comparable(printed: Printed, statistic: Statistic) -> float:
    return math.hypot(printed.value, printed.std or 0.0) if statistic == "rms" else printed.value


def diagram_cell(diagram: Diagram, result: Result) -> Cell | None:
    """The worst point of the best curve against the printed range; None where no range is printed."""
    if diagram.printed is None or diagram.best is None:
        return None
    points = curve(diagram, diagram.best, result)
    if result.quick and not points:
        return None
    value = max((y for _, y in points), default=math.nan)
    low, high = diagram.printed
    quantity = QUANTITIES[diagram.quantity]
    above = [f"{x:g}" for x, y in points if y > high]
    note = f"above it at {', '.join(above)}" if above else "" if points else "not measured, see below"
    cell = Cell(
        f"{diagram.title}, {diagram.best}", f"{quantity.label}, largest over {diagram.x_label}", value, number(value),
        quantity.unit, f"{low:.0e} to {high:.0e}", high, note=note,
    )  # fmt: skip
    return replace(cell, reason=diagram.reason if cell.better is False else "")


def diagram_cells(experiment: Experiment, result: Result) -> list[Cell]:
    """The checks of all diagrams with a printed range."""
    return [cell for diagram in experiment.diagrams if (cell := diagram_cell(diagram, result))]


def curve(diagram: Diagram, label: str, result: Result) -> list[tuple[float, float]]:
    """Points (x, value) of one curve, in the order of x."""
    panel, variant = diagram.curves[label]
    return sorted(
        (record.x, record.statistic(diagram.statistic))
        for record in result.records
        if (record.panel, record.variant, record.region, record.quantity)
        == (panel, variant, diagram.region, diagram.quantity)
    )


def experiment_cells(experiment: Experiment, result: Result) -> list[Cell]:
    """All cells of an experiment that have a reference."""
    cells = [cell for table in experiment.tables for row in table_cells(table, result) for cell in row]
    cells += diagram_cells(experiment, result)
    return [cell for cell in cells if cell.better is not None or cell.met is not None]


@dataclass(frozen=True)
class Check:
    """One value that the project is held to: a record's statistic, at most ``limit`` (a number, or another record).

    ``reason``: why it is missed.
    """

    text: str
    experiment: str
    selection: Selection
    limit: float | Selection
    statistic: str = "mean"
    reason: str = ""


@dataclass(frozen=True)
class Goal:
    """Something the project must show, and how it is checked."""

    text: str
    checks: tuple[Check, ...]


def goal_cells(goal: Goal, results: Mapping[str, Result]) -> list[Cell]:
    """The checks of a goal with what was measured."""
    return [_checked(check, results.get(check.experiment)) for check in goal.checks]


def _checked(check: Check, result: Result | None) -> Cell:
    record = select(result, check.selection)
    limit = check.limit
    if not isinstance(limit, int | float):
        other = select(result, limit)
        limit = other.mean if other else math.nan
    if record is None:
        note = _failure(result, check.selection) if result else "not run"
        return Cell(check.text, "", math.nan, "–", goal=limit, note=note or "not measured")
    value = {"mean": record.mean, "|mean|": abs(record.mean), "std": record.std}[check.statistic]
    text = _text(record.mean, record.std) if check.statistic == "mean" else number(value)
    cell = Cell(check.text, "", value, text, QUANTITIES[record.quantity].unit, goal=limit)
    return cell if cell.met else replace(cell, reason=check.reason)
