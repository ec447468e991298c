"""What a result's reader must know of how it came about, and whether an interrupted run may be gone on with."""

from __future__ import annotations

import os
import platform
import tomllib
from collections.abc import Collection
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from leafflow_ti import __version__
from leafflow_ti.capture import Capture
from leafflow_ti.capture.changes import changes
from leafflow_ti.correlation import stated_correlation
from leafflow_ti.plan import Plan

DECISIVE = ("config", "plan", "input", "leafflow_ti_version")
"""Attributes that decide the results."""
SHOWN = 5
"""Most differences that a message names."""


def provenance(plan: Plan, capture: Capture, contents: bool = True) -> dict[str, Any]:
    """Configuration, plan, versions, input: attributes of a results store or a field.

    ``contents``: with checksums of the grey values, by which a run that is resumed knows its input again.
    """
    g = plan.geometry
    return {
        "config": plan.config.to_toml(),
        "plan": {
            "model": plan.model, "bands": plan.bands,
            "preshift_px": "adaptive" if plan.adaptive else list(plan.preshift),
            "f_px": g.f_px, "principal_px": list(g.principal_px), "baseline_mm": list(g.baseline_mm),
            "disparity_offset_px": list(g.disparity_offset_px), "time_offset": plan.time_offset,
            "image_px": [capture.width, capture.height],
            "noise": plan.noise,
            "noise_correlation": stated_correlation(plan),
        },
        "leafflow_ti_version": __version__,
        "versions": versions(),
        "input": capture.fingerprint(contents)
        | (plan.ranges.given.fingerprint() if plan.ranges and plan.ranges.given else {}),
        **({"input_files": capture.listing} if contents and capture.listing else {}),
    }  # fmt: skip


def versions() -> dict[str, str]:
    """Of Python and of the packages that the results depend on."""

    def installed(package: str) -> str:
        try:
            return version(package)
        except PackageNotFoundError:
            return "absent"

    engine = os.environ.get("LEAFFLOW_TI_ENGINE", "taichi")
    return {"python": platform.python_version()} | {p: installed(p) for p in (engine, "numpy", "zarr")}


def differences(stored: dict[str, Any], now: dict[str, Any], spared: Collection[str] = ()) -> list[str]:
    """What of the decisive provenance differs between a store and a run: one text each, none if they agree.

    ``spared``: names of files that may differ.
    """
    files = changed_files(stored, now)
    old, new = (_decisive(attributes) for attributes in (stored, now))
    told = ("input.files", "input.names_and_sizes_sha256", "input.contents_sha256") if files else ()
    keys = [key for key in sorted({*old, *new}) if old.get(key) != new.get(key) and key not in told]
    # What the plan makes of another configuration says no more than that itself.
    chosen = [key for key in keys if not key.startswith("plan.")]
    texts = [f"{key} was {_short(old.get(key))}, is {_short(new.get(key))}" for key in chosen or keys]
    return texts + [f"{name} {what}" for name, what in files.items() if name not in spared]


def changed_files(stored: dict[str, Any], now: dict[str, Any]) -> dict[str, str]:
    """Files of the input that are not what they were, and what happened to them; none where a store or a capture has
    no listing."""
    old, new = stored.get("input_files"), now.get("input_files")
    if not isinstance(old, str) or not isinstance(new, str):
        return {}
    try:
        return changes(old, new)
    except ValueError:  # a store that was written to: the fingerprints still decide
        return {}


def _decisive(attributes: dict[str, Any]) -> dict[str, Any]:
    """Dotted key -> value of all that decides the results: of the configuration, all but the machine's resources."""
    found: dict[str, Any] = {}
    for key in DECISIVE:
        value = attributes.get(key)
        if key == "config" and isinstance(value, str):
            for name, section in tomllib.loads(value).items():
                if name != "plan":
                    found |= _dotted(name, section)
        else:
            found |= _dotted(key, value)
    return found


def _dotted(prefix: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        return {prefix: value}
    return {k: v for name, inner in value.items() for k, v in _dotted(f"{prefix}.{name}", inner).items()}


def _short(value: Any) -> str:
    text = "not stated" if value is None else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
