"""Check of recordings: of each section, and of the sections of a run together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.data_check.findings import REFUSE, Finding, Kind
from mr_damper_ros.data_check.lag import motion_frequency
from mr_damper_ros.data_check.samples import (
    Samples,
    check_samples,
    temperature_findings,
    unit_findings,
)
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import holds_cycle
from mr_damper_ros.signals.arrays import Mask
from mr_damper_ros.signals.recording import Recording, RecordingError


@dataclass(frozen=True, eq=False)
class CheckedRun:
    """Sections of a run as they are used, and the findings on the run.

    Faults are mended in the ``sections``, and fragments are left out. ``clipped`` marks the forces
    of each section that a fit leaves out, None without any.
    """

    sections: tuple[Recording, ...]
    findings: tuple[Finding, ...]
    clipped: tuple[Mask | None, ...]


def usable_run(
    name: str, recordings: Sequence[Recording], *, accept_doubtful: bool, mend: bool = True
) -> CheckedRun:
    """:func:`check_run`, for a run of this name that is to be used.

    Raises DataError if a finding refuses the run. With ``accept_doubtful``, it is refused only for
    a constant displacement or force.
    """
    checked = check_run(recordings, mend=mend)
    constant = any(np.ptp(r.displacement) == 0.0 or np.ptp(r.force) == 0.0 for r in recordings)
    for finding in checked.findings:
        if finding.severity is REFUSE and (constant or not accept_doubtful):
            remedy = " (to use it anyway, give accept_doubtful=True or --accept-doubtful)"
            raise DataError(f"{name}: {finding.sentence}{'' if constant else remedy}")
    findings = tuple(replace(finding, source=name) for finding in checked.findings)
    return replace(checked, findings=findings)


def check_run(recordings: Sequence[Recording], *, mend: bool = True) -> CheckedRun:
    """Check the sections of a run, which gaps separate.

    Sections with less than a cycle of the motion are left out if others hold one: a fit of such a
    fragment would have the weight of a whole window. With ``mend`` False, nothing is changed.
    """
    found: list[Finding] = []
    whole = [each for each in recordings if holds_cycle(each.displacement)]
    if whole:
        # In a fragment, noise may look like a cycle.
        main = max(whole, key=lambda each: each.sample_count)
        cycle = 1.0 / max(motion_frequency(main.displacement, main.period), 1e-9)
        whole = [each for each in whole if each is main or each.duration >= cycle]
    used = tuple(whole if whole and mend else recordings)
    if not whole:
        found.append(Kind.SHORT.found())
    elif left_out := len(recordings) - len(used):
        total = sum(each.sample_count for each in recordings)
        share = 1.0 - sum(each.sample_count for each in used) / total
        what = f"{left_out} fragment{'s' * (left_out > 1)}"
        found.append(Kind.FRAGMENT.found(value=share, what=what, share=share))
    sections, clipped = [], list[Mask | None]()
    for recording in used:
        given = _samples(recording)
        checked = check_samples(given, recording.gaps, mend=mend)
        found += checked.findings
        if recording.temperature is not None:
            found += temperature_findings(recording.temperature)
        if note := recording.details.get("note"):
            found.append(Kind.READER.found(text=note))
        if checked.samples is not given:
            mended = {name: getattr(checked.samples, name) for name in ("displacement", "force")}
            recording = replace(recording, **mended, current=checked.samples.current)
        sections += [recording.part(part) for part in checked.parts]
        mask = checked.clipped
        clipped += [None if mask is None else mask[part] for part in checked.parts]
    return CheckedRun(tuple(sections), tuple(dict.fromkeys(found)), tuple(clipped))


def require_units(recording: Recording) -> None:
    """Raise RecordingError if the values are impossible for a damper in SI units."""
    found = [*unit_findings(_samples(recording))]
    if recording.temperature is not None:
        found += temperature_findings(recording.temperature)
    for each in found:
        if each.severity is REFUSE:
            raise RecordingError(f"'{recording.name}': {each.sentence}")


def _samples(recording: Recording) -> Samples:
    return Samples(recording.displacement, recording.force, recording.current, recording.period)
