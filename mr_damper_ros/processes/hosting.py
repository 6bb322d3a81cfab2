"""What a program is told of the namespaces that it holds a node in, and of the workers for them."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass

HELP = """\
One process may hold a node in each of several namespaces:

  --namespace NAME[=FILE]  a node in this namespace, with this parameter file; once for each
"""

WORKERS_HELP = """\
  --workers NUMBER         worker processes for all of them (default: as many as processors)
"""

_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""What ROS takes for a namespace, with others before it or not."""

_NAMESPACE, _WORKERS = "--namespace", "--workers"


@dataclass(frozen=True)
class Place:
    """A namespace for a node, and the path of its parameter file, empty for none."""

    namespace: str
    file: str = ""

    @property
    def arguments(self) -> list[str]:
        """What the node of this place is made with, besides what holds for all."""
        file = ["--params-file", self.file] if self.file else []
        return ["--ros-args", "-r", f"__ns:=/{self.namespace}", *file]


@dataclass(frozen=True)
class Hosting:
    """``places`` of nodes, none for the usual single one, and the ``rest`` of the arguments."""

    places: tuple[Place, ...]
    workers: int
    rest: tuple[str, ...]


def hosting(arguments: Sequence[str], *, shared_workers: bool = True) -> Hosting:
    """Read the arguments of a program, without its name and those for ROS.

    Where its nodes share no workers, a number of these stays with the rest.

    Raises ValueError, with a sentence, where they cannot be used.
    """
    places: list[Place] = []
    workers = 0
    rest: list[str] = []
    left = iter(arguments)
    for argument in left:
        if argument == _NAMESPACE:
            name, _, file = next(left, "").partition("=")
            if not _NAME.fullmatch(name):
                raise ValueError(
                    f"{_NAMESPACE} needs a name of letters, digits and underscores, not {name!r}"
                )
            places.append(Place(name.lstrip("/"), file))
        elif argument == _WORKERS and shared_workers:
            given = next(left, "")
            if not given.isdecimal() or int(given) < 1:
                raise ValueError(f"{_WORKERS} needs a number of at least 1, not {given!r}")
            workers = int(given)
        else:
            rest.append(argument)
    names = [place.namespace for place in places]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"the namespace {name} is given twice")
    return Hosting(tuple(places), workers or min(max(len(places), 1), _processors()), tuple(rest))


def worker_count(arguments: Sequence[str]) -> int:
    """Worker processes that a command line, with its arguments for ROS, asks for."""
    own = list(arguments)
    if "--ros-args" in own:
        own = own[: own.index("--ros-args")]
    try:
        return hosting(own).workers
    except ValueError:  # said, and the program ended, where it starts its nodes
        return 1


def _processors() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
