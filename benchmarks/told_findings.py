"""What the package says of recordings and files: the findings, by name and severity."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import mr_damper_ros as mr
from mr_damper_ros.api.identification import Identification
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.io.bag_reader import TOPICS
from mr_damper_ros.io.bag_writer import BagStream, _message
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.recording import Recording, TemperatureReading, stream_of
from studies.recordings import window_of

REFUSE, NOTE = "refuse", "note"

_NAMES = (
    ("rate", r"velocity column is|sampl\w+ (?:rate|period)|unit of the time"),
    ("unit", r"\bunits?\b"),
    ("uneven_time", r"not uniform|does not increase|increases by"),
)
"""Names of the findings for which a reader refuses a file, by a pattern of its sentence."""


class Told(NamedTuple):
    """A finding: its name, its severity and its sentence."""

    name: str
    severity: str
    sentence: str


@dataclass(frozen=True)
class Given:
    """What a user gives: recordings, each a run or several sections of one, or the text of a file.

    ``raw`` are the recordings as a reader without any check would read them; ``options`` are those
    of ``read_record`` for the ``text`` of the file. ``container``: "list" of runs, or "bag" whose
    sections they are.
    """

    raw: Sequence[Recording]
    text: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    model: str = DEFAULT_MODEL
    container: str = "list"


@dataclass(frozen=True, eq=False)
class Answer:
    """What the package says and gives; ``result`` is None if it refuses."""

    findings: tuple[Told, ...]
    result: Identification | None

    @property
    def named(self) -> frozenset[str]:
        """Names of the findings that refuse or warn."""
        return frozenset(each.name for each in self.findings if each.severity != NOTE)

    @property
    def clean_exit(self) -> bool:
        """Whether a result is given with the exit code 0."""
        return self.result is not None and self.result.success


def _by_sentence(sentence: str) -> Told:
    """The finding for which a reader refuses a file."""
    found = (name for name, pattern in _NAMES if re.search(pattern, sentence))
    return Told(next(found, "unknown"), REFUSE, sentence)


def answer(given: Given) -> Answer:
    """Read and identify as a user would."""
    with tempfile.TemporaryDirectory() as folder:
        sources: Sequence[Any] = ()
        try:
            recordings = _read(given, Path(folder)) if given.text else given.raw
            sources = _sources(recordings, given, Path(folder))
            result = mr.identify(*sources, model=given.model)
        except ValueError as error:
            return Answer(_refusals(sources, error), None)
    return Answer(tuple(map(_told, result.findings)), result)


def _refusals(sources: Sequence[Any], error: ValueError) -> tuple[Told, ...]:
    """The findings that refuse; only a reader refuses without a finding."""
    try:
        found = mr.check(*sources).findings if sources else ()
    except ValueError:
        found = ()
    refused = tuple(each for each in map(_told, found) if each.severity == REFUSE)
    return refused or (_by_sentence(str(error)),)


def _told(finding: mr.Finding) -> Told:
    return Told(finding.name, finding.severity.name.lower(), finding.sentence)


def unchecked(recordings: Sequence[Recording], model: str) -> ParameterSet | None:
    """The set identified without any check or repair, or None if there can be none."""
    law = MODELS[model]
    start = law.initial_values()[0]
    try:
        windows = [window_of(recording).resolved() for recording in recordings]
        return identify_global(law, windows, start, EvolutionSettings()).parameter_set
    except ValueError:
        return None


def _read(given: Given, folder: Path) -> list[Recording]:
    path = folder / "record.csv"
    path.write_text(given.text, encoding="utf-8")
    return [mr.read_record(path, **given.options)]


def _sources(recordings: Sequence[Recording], given: Given, folder: Path) -> Sequence[Any]:
    """What is identified: the recordings, or a bag of them."""
    return [_bag(recordings, folder / "bag")] if given.container == "bag" else recordings


def _bag(sections: Sequence[Recording], path: Path) -> Path:
    """A bag whose blocks between the sections were lost."""
    first = sections[0]
    topics = dict(TOPICS.values())
    del topics[TOPICS[TemperatureReading][0]]
    bag = BagStream(path, topics, {})
    for section in sections:
        before = round((section.start_ns - first.start_ns) / NANOSECONDS / first.period)
        for item in stream_of(section, 20):
            if isinstance(item, SampleBlock):
                item = replace(item, sequence=before + item.sequence)
            bag.write(*_message(item))
    bag.close()
    return path
