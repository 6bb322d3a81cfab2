"""Bags in folders and patterns."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from mr_damper_ros.models.parameter_set import UserError

_BAG_FILES = (".mcap", ".db3")
_METADATA = "metadata.yaml"
_PATTERN_SIGNS = frozenset("*?[")


class BagListError(UserError):
    """There are no bags where they are searched; the message says what to change."""


def find_bags(sources: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """The bags in the sources, each path once.

    A source is a folder, a pattern with ``*``, or a path. A bag is a folder with metadata.yaml, or
    a .mcap or .db3 file. Raises BagListError if a source has no bag.
    """
    found: dict[Path, None] = {}
    for source in sources:
        paths = [path for root in _roots(os.fspath(source)) for path in _bags(root)]
        if not paths:
            raise BagListError(
                f"there is no bag in {os.fspath(source)}: give folders, .mcap or .db3 files of bags"
            )
        found.update(dict.fromkeys(paths))
    return list(found)


def _roots(source: str) -> list[Path]:
    if Path(source).exists():
        return [Path(source)]
    if not _PATTERN_SIGNS & set(source):
        raise BagListError(f"there is no {source}")
    return [Path(name) for name in sorted(glob.glob(source, recursive=True))]


def _bags(root: Path) -> Iterator[Path]:
    if not root.is_dir():
        if _is_bag_file(root):
            yield root
        return
    for folder, below, files in os.walk(root):
        if _METADATA in files:
            below.clear()
            yield Path(folder)
            continue
        below.sort()
        yield from filter(_is_bag_file, (Path(folder, name) for name in sorted(files)))


def _is_bag_file(path: Path) -> bool:
    return path.suffix.lower() in _BAG_FILES
