"""Numbers as people read them: digits, errors, steps of axes, durations."""

from __future__ import annotations

from leafflow_ti.number_text import axis_labels, duration, readable, round_steps, to_digits_of, with_error


def test_numbers_as_people_read_them() -> None:
    assert [readable(v) for v in (0.04123, -1040.4, 3.1e-6, 0, float("nan"))] == [
        "0.0412",
        "−1040",
        "3.10e−6",
        "0",
        "–",
    ]
    assert with_error(0.41234, 0.0131) == "0.412 ± 0.013"
    assert with_error(0.04003, 5.7e-5) == "0.040030 ± 0.000057"
    assert with_error(-1e-7, 2e-3) == "0.0000 ± 0.0020"
    assert with_error(-2e-8, 1.3e-7) == "−2.0e−8 ± 1.3e−7"
    assert with_error(5.0, float("nan")) == "5.00"
    assert to_digits_of(249.98765, 0.0068) == "249.9877"
    assert to_digits_of(249.98765, None) == "250.0"
    assert [duration(s) for s in (0.123, 45.2, 120, 200, 7500, 273600)] == [
        "0.12 s", "45 s", "2 min", "3 min 20 s", "2 h 05 min", "3 d 04 h",
    ]  # fmt: skip
    steps = round_steps(-0.013, 0.042, 5)
    assert axis_labels(steps) == ["0", "0.02", "0.04"]
    assert axis_labels(round_steps(4, 7, 6, 1.0)) == ["4", "5", "6", "7"]
    assert axis_labels(round_steps(3, 9, 6)) == ["3", "4", "5", "6", "7", "8", "9"]
