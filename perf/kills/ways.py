"""Ways to compute a run, and what may be killed of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Victim = Literal["all", "one", "worker", "parent"]


@dataclass(frozen=True)
class Way:
    """``commands``: further options of each command of the run; ``victims``: ``all`` processes, ``one`` of several
    commands, a ``worker`` that a command has started, the ``parent`` of the workers without them."""

    commands: tuple[tuple[str, ...], ...] = ((),)
    victims: tuple[Victim, ...] = ("all",)


SERIAL = Way()
WAYS = {
    "serial": SERIAL,
    "workers": Way((("--workers", "2"),), ("all", "worker", "parent")),
    "dask": Way((("--dask", "local", "--workers", "2"),), ("all", "worker", "parent")),
    "shard": Way((("--shard", "1/2"), ("--shard", "2/2")), ("all", "one")),
}
