"""A thread-safe store of decoded images that forgets the least recently used ones."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

from leafflow_ti.capture.channels import Array


class ImageCache:
    """Arrays by key, together at most ``limit`` bytes; a larger array is handed out but not kept.

    Made for images that are asked for in the same order again and again: those that do not all fit are not worth
    keeping, since each would be forgotten just before it is needed. Who knows that sets the limit to 0.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.used = 0
        self._images: OrderedDict[Hashable, Array] = OrderedDict()
        self._lock = threading.Lock()
        self._loading: dict[Hashable, threading.Lock] = {}

    def get(self, key: Hashable, load: Callable[[], Array]) -> Array:
        """The array of ``key``, loaded once even if several threads ask for it together; do not write to it."""
        with self._lock:
            if key in self._images:
                self._images.move_to_end(key)
                return self._images[key]
            turn = self._loading.setdefault(key, threading.Lock())
        with turn:
            with self._lock:
                if key in self._images:
                    self._images.move_to_end(key)
                    return self._images[key]
            try:
                image = load()
                image.flags.writeable = False
                with self._lock:
                    self._keep(key, image)
            finally:
                with self._lock:
                    self._loading.pop(key, None)
            return image

    def _keep(self, key: Hashable, image: Array) -> None:
        if image.nbytes > self.limit:
            return
        self._images[key] = image
        self.used += image.nbytes
        self._forget()

    def _forget(self) -> None:
        while self.used > self.limit:
            _, old = self._images.popitem(last=False)
            self.used -= old.nbytes

    def set_limit(self, limit: int) -> None:
        """Keep at most ``limit`` bytes from now on."""
        with self._lock:
            self.limit = limit
            self._forget()
