"""A folder whose disk loses power, or refuses, at any step of a program in this process.

``Recorder`` watches everything that changes names in a folder, and what is forced to the disk; before each of these
steps is a *moment* at which the power may fail. What is on the disk then is not one state but many: a file's bytes are
sure only if they were synced, a name only if its folder was. ``Moment.tree`` gives the states at the ends of that range
and mixtures of them; ``write_tree`` makes one a folder again, in which a program must find its way.

``Refusing`` lets one of the same steps fail, as on a full disk.
"""

from __future__ import annotations

import builtins
import contextlib
import errno
import io
import os
import stat
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self
from unittest import mock

Tree = dict[str, Any]
"""Contents of a folder: bytes of files, trees of folders."""

Survival = Callable[[Literal["names", "bytes"]], float]
"""How much of a change is on the disk: 0 nothing, 1 all; of the names in a folder all or nothing."""
SURVIVALS: dict[str, Survival] = {
    "what was synced": lambda kind: 0,
    "all names": lambda kind: float(kind == "names"),
    "everything": lambda kind: 1,
}
"""The ends of the range; ``everything`` is what a killed program leaves."""

STEPS = ("fsync", "replace", "rename", "link", "mkdir", "unlink", "remove", "rmdir", "open")
"""Functions of ``os`` that change names or force something to the disk; ``open`` where it makes a file."""
REMOVING = ("unlink", "remove", "rmdir")
"""Those of them that a full disk still does."""
MAKES = os.O_CREAT | os.O_TRUNC


class Died(BaseException):
    """What a killed program does: nothing more, in any thread."""


@dataclass(frozen=True)
class Node:
    """A file, by its bytes, or a folder, by the inode numbers of what it names."""

    holds: bytes | Mapping[str, int]


@dataclass(frozen=True)
class Moment:
    """The moment before a step. ``before``: that in words; ``now``: inode number -> what the system shows, from
    ``root`` on; ``synced``: what was forced to the disk, as it was then."""

    before: str
    root: int
    now: Mapping[int, Node]
    synced: Mapping[int, Node]

    def tree(self, survives: Survival) -> Tree:
        """What is left when the power fails now. ``survives``: asked for every node that has changed since it was
        synced."""
        return self._folder(self.root, survives, frozenset())

    def _folder(self, inode: int, survives: Survival, above: frozenset[int]) -> Tree:
        found: Tree = {}
        for name, child in sorted(self._names(inode, survives).items()):
            # What is gone meanwhile keeps its blocks until its name is off the disk, too.
            node = self.now.get(child) or self.synced.get(child) or Node(b"")
            if isinstance(node.holds, bytes):
                found[name] = self._bytes(child, node.holds, survives)
            elif child not in above:
                found[name] = self._folder(child, survives, above | {inode})
        return found

    def _names(self, inode: int, survives: Survival) -> Mapping[str, int]:
        before, now = (nodes[inode].holds if inode in nodes else {} for nodes in (self.synced, self.now))
        assert not isinstance(before, bytes)
        assert not isinstance(now, bytes)
        return before if before == now or not survives("names") else now

    def _bytes(self, inode: int, now: bytes, survives: Survival) -> bytes:
        before = self.synced[inode].holds if inode in self.synced else b""
        assert isinstance(before, bytes)
        share = 1.0 if before == now else survives("bytes")
        return now[: round(share * len(now))] if share else before


class _Watched(ABC):
    """Puts ``step`` before the functions of the system while a block runs, one thread at a time."""

    def __init__(self) -> None:
        self._patches = contextlib.ExitStack()
        self._busy = threading.RLock()

    def __enter__(self) -> Self:
        for name in STEPS:
            self._patches.enter_context(mock.patch.object(os, name, self._around(name, getattr(os, name))))
        opens = self._around("open", io.open)
        for home in (io, builtins):
            self._patches.enter_context(mock.patch.object(home, "open", opens))
        return self

    def __exit__(self, *_: object) -> None:
        self._patches.close()

    def _around(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            if name == "open" and not _makes(*arguments, **named):
                return function(*arguments, **named)
            with self._busy:
                words = " ".join(map(str, (name, *arguments[:2])))
                return self.step(words, lambda: function(*arguments, **named), arguments)

        return call

    @abstractmethod
    def step(self, words: str, do: Callable[[], Any], arguments: tuple[Any, ...]) -> Any:
        """What happens instead; ``do`` does it; ``words`` begin with the name of the function."""


def _makes(_path: object, mode: object = "r", *_: object, **__: object) -> bool:
    """Whether an ``open``, Python's or the system's, makes or empties a file."""
    return bool(mode & MAKES) if isinstance(mode, int) else not str(mode).startswith("r")


class Recorder(_Watched):
    """Collects the ``moments`` of what happens in ``root`` while the block runs, or the last one alone.

    Nothing is really forced to the disk; what is there when it begins is. Before step ``dies_at``, from 0 on, the
    program dies, until ``revive``.
    """

    def __init__(self, root: Path, *, every_moment: bool = True, dies_at: int | None = None) -> None:
        super().__init__()
        self._root, self._every_moment, self._dies_at, self._dead = root, every_moment, dies_at, False
        self._steps = 0
        self._held: dict[int, int] = {}
        self._synced = self._look()
        self.moments: list[Moment] = []

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self._note("the end")
        for handle in self._held.values():
            os.close(handle)

    def revive(self) -> None:
        """The program begins anew."""
        self._dies_at, self._dead = None, False

    def step(self, words: str, do: Callable[[], Any], arguments: tuple[Any, ...]) -> Any:
        """Note the moment before; do it, unless dead."""
        self._dead = self._dead or self._steps == self._dies_at
        if self._dead:
            raise Died
        self._steps += 1
        if self._every_moment:
            self._note(words)
        if not words.startswith("fsync"):
            return do()
        inode = os.fstat(arguments[0]).st_ino
        node = (self.moments[-1].now if self._every_moment else self._look()).get(inode)
        if node is not None:  # else it lies elsewhere
            self._synced[inode] = node
        return None

    def _note(self, before: str) -> None:
        self.moments.append(Moment(before, self._root.stat().st_ino, self._look(), dict(self._synced)))

    def _look(self) -> dict[int, Node]:
        """All nodes of the tree."""
        found: dict[int, Node] = {}
        pending = [self._hold(self._root)]
        while pending:
            inode = pending.pop()
            found[inode] = node = self._node(self._held[inode])
            if not isinstance(node.holds, bytes):
                pending.extend(node.holds.values())
        return found

    def _node(self, handle: int) -> Node:
        """What an open file or folder holds now."""
        about = os.fstat(handle)
        if not stat.S_ISDIR(about.st_mode):
            return Node(os.pread(handle, about.st_size, 0))
        return Node({name: self._hold(name, handle) for name in os.listdir(handle)})

    def _hold(self, name: str | Path, folder: int | None = None) -> int:
        """The inode number of a file or folder, which is held open so that no later one gets the same."""
        inode = os.stat(name, dir_fd=folder).st_ino
        if inode not in self._held:
            self._held[inode] = os.open(name, os.O_RDONLY, dir_fd=folder)
        return inode


class Refusing(_Watched):
    """Lets the ``n``-th step of a block, from 0 on, fail as on a full disk, and all after it ``for_good``."""

    def __init__(self, n: int, for_good: bool) -> None:
        super().__init__()
        self._left, self._for_good = n, for_good

    def step(self, words: str, do: Callable[[], Any], arguments: tuple[Any, ...]) -> Any:
        """Do it or fail."""
        self._left -= 1
        fails = self._left == -1 or (self._for_good and self._left < 0)
        if fails and not words.startswith(REMOVING):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return do()


def write_tree(tree: Tree, folder: Path) -> None:
    """Make it a new folder."""
    folder.mkdir()
    for name, holds in tree.items():
        if isinstance(holds, bytes):
            (folder / name).write_bytes(holds)
        else:
            write_tree(holds, folder / name)


def read_tree(folder: Path) -> Tree:
    """A folder as a tree."""
    return {path.name: read_tree(path) if path.is_dir() else path.read_bytes() for path in folder.iterdir()}


def differences(found: Tree, wanted: Tree, path: str = "") -> list[str]:
    """What is there and should not be, the other way round, or is different: a path and a word each."""
    told: list[str] = []
    for name in sorted({*found, *wanted}):
        one, other = found.get(name), wanted.get(name)
        if isinstance(one, dict) and isinstance(other, dict):
            told += differences(one, other, f"{path}/{name}")
        elif one != other:
            told.append(f"{path}/{name} {'left over' if other is None else 'missing' if one is None else 'differs'}")
    return told
