"""The table of findings: what can be wrong with measured data, how grave it is, and what helps."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from enum import Enum, IntEnum
from typing import Any

from mr_damper_ros.processes.files import json_ready


class Severity(IntEnum):
    """What follows from a finding, the same in all programs.

    NOTE: nothing. WARN: the result is written, but is no success (exit code 1), unless doubtful
    data are accepted. REFUSE: nothing is written (exit code 2), unless doubtful data are accepted.
    """

    NOTE = 0
    WARN = 1
    REFUSE = 2


NOTE, WARN, REFUSE = Severity


@dataclass(frozen=True)
class Finding:
    """One row of evidence.

    ``channel`` is the affected channel, empty for a whole recording or stream. ``sentence`` states
    consequence and remedy. ``value`` is the figure behind it with its ``error`` (standard error, in
    the same unit), NaN if the finding has none. ``source`` is the name of the recording.
    """

    kind: Kind
    severity: Severity
    sentence: str
    channel: str = ""
    value: float = math.nan
    error: float = math.nan
    source: str = ""

    @property
    def name(self) -> str:
        """Name of the kind, as in the documentation."""
        return self.kind.name.lower()

    def __str__(self) -> str:
        return f"{self.source}: {self.sentence}" if self.source else self.sentence

    def mended(self, how: str, severity: Severity = NOTE) -> Finding:
        """The finding on data that were mended as ``how`` says; then it is usually a note."""
        return replace(self, severity=severity, sentence=f"{self.sentence} ({how})")

    def document(self) -> dict[str, Any]:
        """The finding as JSON-compatible values."""
        entry = asdict(self) | {"kind": self.name, "severity": self.severity.name.lower()}
        found: dict[str, Any] = json_ready(entry)
        return found


class Kind(Enum):
    """Kinds of findings: severity and template of the sentence."""

    # -- the stream
    SILENT = (
        REFUSE,
        "no samples arrive on mts/samples: start the bridge or your driver, and publish reliably",
    )
    UNUSABLE = REFUSE, "{count} messages on {topic} could not be used: {reason}"
    NOT_FINITE = (
        REFUSE,
        "{count} values of the {channel} are not finite: let the driver measure the {channel}, or "
        "name another field or topic",
    )
    RATE = (
        WARN,
        "by the stamps the sample period is {measured:.4g} ms ({rate:.4g} Hz), but the messages "
        "state {stated:.4g} ms: set the right period in the driver",
    )
    JITTER = (
        WARN,
        "the stamps jitter by {jitter:.2g} ms ({share:.0%} of a period): stamp by the count of the "
        "samples, not by their arrival (doc/time.md)",
    )
    LOST = (
        WARN,
        "{count} samples of {whole} ({share:.2%}) were lost: check the network, send larger "
        "blocks, and use deeper queues",
    )
    REPEATED = (
        WARN,
        "{count} blocks arrived twice or out of order: does only one node publish them?",
    )
    RESTARTED = (
        WARN,
        "count or stamps of the samples jumped {count} times: was the source restarted, or its "
        "clock set, during the check?",
    )
    BURSTS = (
        WARN,
        "the stream paused {count} times for up to {pause:.2g} s and then caught up: check the "
        "network and the load of the sender",
    )
    NO_CURRENT = (
        WARN,
        "no current arrives on supply/current: start the supply or your driver",
    )
    CURRENT = (
        WARN,
        "the measured current deviates by {off:+.3g} A from the command: check the limits of the "
        "supply, its voltage and the wires to the coil",
    )
    CURRENT_CLOCK = (
        WARN,
        "the current is stamped {ahead:.3g} s {direction} than the samples: synchronise the clocks",
    )
    # -- a running stream
    STOPPED = NOTE, "nothing arrives on {topic}: has its publisher stopped or paused?"
    NO_PUBLISHER = WARN, "nothing publishes {topic}: {advice}"
    BEST_EFFORT = (
        WARN,
        "{topic} is published best effort, which a reliable subscription cannot receive: set "
        "qos_overrides.<topic>.subscription.reliability to best_effort",
    )
    CHANNEL_SILENT = (
        WARN,
        "nothing arrives on {topic}, while {other} arrives: start the publisher of the {channel}",
    )
    SEVERAL_PUBLISHERS = (
        WARN,
        "{topic} is published by {names}: stop all but one; or remap the others to another topic, "
        "because their values are mixed",
    )
    NO_STAMPS = (
        WARN,
        "the messages on {topic} are stamped 0, so the time of the {channel} is unknown: fill "
        "header.stamp in the driver",
    )
    FROZEN_STAMPS = (
        WARN,
        "the stamps on {topic} do not advance: stamp each message with the time of its values (has "
        "the clock of the driver stopped, such as /clock?)",
    )
    GROUPED_STAMPS = (
        WARN,
        "{size:.2g} messages in a row on {topic} have the same stamp, so their times are unknown: "
        "stamp each message with the time of its own values",
    )
    CLOCKS_APART = (
        WARN,
        "the stamps of the {channel} are {apart:.4g} s away from those of the {other}, so the two "
        "cannot be joined: stamp both by one clock (the same use_sim_time, synchronised "
        "computers), or set topics.own_clocks",
    )
    CLOCKS_DRIFT = (
        WARN,
        "the clocks of {other} and {channel} drift apart by {drift:.0f} ± {doubt:.0f} ppm: "
        "synchronise them, or set topics.own_clocks",
    )
    CLOCK_SET = (
        WARN,
        "the stamps on {topic} leapt by {leap:+.4g} s: was the clock of the driver set? The "
        "samples continue with the new stamps",
    )
    NO_LINK = WARN, "{reason}"
    NO_DATA = WARN, "nothing arrives from {sender}: is it running?"
    NO_LINE_END = (
        WARN,
        "{count} bytes have arrived from {sender} without a line feed{how}",
    )
    UNREADABLE = (
        WARN,
        "{count} of {whole} rows cannot be read as {columns}, such as '{example}': correct "
        "stream.columns, or the sender",
    )
    WRONG_RATE = (
        WARN,
        "the samples arrive at {rate:.4g} Hz instead of the stated {stated:g} Hz, so they are not "
        "used: correct the rate",
    )
    WRONG_TIME_UNIT = (
        WARN,
        "the sender's clock runs {speed:.3g} times as fast as this computer's: is the unit of the "
        "time right?",
    )
    UNPUBLISHED = (
        WARN,
        "only {share:.0%} of the values of the {channel} that arrive on {topic} become samples: "
        "compare the counts of lost and unusable values in the diagnostics, and correct the driver",
    )
    # -- one channel
    STUCK = REFUSE, "the {channel} {how}: is its sensor connected?"
    AT_REST = REFUSE, "the {channel} spans only {span:.3g} {unit}: does the machine move?"
    UNIT = REFUSE, "the {channel} {reaches} {size:.3g} {unit}: is it in {other}?"
    CLIPPED = (
        REFUSE,
        "the {channel} is clipped{how}: choose a larger range or a smaller motion",
    )
    SPIKES = (
        WARN,
        "{count} samples of the {channel} are outliers of up to {size:.3g} {unit}: is there a "
        "loose plug, a knock or a disturbance?",
    )
    HELD = (
        WARN,
        "the {channel} is renewed only every {step} samples: record it at the rate of its sensor, "
        "or let the sensor send faster",
    )
    HUM = (
        WARN,
        "the {channel} holds a disturbance of {size:.3g} {unit} at {frequency:.3g} Hz that stands "
        "apart from the motion: check shielding and earth",
    )
    NOISE = (
        NOTE,
        "the {channel} has {noise:.3g} {unit} of noise ({share:.1%} of its standard deviation): "
        "check shielding, earth and filters",
    )
    COARSE = (
        NOTE,
        "the {channel} is quantised in steps of {step:.3g} {unit}: choose a smaller range or more "
        "bits",
    )
    MISSING = (
        WARN,
        "{what}: were samples lost? Record the time of each sample, without gaps",
    )
    SMOOTHED = (
        WARN,
        "the {channel} was smoothed by a moving average over {count} samples, which distorts fast "
        "motions: undo it with mr-damper import --undo-moving-average {count}; the record must "
        "begin at rest",
    )
    # -- motion and force together
    SWAPPED = (
        REFUSE,
        "the displacement is less smooth than the force: are the two channels exchanged?",
    )
    INVERTED = (
        REFUSE,
        "the force is not dissipative, it drives the motion: reverse the sign of the force or of "
        "the displacement (extension and tension are positive), or exchange the two channels if "
        "they are swapped",
    )
    BACKWARD = (
        WARN,
        "the force reverses {early:.2g} ± {doubt:.1g} ms before the motion does, so the hysteresis "
        "runs backward: the force is recorded early or the displacement late, by at least this "
        "time",
    )
    SKEW = (
        WARN,
        "the {late} lags the {early} by {skew:.2f} ± {doubt:.2f} ms: is the cause a filter, a "
        "multiplexer, or a compliant mount? Set the bridge's force_lateness to {lateness:.5f} "
        "(mr-damper import --force-lateness)",
    )
    OFFSET = (
        NOTE,
        "the force is centred on {middle:.3g} N instead of zero: zero the load cell with the rod "
        "free, unless gas pressure is the cause",
    )
    # -- runs
    READER = NOTE, "{text}"
    FRAGMENT = (
        NOTE,
        "{what}, {share:.1%} of the samples, shorter than a cycle of the motion, left out",
    )
    SHORT = WARN, "it holds less than a cycle of the motion: record some cycles"
    SEVERAL_CURRENTS = (
        WARN,
        "at {current:.3g} A and the same speed the force reaches {low:.3g} N in some cycles and "
        "{high:.3g} N in others: does the record hold several currents? (mr-damper import --split "
        "cuts it into its runs)",
    )
    CONTRADICTING = (
        WARN,
        "the force reaches {f1:.3g} N at {i1:.3g} A here and {f2:.3g} N at {i2:.3g} A in {other}, "
        "at the same speed: is a current wrong?",
    )
    CURRENT_SKEW = (
        WARN,
        "the force changes {late:.3g} ± {doubt:.2g} s {direction} than the current: shift the "
        "current by this time (mr-damper import --current-lateness {lateness:.3g}), or synchronise "
        "the clocks of machine and supply",
    )
    # -- the fit
    NEGATIVE_SLOPE = (
        NOTE,
        "the {meaning} is negative ({estimate}): it fits the runs, but is impossible for a damper, "
        "so do not trust the force outside the range of the runs",
    )
    UNDETERMINED_MASS = (
        NOTE,
        "the runs do not determine the mass, so no inertia was subtracted: give runs of different "
        "frequencies",
    )
    OTHER_LAW = (
        NOTE,
        "the law {other} explains the runs with an NRMSE of {better:.1%}, {model} with "
        "{nrmse:.1%}: choose it (--model {other}), or let the data choose (--model auto)",
    )
    ZERO_CHANGES = (
        WARN,
        "the zero of the force changes by {step:+.3g} N at once within the run: was the load cell "
        "zeroed, or does it stick? Cut the run there",
    )
    ZERO_DIFFERS = (
        WARN,
        "the zero of the force lies {step:+.3g} N from that of the other runs: was the load cell "
        "zeroed between them? Give --level-per-record, or subtract it",
    )
    GAIN_CHANGES = (
        WARN,
        "the force changes by {step:+.0%} at once within the run, at the same motion: does the "
        "record hold several currents, or another damper? Cut the run there (mr-damper import "
        "--split)",
    )
    UNEXPLAINED = (
        WARN,
        "the set explains too little of the force: NRMSE {nrmse:.1%}, above the limit of "
        "{limit:.0%}; check columns, units, signs and currents, and whether all runs are of one "
        "damper",
    )

    def __init__(self, severity: Severity, template: str) -> None:
        self.severity = severity
        self.template = template

    def found(
        self,
        channel: str = "",
        *,
        value: float = math.nan,
        error: float = math.nan,
        **words: object,
    ) -> Finding:
        """The finding of this kind, with the figures that its sentence needs."""
        sentence = self.template.format(channel=channel, **words)
        return Finding(self, self.severity, sentence, channel, value, error)


def labelled(finding: Finding) -> str:
    """The finding as a line for people, which begins with its severity."""
    label = "NOTE" if finding.severity is NOTE else "WARNING"
    return f"{label}: {finding}"
