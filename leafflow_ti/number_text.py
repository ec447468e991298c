"""Numbers as people read them, and round steps of an axis."""

from __future__ import annotations

import math
from collections.abc import Sequence


def readable(value: float, digits: int = 3) -> str:
    """``digits`` significant digits, no exponent from 1e-4 to 1e5: ``0.0412``, ``-1040``, ``3.1e-6``; ``–`` for NaN."""
    if not math.isfinite(value):
        return "–"
    if value == 0 or 1e-4 <= abs(value) < 1e5:
        decimals = 0 if value == 0 else max(0, digits - 1 - math.floor(math.log10(abs(value))))
        return f"{value:.{min(decimals, 9)}f}".replace("-", "−")
    return f"{value:.{digits - 1}e}".replace("e-0", "e-").replace("e+0", "e").replace("e+", "e").replace("-", "−")


def with_error(value: float, error: float) -> str:
    """Value and standard error, both to the error's second digit: ``0.412 ± 0.013``."""
    if not (math.isfinite(error) and error > 0 and math.isfinite(value)):
        return readable(value)
    if max(abs(value), error) < 1e-4:
        return f"{readable(value, 2)} ± {readable(error, 2)}"
    decimals = min(max(0, 1 - math.floor(math.log10(error))), 9)
    shown = 0.0 if abs(value) < 0.5 * 10**-decimals else value  # no minus before zeros alone
    return f"{shown:.{decimals}f} ± {error:.{decimals}f}".replace("-", "−")


def to_digits_of(value: float, error: float | None) -> str:
    """``value`` to the second digit of its standard error; as it is readable where that is not known."""
    return readable(value, 4) if error is None else with_error(value, error).partition(" ±")[0]


def round_steps(low: float, high: float, most: int, least: float = 0.0) -> list[float]:
    """At most ``most`` + 1 multiples of 1, 2 or 5 times a power of ten from ``low`` to ``high``, which differ.

    ``least``: what they are apart at least.
    """
    raw = max((high - low) / most, least)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def axis_labels(steps: Sequence[float]) -> list[str]:
    """The numbers at an axis, all with as many decimals as their distance needs."""
    gap = steps[1] - steps[0] if len(steps) > 1 else abs(steps[0]) or 1.0
    largest = max(abs(s) for s in steps)
    if largest and not 1e-4 <= largest < 1e6:
        return [readable(s, 2) if s else "0" for s in steps]
    decimals = max(0, -math.floor(math.log10(gap) + 1e-9))
    return [f"{s:.{decimals}f}".replace("-", "−") if abs(s) > gap / 2 else "0" for s in steps]


def duration(seconds: float) -> str:
    """``0.12 s``, ``45 s``, ``3 min 20 s``, ``2 h 05 min``, ``3 d 04 h``; a rest of 0 is left out."""
    total = round(seconds)
    for unit, smaller, size, part in (("d", "h", 86400, 3600), ("h", "min", 3600, 60), ("min", "s", 60, 1)):
        if total >= size:
            rest = total % size // part
            return f"{total // size} {unit}" + (f" {rest:02d} {smaller}" if rest else "")
    return f"{total} s" if seconds >= 10 or not seconds else f"{seconds:.2g} s"


def spans(numbers: list[int]) -> str:
    """Increasing numbers in words: 3-5, 9."""
    found: list[list[int]] = []
    for number in numbers:
        if found and number == found[-1][-1] + 1:
            found[-1] = [found[-1][0], number]
        else:
            found.append([number])
    return ", ".join("-".join(map(str, ends)) for ends in found)
