"""What a kind of hostile input is, and how one trial of it is judged.

A trial makes one input from a random generator, hands it to the program, and names the outcome: ``values``,
``refused`` (a LeafflowError of one line), or whatever else is right for its kind. Anything that is not right is raised:
``Defect`` with what was found, or the exception that escaped from the program.
"""

from __future__ import annotations

import importlib
import json
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from leafflow_ti.errors import LeafflowError

Trial = Callable[[np.random.Generator, Path], str]


class Defect(Exception):
    """What the program did wrong with an input."""


@dataclass(frozen=True)
class Kind:
    """One kind of input.

    ``prepare(folder)``: called once per process, gives the trial: a function of a random generator and an empty folder
    for its files, which returns the outcome. Only these two may decide what the input is, so that a seed repeats it.
    ``memory``: bytes of address space that a trial may add. ``share``: its part of the inputs of a round.
    """

    name: str
    prepare: Callable[[Path], Trial]
    memory: int
    share: float = 1.0


KINDS = {
    "image": "perf.fuzz.images:KIND",
    "description": "perf.fuzz.descriptions:KIND",
    "tree": "perf.fuzz.trees:KIND",
    "command": "perf.fuzz.commands:KIND",
}
"""Every kind by name: the module and the name of its Kind there, imported only by the process that needs it."""


def load(name: str) -> Kind:
    """The kind of this name, or at this ``module:name``."""
    module, _, attribute = KINDS.get(name, name).partition(":")
    kind = getattr(importlib.import_module(module), attribute)
    assert isinstance(kind, Kind)
    return kind


@dataclass(frozen=True)
class Verdict:
    """Outcome of one trial; ``defect``: empty if all is right."""

    outcome: str
    defect: str = ""

    def to_line(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self))


def judge(trial: Trial, seed: tuple[int, int], folder: Path) -> Verdict:
    """One trial, the number of the round and of the input as ``seed``; nothing escapes but what ends the process."""
    try:
        return Verdict(trial(np.random.default_rng(seed), folder))
    except Defect as error:
        return Verdict("defect", str(error))
    except MemoryError:
        return Verdict("defect", "asked for more memory than the cap")
    except BaseException as error:
        return Verdict("defect", "".join(traceback.format_exception(error)).strip())


def refused(error: LeafflowError, name: str) -> str:
    """The outcome of a refusal: its line must be one, short enough to read, and contain ``name``."""
    line = str(error)
    if len(line.splitlines()) != 1 or len(line) > 1000 or not line.isprintable():
        raise Defect(f"an error that is not one readable line: {line[:2000]!r}") from error
    if name not in line:
        raise Defect(f"an error that does not name {name!r}: {line}") from error
    return "refused"
