"""Run configuration: what ``run.toml``, ``--set a.b=v`` and the options of ``run`` say, checked, as one frozen value.

Precedence, lowest first: defaults, preset, file, ``--set``, explicit options. Units: window sizes, sigmas, stride,
region of interest and preshift in pixels; time in frames; cameras in grid steps; memory in bytes.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import Field, ValidationError, field_validator, model_validator

from leafflow_ti.config_sections import (
    FiltersSection,
    ModelSection,
    OutputSection,
    PlanSection,
    Preshift,
    RangeFlowSection,
    RefineSection,
    SearchSection,
    Section,
    WindowSection,
)
from leafflow_ti.config_values import numbers
from leafflow_ti.errors import ConfigError
from leafflow_ti.models import MODELS
from leafflow_ti.presets import (
    MOST_THINNED_ALONE,
    PRESETS,
    REFINED_MODEL,
    REFINED_SAMPLES,
    REFINED_STRIDE,
    REFINED_WINDOW,
    resolve_model,
)

Preset = Literal["fast", "balanced", "accurate"]
Precision = Literal["f32", "f64"]
Arch = Literal["auto", "cpu", "cuda", "vulkan", "metal"]


class RunConfig(Section):
    """A whole run.

    ``preshift``: whole pixels per camera step; ``uniform``: found in the images; ``adaptive``: what a search of every
    frame finds for each pixel, whole-pixel motion included; ``auto``: uniform where that serves nearly all of the
    images, else adaptive. A preset decides ``precision`` unless it is given itself, and what ``resolve`` does.
    """

    preset: Preset = "balanced"
    precision: Precision = "f32"
    arch: Arch = "auto"
    preshift: tuple[int, int] | Preshift = "auto"
    model: ModelSection = ModelSection()
    window: WindowSection = WindowSection()
    filters: FiltersSection = FiltersSection()
    range_flow: RangeFlowSection = RangeFlowSection()
    search: SearchSection = SearchSection()
    refine: RefineSection = RefineSection()
    plan: PlanSection = Field(default_factory=PlanSection)
    output: OutputSection = OutputSection()

    @model_validator(mode="before")
    @classmethod
    def _apply_preset(cls, data: Any) -> Any:
        chosen = PRESETS.get(str(data.get("preset", "balanced"))) if isinstance(data, Mapping) else None
        if chosen is None:
            return data  # the field itself reports what is wrong
        return {"precision": chosen.precision, **data}

    @field_validator("preshift", mode="before")
    @classmethod
    def _check_preshift(cls, value: object) -> object:
        if value in get_args(Preshift):
            return value
        x, *y = numbers(value, (1, 2), f"X or X,Y per camera step, or one of {', '.join(get_args(Preshift))}")
        return (x, *y) if y else (x, 0)

    def to_toml(self) -> str:
        """The configuration as ``run.toml``; ``load_config`` reads the same value back."""
        values = self.model_dump(mode="json", exclude_none=True)
        top = [f"{key} = {_toml(value)}" for key, value in values.items() if not isinstance(value, dict)]
        sections = [
            f"\n[{name}]\n" + "\n".join(f"{key} = {_toml(value)}" for key, value in section.items())
            for name, section in values.items()
            if isinstance(section, dict) and section
        ]
        return "\n".join([*top, *sections]) + "\n"


def _toml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)  # strings, numbers and lists of them are written alike in TOML


KEYWORDS: dict[str, str] = {
    **{name: name for name in ("preset", "precision", "arch", "preshift")},
    "model": "model.name",
    **{name: f"model.{name}" for name in ModelSection.model_fields if name != "name"},
    "window": "window.size",
    **{name: f"window.{name}" for name in WindowSection.model_fields if name != "size"},
    **{name: f"filters.{name}" for name in FiltersSection.model_fields},
    **{name: f"range_flow.{name}" for name in RangeFlowSection.model_fields},
    **{name: f"search.{name}" for name in SearchSection.model_fields},
    "refine": "refine.steps",
    "refine_window": "refine.window",
    "thin": "refine.thin",
    "refine_frames": "refine.frames",
    **{name: f"plan.{name}" for name in PlanSection.model_fields},
    **{name: f"output.{name}" for name in OutputSection.model_fields},
}
"""Keyword of the Python interface and option of ``run`` (with - for _) -> dotted key of the configuration."""


def load_config(
    path: str | Path | None = None, sets: Iterable[str] = (), overrides: Mapping[str, object] | None = None
) -> RunConfig:
    """The checked configuration from a TOML file, ``"a.b=v"`` settings and explicit options, the later winning.

    ``overrides``: keyword of ``KEYWORDS`` or dotted key -> value; None means not given. Paths inside the file are
    relative to the file. Raises ConfigError, one line with key, value, source and what is allowed.
    """
    given: dict[str, tuple[object, str]] = {}
    if path is not None:
        given.update(_read_file(Path(path)))
    for text in sets:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: must be KEY=VALUE, for instance --set window.size=65")
        given[key.strip()] = (_literal(value.strip()), "--set")
    for key, chosen in (overrides or {}).items():
        if chosen is not None:
            given[KEYWORDS.get(key, key)] = (chosen, "option")
    data: dict[str, Any] = {}
    for key, (item, source) in given.items():
        _check_key(key, source)
        section, dot, name = key.partition(".")
        if dot:
            data.setdefault(section, {})[name] = item
        else:
            data[key] = item
    try:
        return RunConfig.model_validate(data)
    except ValidationError as error:
        raise ConfigError("; ".join(_explain(detail, given) for detail in error.errors())) from None


def resolve(config: RunConfig, n_frames: int, n_rows: int, n_cols: int) -> RunConfig:
    """The configuration for a capture with the model, the stride and the refinement decided: none of them is "auto".

    What was given itself wins over the preset. Resolving once more changes nothing.
    """
    name = resolve_model(config.model.name, n_frames, n_rows, n_cols)
    preset, refine, window = PRESETS[config.preset], config.refine, config.window

    def decided(given: int | str, auto: int) -> int:
        return auto if given == "auto" else int(given)

    steps = decided(refine.steps, preset.steps if name == REFINED_MODEL else 0)
    size = decided(refine.window, max(window.size, REFINED_WINDOW))
    thin = max(1, size // REFINED_SAMPLES)
    if MODELS[name].cameras == "reference":
        thin = min(thin, MOST_THINNED_ALONE)
    thin = min(thin, preset.thin or thin)
    sections = {
        "model": {"name": name},
        "window": {"stride": decided(window.stride, max(preset.stride, REFINED_STRIDE if steps else 1))},
        "refine": {
            "steps": steps,
            "window": size,
            "thin": decided(refine.thin, thin),
            "spline": decided(refine.spline, 7 if config.precision == "f64" else 5),
        },
    }
    updated = {key: getattr(config, key).model_copy(update=values) for key, values in sections.items()}
    return config.model_copy(update=updated)


def _read_file(path: Path) -> dict[str, tuple[object, str]]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}): check --config") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not a TOML file: {error}") from None
    given: dict[str, tuple[object, str]] = {}
    for key, value in table.items():
        items = {f"{key}.{name}": v for name, v in value.items()} if isinstance(value, dict) else {key: value}
        given.update((dotted, (item, str(path))) for dotted, item in items.items())
    mask = given.get("output.mask")
    if mask is not None and isinstance(mask[0], str):
        given["output.mask"] = (path.parent / mask[0], mask[1])
    depth = given.get("range_flow.depth")
    if depth is not None and isinstance(depth[0], str):
        given["range_flow.depth"] = (str(path.parent / depth[0]), depth[1])
    return given


def _literal(text: str) -> object:
    """``text`` as a TOML value, or as the string it is: ``--set model.name=depth`` needs no quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _check_key(key: str, source: str) -> None:
    sections = {name: f.annotation for name, f in RunConfig.model_fields.items()}
    names = {n: t.model_fields for n, t in sections.items() if isinstance(t, type) and issubclass(t, Section)}
    known = [n for n in sections if n not in names] + [f"{n}.{name}" for n, fields in names.items() for name in fields]
    if key in names:
        raise ConfigError(f"{key} ({source}): is a section; give one of {', '.join(f'{key}.{n}' for n in names[key])}")
    if key not in known:
        section = key.partition(".")[0]
        near = difflib.get_close_matches(key, known, n=1) or [k for k in known if k.endswith(f".{key}")]
        allowed = ", ".join(f"{section}.{n}" for n in names[section]) if section in names else ", ".join(sections)
        hint = f"did you mean {near[0]}?" if near else f"known: {allowed}"
        raise ConfigError(f"unknown key {key!r} ({source}): {hint}")


def _explain(detail: Mapping[str, Any], given: Mapping[str, tuple[object, str]]) -> str:
    loc = [str(part) for part in detail["loc"]]
    key = next((k for k in (".".join(loc[:2]), loc[0]) if k in given), ".".join(loc))
    value, source = given.get(key, (detail["input"], "default"))
    reason = detail["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    return f"{key} = {str(value)!r} ({source}): {reason}"
