"""The results store of a run: made, or gone on with, and who worked on it for how long."""

from __future__ import annotations

import secrets
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.capture import Capture
from leafflow_ti.chunk_files import flush, writing
from leafflow_ti.config import RunConfig
from leafflow_ti.errors import RunError
from leafflow_ti.growing import extend
from leafflow_ti.placing import flush_names, remove_abandoned
from leafflow_ti.plan import Plan
from leafflow_ti.progress import Timings
from leafflow_ti.provenance import SHOWN, changed_files, differences, versions
from leafflow_ti.results import ResultStore
from leafflow_ti.schedule import Missing

FOLLOWED = "followed"
"""Attribute of a store whose capture was followed: what is decided from images was decided from the first ones."""


def create_store(
    out: Path, plan: Plan, attrs: dict[str, Any], capture: Capture, overwrite: bool = False
) -> ResultStore:
    """An empty results store for a plan; errors as of ``ResultStore.create``."""
    stamps, times = capture.stamps_s, None
    if stamps is not None:
        end = len(stamps) - 1
        times = [stamps[t] + plan.time_offset * (stamps[min(t + 1, end)] - stamps[t]) for t in plan.frames]
    return ResultStore.create(
        out, frames=plan.frames, y=np.array(plan.y), x=np.array(plan.x), names=plan.names,
        chunk=(1, plan.band_rows, len(plan.x)), attrs=attrs, interval_s=capture.frame_interval_s,
        time_offset=plan.time_offset, times_s=times, overwrite=overwrite,
    )  # fmt: skip


def open_store(out: Path, plan: Plan, attrs: dict[str, Any], capture: Capture) -> tuple[ResultStore, bool]:
    """The store of an earlier run, to go on with it, and whether its input has changed meanwhile.

    Images may, which no unit that is done has needed: an unreadable one was mended, or a capture that is still being
    taken has grown. Raises RunError where the store belongs to another run, and says what differs.
    """
    remove_abandoned(out)
    store = ResultStore.open(out)
    flush_names(out)
    flush(out / "status" / ".done")  # a process may have been killed between a marker and this
    spared = _spared(store, plan, attrs, capture)
    changed = differences(store.attrs, attrs, spared)
    if store.frames != plan.frames[: len(store.frames)] or (len(store.frames) < len(plan.frames) and not spared):
        changed.append(f"its frames are {_ends(store.frames)}, those of this run {_ends(plan.frames)}")
    if changed:
        more = f" and {len(changed) - SHOWN} more" if len(changed) > SHOWN else ""
        raise RunError(
            f"{out} cannot be resumed, it belongs to another run: {'; '.join(changed[:SHOWN])}{more}; use --overwrite, "
            "or another output"
        )
    return store, bool(spared)


def take_new_input(store: ResultStore, plan: Plan, attrs: dict[str, Any]) -> ResultStore:
    """The store with the frames of a plan, and the input of a run that goes on with it; it must be this run's alone."""
    store = extend(store, plan.frames)
    store.update_attrs({key: attrs[key] for key in ("input", "input_files")})
    return store


def _spared(store: ResultStore, plan: Plan, attrs: dict[str, Any], capture: Capture) -> set[str]:
    """Files that have changed, and that no unit that is done has needed."""
    files = changed_files(store.attrs, attrs)
    before, after = plan.around
    done = {store.frames[unit // store.bands] for unit in store.done()}
    used = {near for t in done for near in range(t - before, t + after + 1)}
    return {name for name in files if (frames := capture.frames_of(name)) and not frames & used}


def _ends(frames: Sequence[int]) -> str:
    return f"{frames[0]}..{frames[-1]}"


def as_decided(config: RunConfig, out: Path) -> RunConfig:
    """The configuration with what was decided from the first images of a capture that was followed, where it leaves
    that open; the same where the store is of no such run."""
    attrs = ResultStore.open(out).attrs
    if not attrs.get(FOLLOWED):
        return config
    decided = RunConfig.model_validate(tomllib.loads(attrs["config"]))
    found: dict[str, Any] = {}
    if config.model.noise == "auto":
        found["model"] = config.model.model_copy(update={"noise": decided.model.noise})
    if config.preshift in ("auto", "uniform"):
        found["preshift"] = decided.preshift
    return config.model_copy(update=found)


def with_bands_of(config: RunConfig, out: Path) -> RunConfig:
    """The configuration with units as high as those of a store: they may have been planned on another machine."""
    rows = ResultStore.open(out).unit_rows
    return config.model_copy(update={"plan": config.plan.model_copy(update={"tile": rows})})


@dataclass(frozen=True)
class Record:
    """What one run has done for a store: a row of its attribute ``runs``, from which ``timings`` follows."""

    id: str
    started: str
    executor: str
    versions: dict[str, str]
    timings: Timings
    ended: str = ""
    """How: "" while it works, or where it was killed."""

    @classmethod
    def begin(cls, executor: str, ago_s: float) -> Record:
        """Of a run that began so many seconds ago."""
        started = (datetime.now(UTC) - timedelta(seconds=ago_s)).isoformat(timespec="seconds")
        return cls(secrets.token_hex(8), started, executor, versions(), Timings())

    def write(
        self, store: ResultStore, timings: Timings, said: list[str], missing: list[dict[str, Any]], ended: str = ""
    ) -> None:
        """Put it into the attributes of a store, beside those of other runs.

        ``said``: warnings; ``missing``: units that were given up, unless they are done meanwhile.
        Raises RunError when the store cannot be written, or is not there any more.
        """
        with writing(store.path):
            done = store.done()
        record = replace(self, timings=timings, ended=ended).to_json()

        def change(attrs: dict[str, Any]) -> dict[str, Any]:
            runs = [r for r in attrs.get("runs", []) if r["id"] != self.id] + [record]
            given_up = {m["unit"]: m for m in [*attrs.get("missing", []), *missing] if m["unit"] not in done}
            total = sum((Timings.of(r["timings"]) for r in runs), Timings())
            return attrs | {
                "device": timings.device or attrs.get("device"),
                "timings": total.to_json(),
                "runs": runs,
                "warnings": list(dict.fromkeys([*attrs.get("warnings", []), *said])),
                "missing": [given_up[unit] for unit in sorted(given_up)],
            }

        store.change_attrs(change)

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return {**asdict(self), "timings": self.timings.to_json()}


def missing_units(plan: Plan, missing: list[Missing]) -> list[dict[str, Any]]:
    """Units that were given up, as an attribute of a store."""
    found = []
    for m in missing:
        unit = plan.unit(*divmod(m.unit, plan.bands))
        rows = [plan.y[unit.rows.start], plan.y[unit.rows.stop - 1]]
        found.append({"unit": m.unit, "frame": plan.frames[unit.t_index], "rows": rows, "reason": m.failure.message,
                      "attempts": m.attempts})  # fmt: skip
    return found
