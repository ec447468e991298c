"""``python -m perf NAME...``: run cases and print what they measure. Without a name: the list of cases."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from leafflow_ti.errors import LeafflowError
from perf.cases import CASES, Options, find
from perf.figures import to_json, to_text


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; the exit code: 0 (skipped cases too), 2 usage, or that of a LeafflowError."""
    parser = argparse.ArgumentParser(prog="python -m perf", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases to run; none: list them")
    parser.add_argument("--json", action="store_true", help="one JSON object per case instead of a table")
    parser.add_argument("--quick", action="store_true", help="smaller versions of the cases")
    parser.add_argument("--out", type=Path, default=Path("perf-output"), help="folder for pictures [perf-output]")
    parser.add_argument("--count", type=int, help="how many inputs or kills, where a case counts them")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn at random there [0]")
    options = parser.parse_args(arguments)
    for name in options.names:
        if find(name) is None:
            parser.error(f"no case is called {name!r}; there are {', '.join(case.name for case in CASES)}")
    if not options.names:
        width = max(len(case.name) for case in CASES)
        print("\n".join(f"{case.name:<{width}}  {case.summary}" for case in CASES))
    for case in (case for case in CASES if case.name in options.names):
        began = time.perf_counter()
        try:
            outcome = case.load()(Options(options.out, options.quick, case.name, options.count, options.seed))
        except LeafflowError as error:
            print(f"error: {case.name}: {error}", file=sys.stderr)
            return error.exit_code
        show = to_json if options.json else to_text
        print(show(case.name, outcome, time.perf_counter() - began), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
