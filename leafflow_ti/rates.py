"""Rates per frame as rates per hour, by the time between frames."""

from __future__ import annotations

SECONDS_PER_HOUR = 3600.0


def per_hour(unit: str, interval_s: float | None) -> tuple[str, float]:
    """Unit per hour of a ``unit`` per frame, and the factor to it: ``"%/frame"`` and 120 s give ``("%/h", 30.0)``.

    A unit without frames stays, with the factor 1, and so does every unit where the interval is not known (None).
    """
    if interval_s is None:
        return unit, 1.0
    for frame, hour, power in (("/frame²", "/h²", 2), ("/frame", "/h", 1), ("/(frame ", "/(h ", 1)):
        if frame in unit:
            return unit.replace(frame, hour), (SECONDS_PER_HOUR / interval_s) ** power
    return unit, 1.0
