"""``kills``: runs of the command line are killed at random moments over their whole life, and resumed to the end.

The reference is an undisturbed run in one process. After every kill the store opens, if there is one, and what is
marked as done has the bytes of the reference; at the end all files have, and nothing else is left in the store or
beside it.
"""

from __future__ import annotations

import random
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from leafflow_ti.errors import RunError
from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.kills.captures import VARIANTS, Variant, make_captures
from perf.kills.chain import OUT, Place, Reference, Tally, fill_store, fill_stores, without_resources
from perf.kills.processes import Life
from perf.kills.stand_in import comparable
from perf.kills.ways import SERIAL, WAYS

KILLS, QUICK_KILLS = 200, 10
SHOWN = 20
DEFECTS = ("not opened", "not whole", "differences", "left over", "wrong exits", "hangs", "orphans")


@dataclass(frozen=True)
class Settings:
    """``kills``: wanted of all ways together, of each as many; ``chains``: stores that are filled at the same time;
    ``cache``: of compiled kernels, None: one of its own."""

    ways: tuple[str, ...]
    kills: int
    seed: int = 0
    chains: int = 2
    variants: tuple[Variant, ...] = VARIANTS
    cache: Path | None = None


def measure(settings: Settings) -> Outcome:
    """Kill and compare; raises RunError where an undisturbed run fails."""
    tallies = {name: Tally(-(-settings.kills // len(settings.ways))) for name in settings.ways}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        place = Place(Path(folder), settings.cache or Path(folder) / "kernels")
        make_captures(place.root)
        references = [_reference(place, variant) for variant in settings.variants]
        for number, (name, tally) in enumerate(tallies.items()):
            if WAYS[name] != SERIAL:  # which the references are; kernels for fewer threads are compiled here
                for reference in references:
                    fill_store(WAYS[name], place, reference, tally, random.Random())
            seeds = [hash((settings.seed, number, n)) for n in range(settings.chains)]
            with ThreadPoolExecutor(settings.chains) as pool:
                running = [pool.submit(fill_stores, WAYS[name], place, references, tally, seed) for seed in seeds]
                for ended in running:
                    ended.result()
    figures = [figure for name, tally in tallies.items() for figure in _figures(name, tally)]
    notes = [f"{name}: {text}" for name, tally in tallies.items() for text in tally.defects[:SHOWN]]
    about = {"kills": settings.kills, "seed": settings.seed, "stores at a time": settings.chains}
    return Outcome(tuple(figures), about, tuple(notes))


def _reference(place: Place, variant: Variant) -> Reference:
    folder, said = place.root / f"reference-{variant.name}", place.root / f"reference-{variant.name}.txt"
    codes, _ = Life([place.command(folder / OUT, variant)], place.environment, said).end()
    if any(codes):
        raise RunError(f"an undisturbed run ended with {codes[0]}: {said.read_text(encoding='utf-8').strip()}")
    return Reference(variant, without_resources(comparable(folder)))


def _figures(name: str, tally: Tally) -> list[Figure]:
    counts = tally.counts
    phases, victims = (
        ", ".join(f"{n} {kind.removeprefix(what)}" for kind, n in sorted(counts.items()) if kind.startswith(what))
        for what in ("phase ", "victim ")
    )
    return [
        Figure(f"{name}: kills", counts["kills"], low=tally.kills, note=f"when: {phases}; who: {victims}"),
        Figure(f"{name}: stores filled", counts["stores"], note=f"in {counts['runs']} runs"),
        *(Figure(f"{name}: {kind}", counts[kind], reference=0) for kind in DEFECTS),
    ]


def run(options: Options) -> Outcome:
    """``kills``: all ways; ``kills-NAME``: that one."""
    _, _, name = options.case.partition("-")
    kills = options.count or (QUICK_KILLS if options.quick else KILLS)
    return measure(Settings((name,) if name else tuple(WAYS), kills, options.seed))
