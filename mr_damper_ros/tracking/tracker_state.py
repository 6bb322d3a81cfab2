"""What a tracker knows, kept in a folder: read at the start, written after every new set."""

from __future__ import annotations

import contextlib
from pathlib import Path

from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.processes.deferred import BackgroundWriter
from mr_damper_ros.processes.files import FolderLock
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_memory import TrackerMemory, check, from_text, to_text

DISK_PATIENCE = 1.0
"""Seconds that a disk has to write a state before anybody goes on without it."""


class TrackerState:
    """The state of a tracker under its own name in a folder, beside the sets that a user keeps."""

    def __init__(self, tracker: WindowTracker, directory: StateDirectory, name: str) -> None:
        self._tracker = tracker
        self._directory = directory
        self._name = name
        self._lock: FolderLock | None = None
        self._writer: BackgroundWriter[tuple[ParameterSet, TrackerMemory]] | None = None
        self._set_aside = ""

    @property
    def path(self) -> Path | None:
        """The file of the tracker's own state; None where nothing is kept."""
        return self._directory.file(self._name) if self._directory.keeps else None

    @property
    def fault(self) -> str:
        """Why the state is not on disk; empty where it is, or where none is kept."""
        return self._writer.fault if self._writer else ""

    @property
    def set_aside(self) -> str:
        """What could not be used and lies beside the state; empty once that is acknowledged."""
        return self._set_aside

    @property
    def given(self) -> int:
        """Number of the newest state that was to be written."""
        return self._writer.given if self._writer else 0

    @property
    def written(self) -> int:
        """Number of the newest state that was written, or could not be; it includes all before."""
        return self._writer.done if self._writer else 0

    def resume(self) -> str:
        """Go on where a tracker of this name ended, and keep from now on what this one learns.

        Returns in words what it goes on with, empty for nothing; what cannot be used is
        :attr:`set_aside`. Raises StateError where the folder cannot be used, or where another
        process keeps its state there under this name.
        """
        if not self._directory.keeps:
            return ""
        self._lock = self._directory.lock(self._name)
        unread = self._directory.unread_asides(self._name)
        if unread:
            self._set_aside = "what could not be used at an earlier start was set aside as " + (
                ", ".join(map(str, unread))
            )
        is_kept = self._directory.file(self._name).exists()
        if not is_kept:
            self._directory.save(self._name, self._tracker.parameters)
        self._directory.remove_unfinished(self._name)
        known = self._go_on() if is_kept else ""
        self._writer = BackgroundWriter(self._write)
        return known

    def _write(self, item: tuple[ParameterSet, TrackerMemory]) -> None:
        """Keep what the next start will take: StateError for anything else."""
        parameters, memory = item
        self._directory.save(self._name, parameters, to_text(check(memory, parameters.law)))

    def _go_on(self) -> str:
        tracker = self._tracker
        try:
            parameters, memory = self._directory.load_with_memory(self._name)
            parameters.of_model(tracker.parameters.model)
        except (StateError, ParameterError) as error:
            self._put_aside(str(error))
            return ""
        try:
            learnt = from_text(memory, parameters.law) if memory else None
        except StateError as error:
            tracker.replace(parameters)
            self._put_aside(f"{error}; going on with {parameters.set_id} alone")
            with contextlib.suppress(StateError):
                self._directory.save(self._name, parameters)
            return ""
        if learnt is None:
            tracker.replace(parameters)
            return f"parameters {parameters.set_id} and a new baseline"
        tracker.resume(parameters, learnt)
        return (
            f"parameters {parameters.set_id} and {len(learnt.baselines)} baselines, "
            f"{len(learnt.reservoir)} windows"
        )

    def _put_aside(self, why: str) -> None:
        try:
            why += f"; set aside as {self._directory.set_aside(self._name)}"
        except StateError as error:
            why += f"; {error}"
        self._set_aside = "; ".join(filter(None, (why, self._set_aside)))

    def acknowledge(self) -> str:
        """Take notice of what was set aside, which is then not spoken of again; returns it.

        The files stay, under another name. Raises StateError where they cannot be renamed.
        """
        if self._directory.keeps:
            self._directory.mark_asides_read(self._name)
        taken, self._set_aside = self._set_aside, ""
        return taken

    def keep(self) -> None:
        """Have the running set, and what goes with it, written soon."""
        if self._writer is not None:
            self._writer.keep((self._tracker.parameters, self._tracker.memory))

    def keep_now(self) -> str:
        """Keep, and wait for it; returns what is wrong with that, if anything is."""
        self.keep()
        if self._writer is None:
            return ""
        if not self._writer.wait(DISK_PATIENCE):
            return f"state_dir takes more than {DISK_PATIENCE:g} s to be written"
        return self._writer.fault

    def save(self, name: str) -> Path:
        """Keep the running set under a name, "" for the tracker's own; returns its file.

        Raises StateError where that is not possible, or where another node keeps its state under
        that name.
        """
        path = self._directory.file(name or self._name)
        if path != self._directory.file(self._name):
            if self._directory.is_of_a_node(name):
                raise StateError(
                    f"{path} is the state of another node, which would go on with it: give another "
                    "name"
                )
            return self._directory.save(name, self._tracker.parameters)
        fault = self.keep_now()
        if fault:
            raise StateError(fault)
        return path

    def load(self, name: str) -> ParameterSet:
        """The set kept under a name, "" for the tracker's own.

        Raises StateError where there is none that can be used, ParameterError for one of another
        model.
        """
        found = self._directory.load(name or self._name)
        return found.of_model(self._tracker.parameters.model)

    def close(self) -> None:
        """Write what waits, as long as that may take, and end."""
        if self._writer is not None:
            self._writer.close(DISK_PATIENCE)
        if self._lock is not None:
            self._lock.release()
