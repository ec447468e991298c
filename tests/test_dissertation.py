"""The page of the dissertation: experiments are consistent, records are right, the page is whole and stands alone."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.metrics import summarise
from perf.cases import CASES, Options
from perf.dissertation import case, goals, measure, page, scenes, store
from perf.dissertation.cells import Check, Goal, diagram_cell, goal_cells, number, select, table_cells
from perf.dissertation.chapter3 import TABLE_31
from perf.dissertation.chapter4 import CHANGES, change, lit
from perf.dissertation.experiment import QUANTITIES, Diagram, Experiment, Panel, Point, Printed, Table, Variant
from perf.dissertation.measure import Failure, Record, Result

NAMES = [experiment.name for experiment in goals.EXPERIMENTS]
VOID = {"meta", "img", "br"}


@pytest.mark.parametrize("experiment", goals.EXPERIMENTS, ids=NAMES)
def test_tables_and_diagrams_refer_to_what_is_measured(experiment: Experiment) -> None:
    variants = {(panel.name, variant.label) for panel in experiment.panels for variant in panel.variants}
    panels = {panel.name: panel for panel in experiment.panels}
    assert len(panels) == len(experiment.panels)
    for panel in experiment.panels:
        assert len({variant.label for variant in panel.variants}) == len(panel.variants)
        assert len({point.x for point in panel.points}) == len(panel.points)
    for table in experiment.tables:
        for row in table.rows.values():
            for column in table.columns.values():
                both = {**row, **column}
                assert both["quantity"] in QUANTITIES
                assert any(p == both["panel"] and v == both.get("variant", v) for p, v in variants)
                assert "x" not in both or both["x"] in [point.x for point in panels[both["panel"]].points]
        for row, column in (*table.printed, *table.goals):
            assert row in table.rows
            assert column in table.columns
        assert all((key if isinstance(key, str) else key[0]) in table.rows for key in table.reasons)
    for diagram in experiment.diagrams:
        assert set(diagram.curves.values()) <= variants
        assert diagram.quantity in QUANTITIES
        assert (diagram.printed is None) == (diagram.best is None)
        assert diagram.best is None or diagram.best in diagram.curves


def test_every_experiment_is_a_case_and_goals_refer_to_experiments() -> None:
    assert set(NAMES) | {case.ALL, case.REDRAW} <= {entry.name for entry in CASES}
    for check in (check for goal in goals.GOALS for check in goal.checks):
        panels = {panel.name: panel for panel in goals.find(check.experiment).panels}
        for selection in (check.selection, *([] if isinstance(check.limit, float) else [check.limit])):
            assert selection["variant"] in [v.label for v in panels[selection["panel"]].variants]


@pytest.mark.parametrize("kind", CHANGES)
def test_brightness_truth_is_the_change_of_the_material_point(kind: str) -> None:
    scene = replace(lit(*change(kind, 0.01), noise=0.0), size=(7, 5))
    offsets = scene.material(scene.intersect(scene.rays(), np.zeros(3), 0.0), 0.0)
    step = 1e-3
    before, after = (scene.log_brightness(offsets, np.zeros(3), t) for t in (-step, step))
    truth = scenes.truth(scene)
    np.testing.assert_allclose(truth["brightness_t"], (after - before) / (2 * step), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(truth["brightness_world_tt"], (after + before) / step**2, rtol=1e-6, atol=1e-9)
    slope = np.gradient(truth["brightness_t"], axis=1) / np.gradient(offsets[..., 0], axis=1)
    # Y of the point changes along a row as well, by the plane's perspective: far less than X.
    np.testing.assert_allclose(truth["brightness_world_x"], slope, rtol=1e-6, atol=1e-9)


def test_records_of_several_sequences_are_those_of_all_values() -> None:
    generator = np.random.default_rng(3)
    parts = [generator.normal(k, 1.0 + k, 10 + 5 * k) for k in range(3)]
    summaries = [(summarise(part), 40) for part in parts]
    record = measure._pooled("p", "v", "all", 0.0, "N", [(s, n) for s, n in summaries if s])
    everything = np.concatenate(parts)
    assert record.n == everything.size
    assert record.share == everything.size / 120
    assert record.mean == pytest.approx(everything.mean())
    assert record.std == pytest.approx(everything.std())


def test_a_sequence_with_noise_adds_its_seed_to_one_rendering() -> None:
    scene = replace(scenes.sinusoid(noise=2.0), n_frames=1, size=(40, 30))
    clean, first, second = (
        scenes.capture(*given).read(0, 0, 0, 0, 30, 0, 40, np.float64)
        for given in ((replace(scene, noise=0.0), 0), (scene, 0), (scene, 1))
    )
    assert 1.8 < (first - clean).std() < 2.2
    assert 2.5 < (first - second).std() < 3.2  # √2 times as large: independent


def _record(**changes: object) -> Record:
    return replace(Record("p", "a", "all", 0.0, "N", n=9, share=1.0, mean=0.3, std=0.4), **changes)  # type: ignore[arg-type]


TABLE = Table(
    "errors",
    {"a": {"panel": "p", "variant": "a"}, "b": {"panel": "p", "variant": "b"}},
    {"N": {"quantity": "N"}, "growth": {"quantity": "RGR", "statistic": "rms"}},
    {("a", "N"): Printed(0.25), ("a", "growth"): Printed(-0.3, 0.41), ("b", "N"): Printed(1.0)},
    {("a", "N"): 0.4},
    {"a": "the window is too small"},
)


def test_cells_are_better_worse_or_not_measured() -> None:
    result = Result("e", False, failures=[Failure("p", "b", 0.0, "no such model")])
    result.records += [_record(), _record(quantity="RGR", mean=-0.3)]
    (worse, better), (failed, nothing) = table_cells(TABLE, result)
    assert (worse.better, worse.met, worse.reason) == (False, True, "the window is too small")
    assert worse.text == "0.3 ± 0.4"
    assert (better.value, better.better, better.reason) == (pytest.approx(0.5), True, "")
    assert (failed.measured, failed.better) == (False, False)
    assert failed.note
    assert nothing.better is None


def test_what_the_quick_version_leaves_out_is_not_compared() -> None:
    assert all(cell.better is False for cell in table_cells(TABLE, Result("e", False))[0])
    assert all(cell.better is None for cell in table_cells(TABLE, Result("e", True))[0])


def test_a_diagram_is_held_to_the_upper_end_of_the_printed_range() -> None:
    diagram = Diagram("d", "N", "x", {"a": ("p", "a")}, printed=(0.1, 0.35), best="a", reason="too steep")
    result = Result("e", False, records=[_record(), _record(x=1.0, mean=0.34)])
    cell = diagram_cell(diagram, result)
    assert cell is not None
    assert (cell.value, cell.better, cell.reason) == (0.34, True, "")
    result.records.append(_record(x=2.0, mean=0.36))
    cell = diagram_cell(diagram, result)
    assert cell is not None
    assert (cell.better, cell.reason) == (False, "too steep")
    assert "at 2" in cell.note


def test_goals_compare_with_numbers_and_with_other_records() -> None:
    a, b = ({"panel": "p", "variant": variant, "quantity": "N"} for variant in "ab")
    goal = Goal("g", (Check("n", "e", a, 0.3), Check("o", "e", a, b), Check("m", "e", b, 0.2, "|mean|")))
    results = {"e": Result("e", False, records=[_record(), _record(variant="b", mean=-0.2)])}
    assert [cell.met for cell in goal_cells(goal, results)] == [True, False, True]
    assert [cell.met for cell in goal_cells(goal, {})] == [False, False, False]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.25941, "0.259"), (-12.345, "-12.3"), (1234.5, "1234"), (0.0008466, "0.000847"), (2.614e-5, "2.61e-05")],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text
    assert number(math.nan) == "–"


class _Checker(HTMLParser):
    """Every element is closed in order; nothing is loaded from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name in ("src", "href"):
                assert str(value).startswith(("#", "data:image/")), value
        self.images += tag == "img"

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def _tiny() -> Experiment:
    """One orientation of Table 3.1 in a small region, and a model that does not exist."""
    panel = TABLE_31.panels[0]
    x0, y0, _, _ = panel.roi
    variants = (*panel.variants, Variant("none", {"model": "no-such-model"}))
    small = replace(panel, points=panel.points[:1], variants=variants, roi=(x0, y0, x0 + 9, y0 + 5), keep_maps=False)
    table = TABLE_31.tables[0]
    rows = {key: value for key, value in table.rows.items() if value["panel"] == panel.name}
    first = next(iter(table.columns))
    printed = {key: value for key, value in table.printed.items() if key[0] in rows and key[1] == first}
    one = replace(table, rows=rows, columns={first: table.columns[first]}, printed=printed)
    curves = {v.label: (panel.name, v.label) for v in variants}
    return replace(TABLE_31, panels=(small,), tables=(one,), diagrams=(Diagram("t", "normal", "α [deg]", curves),))


def test_a_tiny_experiment_runs_to_a_page_that_stands_alone(tmp_path: Path) -> None:
    experiment = _tiny()
    result = measure.run(experiment)
    # The printed values of this orientation are two orders of magnitude above what exact images allow.
    assert all(cell.better for row in table_cells(experiment.tables[0], result) for cell in row)
    assert [failure.variant for failure in result.failures] == ["none"]
    assert "no-such-model" in result.failures[0].message
    result.maps["panel", "variant"] = {"error": np.eye(6), "velocity": np.ones((6, 6, 3))}
    store.save(tmp_path, result)
    loaded = store.load(tmp_path, NAMES)
    assert list(loaded) == ["table-3.1"]
    assert loaded["table-3.1"].records == result.records
    np.testing.assert_array_equal(loaded["table-3.1"].maps["panel", "variant"]["error"], np.eye(6))
    path, values = page.write_page(tmp_path, loaded)
    text = path.read_text(encoding="utf-8")
    assert len(text) < 5_000_000
    checker = _Checker()
    checker.feed(text)
    assert checker.open == []
    assert checker.images == 1  # the maps; the diagram of the complete experiment has no point
    assert "no-such-model" in text
    assert not re.search(r"https?://(?!www\.w3\.org)", text)
    assert json.loads(values.read_text(encoding="utf-8"))["experiments"]["table-3.1"]["quick"] is False


def test_diagrams_are_drawn_with_a_legend() -> None:
    from perf.dissertation.plots import draw_diagrams

    experiment = _tiny()
    result = Result("e", False)
    name = experiment.panels[0].name
    result.records += [_record(panel=name, variant="depth", quantity="normal", x=x) for x in (1.0, 2.0)]
    (svg,) = draw_diagrams(experiment, result)
    assert svg.count("<svg") == 1
    assert "legend" in svg
    assert draw_diagrams(experiment, Result("e", False)) == []


def test_the_page_can_be_drawn_once_more(tmp_path: Path) -> None:
    store.save(tmp_path / "dissertation", Result("table-5.1", False, records=[_record()]))
    outcome = case.run(Options(tmp_path, case=case.REDRAW))
    assert outcome.pictures[0].is_file()
    assert any(figure.name.startswith("table-5.1") for figure in outcome.figures)
    assert select(store.load(tmp_path / "dissertation", NAMES)["table-5.1"], {"variant": "a"}) == _record()


def test_quick_panels_keep_both_ends_of_the_abscissa_and_few_variants() -> None:
    points = tuple(Point(float(x), scenes.sinusoid()) for x in range(6))
    variants = tuple(Variant(str(k), {}) for k in range(14))
    panel = Panel("p", points, variants, (0, 0), (0, 0, 1, 1), 4, seeds=3).quick()
    assert [point.x for point in panel.points] == [0.0, 5.0]
    assert [variant.label for variant in panel.variants] == ["0", "4", "8", "12"]
    assert (panel.seeds, panel.stride) == (1, 8)
    assert replace(panel, variants=variants[:4]).quick().variants == variants[:4]
