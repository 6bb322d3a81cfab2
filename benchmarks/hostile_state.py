"""Hostile state files, and names of them."""

from __future__ import annotations

import json
import os
import random
from pathlib import Path

import numpy as np

from benchmarks.hostile_input import NUMBERS, spoilt
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError
from mr_damper_ros.tracking.tracker import TrackerMemory
from mr_damper_ros.tracking.tracker_state import from_text, to_text


class HostileState:
    """Files and names in a state folder, next to a file that nobody may touch."""

    _PARTS = (
        *(
            "..",
            "/",
            "\\",
            "a",
            "identifier",
            ".yaml",
            "~",
            "\0",
            "\n",
            " ",
            "ä",
            "\u202e",
            "\ud800",
        ),
        *("x" * 300, "-", "%2e", "*", "$HOME", ":", "link", "loop", "pipe", "folder"),
    )

    def __init__(self, chance: random.Random, folder: Path) -> None:
        self._chance = chance
        folder.mkdir(parents=True)
        self._outside = folder.parent / "outside.yaml"
        self._outside.write_text("untouched")
        (folder / "link.yaml").symlink_to(self._outside)
        (folder / "loop.yaml").symlink_to(folder / "loop.yaml")
        os.mkfifo(folder / "pipe.yaml")
        (folder / "folder.yaml").mkdir()
        self._around = sorted(os.listdir(folder.parent))
        self._state = StateDirectory(folder)
        self._set = ParameterSet(THESIS_28_CELSIUS, set_id="good")
        self._memory = to_text(TrackerMemory(windows=3))
        self._path = self._state.save("identifier", self._set, self._memory)
        self._good = self._path.read_bytes()

    def try_out(self) -> str:
        """One spoilt file, memory or name; what is wrong with what came of it, or nothing."""
        if self._chance.random() < 0.5:
            return self._try_name()
        if self._chance.random() < 0.5:
            return self._try_memory()
        return self._try_file()

    def _try_file(self) -> str:
        data = spoilt(self._chance, self._good)
        self._path.write_bytes(data)
        try:
            kept, memory = self._state.load_with_memory("identifier")
        except StateError:
            return ""
        # Line ends of other systems are the same lines.
        lines = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        if b"sha256" in lines.partition(b"\n")[0] and lines != self._good:
            return "a damaged file was believed"
        if not np.isfinite(kept.values).all():
            return "a parameter that is not finite"
        return "" if not memory or memory == self._memory else "a damaged memory was believed"

    def _try_memory(self) -> str:
        data = spoilt(self._chance, self._memory.encode()).decode(errors="replace")
        if self._chance.random() < 0.3:
            document = json.loads(self._memory)
            name = self._chance.choice(list(document))
            document[name] = self._chance.choice((*NUMBERS, "x", [], {}, [[]], -1, 10**40, None))
            data = json.dumps(document)
        try:
            memory = from_text(data, MODELS["sigmoid"])
        except StateError:
            return ""
        return "" if memory.windows >= 0 <= memory.accepted else "a negative count was believed"

    def _try_name(self) -> str:
        parts = self._chance.choices(self._PARTS, k=self._chance.choice((1, 1, 2, 3)))
        name = "".join(parts)
        action = self._chance.choice((self._state.load, self._save, self._state.file))
        try:
            result = action(name)
        except StateError:
            result = None
        if sorted(os.listdir(self._outside.parent)) != self._around:
            return f"the name {name!r} has made a file outside"
        if self._outside.read_text() != "untouched":
            return f"the name {name!r} has reached a file outside"
        if isinstance(result, Path) and result.parent != self._path.parent:
            return f"the name {name!r} means {result}"
        return ""

    def _save(self, name: str) -> Path:
        if name.removesuffix(".yaml") in ("link", "loop", "pipe"):
            raise StateError("these are needed as they are")
        return self._state.save(name, self._set)
