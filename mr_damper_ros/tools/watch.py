"""Show the state of the running system, updated in place, until Ctrl-C."""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import textwrap
import time

from mr_damper_ros.live.live_record import LiveRecord
from mr_damper_ros.signals.blocks import SILENCE
from mr_damper_ros.signals.error_sums import ErrorSums
from mr_damper_ros.tools.console import add_namespace_option, program

_INDENT = 25
"""Width of the column before the text of a line."""

_ENTRY = 28
"""Width of a parameter on the screen; three more columns separate two parameters."""


def summary(record: LiveRecord, width: int = 80) -> str:
    """The newest signals, window, set and diagnostics, in lines of at most ``width`` characters."""
    parts = (_signals(record), _window(record), _parameters(record, width), _concerns(record))
    wrapper = textwrap.TextWrapper(max(width, 2 * _INDENT), subsequent_indent=" " * _INDENT)
    return "\n".join(wrapper.fill(line) for lines in parts for line in (*lines, "")).rstrip("\n")


def _signals(record: LiveRecord) -> list[str]:
    rows = record.rows("signals", -1, -1)
    if rows is None or len(rows.values) == 0:
        if any(concern.name.startswith("model:") for concern, _ in record.concerns):
            return ["no signals yet: the node model is running, but no samples arrive"]
        return ["no signals yet: is the node model running, in this namespace?"]
    # The present error is that of the last 500 samples.
    named = dict(zip(rows.columns, rows.values[-500:].T, strict=True))
    now = {name: float(column[-1]) for name, column in named.items()}
    silence = _since(record.silence)
    measured, error = (
        named[name][named["valid"] == 1.0] for name in ("measured_force", "force_error")
    )
    nrmse = ErrorSums.of(measured + error, measured).nrmse
    predicted = _known("{:9.1f} N", now["predicted_force"])
    state = "valid" if now["valid"] else "invalid"
    if record.parameters is None:
        state = "no parameters yet"
    error_line = _known("NRMSE {:.1%} over the last valid samples", nrmse)
    return [
        *([f"{'no signals':24} {silence}; the last ones:"] if silence else []),
        f"{'' if silence else 'live':24} displacement {1e3 * now['displacement']:9.3f} mm   "
        f"velocity {now['velocity']:8.4f} m/s   current {_known('{:6.3f} A', now['current'])}",
        f"{'force':24} measured {now['measured_force']:13.1f} N    predicted {predicted} ({state})",
        f"{'error':24} {error_line}",
    ]


def _known(text: str, value: float) -> str:
    return text.format(value) if math.isfinite(value) else "unknown"


def _window(record: LiveRecord) -> list[str]:
    last = record.last_report
    if last is None:
        return ["no window yet"]
    silence = _since(_silence_of(record, "identifier"))
    return [
        *([f"{'identifier':24} {silence}; its last window:"] if silence else []),
        f"{'window':24} {last.verdict.name.lower().replace('_', ' ')}: {last.reason}",
        *([f"{'':24} {', '.join(last.figures)}"] if last.figures else []),
        *(
            f"{name:>24} {value:12.5g} ± {error:.2g}"
            for name, (value, error) in last.known_coefficients.items()
        ),
    ]


def _parameters(record: LiveRecord, width: int) -> list[str]:
    seen = record.parameters
    if seen is None:
        return ["no parameters yet: is the node identifier running, in this namespace?"]
    columns = seen.law.parameter_names, seen.values, seen.standard_errors, seen.observable
    entries = [
        f"{name} {value:.4g}" + (f" ± {error:.2g}" if known else " (not determined)")
        for name, value, error, known in zip(*columns, strict=True)
    ]
    count = max((width + 3) // (_ENTRY + 3), 1)
    lines = [
        "   ".join(f"{entry:{_ENTRY}}" for entry in entries[k : k + count]).rstrip()
        for k in range(0, len(entries), count)
    ]
    silence = _since(_silence_of(record, "identifier", "model"))
    head = "last set" if silence else "set in use"
    return [f"{head:24} {seen.set_id} ({seen.model}, {seen.source})", *lines]


def _concerns(record: LiveRecord) -> list[str]:
    lines = []
    for concern, silence in record.concerns:
        since = _since(silence)
        # Good, warning, error, or stale.
        sign = "+!x?"[3 if since else min(concern.level, 3)]
        lines.append(f"{sign} {concern.name:22} {since}{'; last: ' * bool(since)}{concern.message}")
    return lines


def _silence_of(record: LiveRecord, *nodes: str) -> float:
    """Seconds since the last message of any of these nodes; 0 if there was none."""
    silences = [s for concern, s in record.concerns if concern.name.partition(": ")[0] in nodes]
    return min(silences, default=0.0)


def _since(silence: float) -> str:
    """The time of the last message, in words; empty if it is recent."""
    if silence < SILENCE:
        return ""
    clock = time.strftime("%H:%M:%S", time.localtime(time.time() - silence))
    return f"no message since {clock} ({silence:.0f} s)"


_AT_LEAST = 3.0
"""Time [s] after which every running node has sent diagnostics, which come once a second."""


def _options(parser: argparse.ArgumentParser) -> None:
    add_namespace_option(parser)
    parser.add_argument(
        "--period", type=float, default=0.5, help="seconds between two prints (default 0.5)"
    )
    parser.add_argument(
        "--once", action="store_true", help=f"print once, after {_AT_LEAST:g} s, and end"
    )


def _watch(options: argparse.Namespace) -> int:
    if not options.period > 0.0:
        raise ValueError(f"--period must be more than 0 s, not {options.period:g}")
    from mr_damper_ros.nodes.live_node import RecordInput
    from mr_damper_ros.nodes.observer import Observer

    record = LiveRecord()
    with Observer("watch", namespace=options.namespace) as observer:
        RecordInput(observer.node, record)

        def after(seconds: float) -> str:
            observer.spin_for(seconds)
            return summary(record, shutil.get_terminal_size().columns)

        if options.once:
            print(after(_AT_LEAST))
            return 0
        in_place = sys.stdout.isatty()
        try:
            while True:
                text = after(options.period)
                if in_place:  # on a clear screen without a cursor
                    print(f"\x1b[?25l\x1b[H\x1b[J{text}", flush=True)
                else:
                    print(f"{time.strftime('%H:%M:%S')}\n{text}\n", flush=True)
        finally:
            if in_place:
                print("\x1b[?25h", end="", flush=True)


main = program("mr-damper watch", __doc__, _options, _watch)
