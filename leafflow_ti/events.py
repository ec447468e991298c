"""What a run says while it works: events of the standard logger ``leafflow_ti``, with their facts as plain values.

Nothing is printed here: programs that embed the package attach their own handlers, the command line its own. An event
has a name for programs (``unit``, ``retry``, ``quarantine``, ...), a sentence for people, and facts that JSON can hold.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import Any

LOGGER = logging.getLogger("leafflow_ti")
LOGGER.addHandler(logging.NullHandler())


def event(name: str, message: str, level: int = logging.INFO, **facts: Any) -> None:
    """Log one event; ``facts``: JSON values."""
    if LOGGER.isEnabledFor(level):
        LOGGER.log(level, "%s", message, extra={"event": name, "facts": facts})


def warn(message: str, **facts: Any) -> None:
    """Say what does not stop the work, but may spoil its result; message: value, what is plausible, the way out."""
    event("warning", message, logging.WARNING, **facts)


class _Collected(logging.Handler):
    def __init__(self, texts: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._texts = texts

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if getattr(record, "event", None) == "warning" and text not in self._texts:
            self._texts.append(text)


@contextlib.contextmanager
def warnings_said() -> Iterator[list[str]]:
    """Gives the list of the warnings, each once, that are said while the block runs."""
    texts: list[str] = []
    handler = _Collected(texts)
    LOGGER.addHandler(handler)
    try:
        yield texts
    finally:
        LOGGER.removeHandler(handler)
