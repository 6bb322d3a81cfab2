"""Faults of instruments that speak SCPI: each one is a row of :data:`INSTRUMENT_FAULTS`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class InstrumentFault:
    """What an instrument does wrong; by default nothing. Times are in seconds.

    ``usable``: with this fault, the instrument can be operated until it must be switched off.
    ``obeys``: it loses its current by a command or by its watchdog. ``measures``: its measured
    current can be read. The other fields say how :class:`InstrumentServer` serves it.
    """

    is_: str
    usable: bool = True
    obeys: bool = True
    measures: bool = True
    refused: tuple[str, ...] = ()
    """Lines, as far as they are given, that are refused with an error in the queue."""
    ignores: bool = False
    """Commands have no effect; queries are answered."""
    deaf: bool = False
    """Lines are not received, like after an undetected cable break."""
    loses_within: float = 0.0
    """A command that follows the line before within this time has no effect."""
    silent: bool = False
    """Lines are executed, but not answered."""
    no_number: bool = False
    """The answer to a query of the current is "not a number"."""
    shifted: bool = False
    """A query is answered with the answer to the query before."""
    echo: bool = False
    """Each line is sent back."""
    greeting: str = ""
    """Sent on each new connection, after a moment."""
    terminator: str = "\n"
    slow: float = 0.0
    """Time to execute a query; meanwhile nothing is received."""
    late: float = 0.0
    """Delay of each answer, which is sent on the newest connection."""
    dribble: float = 0.0
    """Time between two bytes of an answer that is never complete; meanwhile nothing is received."""
    cut_after: float = 0.0
    """Each connection is closed after this time."""
    one_session: bool = False
    """A connection is served only after the one before has been closed."""
    watchdog: bool = False
    """The instrument has a watchdog."""


INSTRUMENT_FAULTS: dict[str, InstrumentFault] = {
    "none": InstrumentFault("no fault"),
    "refuses_zero": InstrumentFault("its smallest current is above zero", refused=("CURR 0.00",)),
    "refuses_off": InstrumentFault("its output cannot be switched off", refused=("OUTP OFF",)),
    "ignores": InstrumentFault(
        "its front panel is locked", usable=False, obeys=False, ignores=True
    ),
    "loses": InstrumentFault("it loses lines that are sent fast", loses_within=0.02),
    "echo": InstrumentFault("it echoes each line", echo=True),
    "greeting": InstrumentFault("it greets", greeting="Welcome to the instrument"),
    "dribble": InstrumentFault(
        "it never completes an answer", usable=False, measures=False, dribble=0.2
    ),
    "slow": InstrumentFault("it needs time for each answer", slow=0.2),
    "silent": InstrumentFault("it does not answer", usable=False, measures=False, silent=True),
    "wrong_answers": InstrumentFault(
        "it answers the query before", usable=False, measures=False, shifted=True
    ),
    "late_answers": InstrumentFault("its answers are late", usable=False, late=0.7),
    "cr_only": InstrumentFault("its answers end with CR", terminator="\r"),
    "reconnect": InstrumentFault("it closes each connection", usable=False, cut_after=0.15),
    "one_session": InstrumentFault("it serves one connection at a time", one_session=True),
    "no_measurement": InstrumentFault(
        "it does not measure", usable=False, measures=False, no_number=True
    ),
    "watchdog": InstrumentFault(
        "its front panel is locked, but its watchdog acts",
        usable=False,
        ignores=True,
        watchdog=True,
    ),
    "deaf": InstrumentFault(
        "it receives nothing", usable=False, obeys=False, measures=False, deaf=True
    ),
}
