"""Common parts of the command-line programs: error sentences, progress, Ctrl-C, exit codes."""

from __future__ import annotations

import argparse
import inspect
import json
import math
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from mr_damper_ros.api.comparison import FORMATS, ComparedRun, save_figures
from mr_damper_ros.api.identification import identify
from mr_damper_ros.estimation.differential_evolution import GlobalProgress
from mr_damper_ros.processes.exits import FAILED, exit_code
from mr_damper_ros.processes.files import reason_of, write_text
from mr_damper_ros.report.status_line import StatusLine
from mr_damper_ros.settings.option_table import options as table_options


def program(
    name: str,
    description: str | None,
    options: Callable[[argparse.ArgumentParser], None],
    run: Callable[[argparse.Namespace], int],
    epilog: str | None = None,
) -> Callable[..., int]:
    """Return the ``main`` of a program: it parses its arguments and returns the code of ``run``.

    ``options`` adds the options of the program to a parser.

    A user error gives one sentence on standard error and exit code 2. User errors are ValueError
    and its subclasses in this package, OSError, a lack of memory, and a missing dependency. Any
    other exception is a fault of the program and keeps its traceback.
    """

    def main(arguments: Sequence[str] | None = None) -> int:
        style = argparse.RawDescriptionHelpFormatter
        parser = argparse.ArgumentParser(name, None, description, epilog, formatter_class=style)
        options(parser)
        # Not only a negative number is a value, but also the columns "-,force:N".
        parser._negative_number_matcher = re.compile(r"-[^-a-zA-Z]")

        def work() -> int:
            try:
                return run(parser.parse_args(arguments))
            except BrokenPipeError:
                raise
            except (MemoryError, OSError, ValueError) as error:
                sys.stderr.write(f"{name}: {reason_of(error)}\n")
                return FAILED

        return exit_code(name, work)

    return main


_TYPES = {"int": int, "float": float, "range": float}


def parameter_texts(function: Callable[..., object]) -> dict[str, str]:
    """The parameters of a function by name, with their descriptions in its docstring (numpydoc).

    Only the first paragraph of each description is used; further ones concern Python only. Names of
    parameters become names of options.
    """
    section = (inspect.getdoc(function) or "").partition("Parameters\n----------\n")[2]
    found = {}
    for entry in re.split(r"\n(?=\S)", re.split(r"\n\n\S+\n-+\n", section)[0]):
        names, _, text = entry.partition("\n")
        text = " ".join(text.partition("\n\n")[0].split())
        text = re.sub(r":\w+:`([^`]*)`", r"\1", text)
        text = re.sub(r"``([a-z_]+)``", lambda match: _flag(match[1]), text)
        found.update(dict.fromkeys(names.split(", "), text.replace("``", "")))
    return found


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


class _Declared(NamedTuple):
    """An option as the library declares it; ``default`` is `inspect.Parameter.empty` for none."""

    kind: str
    default: Any
    text: str


def _declared_by(source: Callable[..., object]) -> dict[str, _Declared]:
    """The options that a table, or the parameters of a function, declare, by name.

    The lowest and the highest value of a quantity in a table are also one option, a range.
    """
    if not is_dataclass(source):
        texts = parameter_texts(source)
        return {
            name: _Declared(str(given.annotation).partition(" |")[0], given.default, texts[name])
            for name, given in inspect.signature(source).parameters.items()
            if name in texts
        }
    found = {
        item.name: _Declared(item.kind.__name__, item.default, item.description)
        for item in table_options(source)
    }
    for name in [name for name in found if name.startswith("lowest_")]:
        low, high = found[name], found[name.replace("lowest_", "highest_")]
        text = low.text.replace("Lowest", "Lowest and highest")
        pair = [low.default, high.default]
        found[name.removeprefix("lowest_")] = _Declared("range", pair, text)
    return found


def add_arguments(
    parser: argparse.ArgumentParser | argparse._ArgumentGroup,
    source: Callable[..., object],
    names: Iterable[str],
    choices: Mapping[str, Sequence[str]] | None = None,
    flags: Mapping[str, str] | None = None,
    without_default: Sequence[str] = (),
) -> None:
    """Add an option for each named parameter of a function, or option of a table.

    Type, default and help text are taken from the function (:func:`parameter_texts`) or the table.
    The unit in the help text, such as [A], becomes the placeholder of a number. ``flags`` gives the
    names of options that differ from their parameters. An option ``without_default`` is None if it
    is not given.
    """
    declared = _declared_by(source)
    for name in names:
        kind, default, text = declared[name]
        flag = (flags or {}).get(name, _flag(name))
        text = text.replace("%", "%%")
        if kind == "bool":
            parser.add_argument(flag, dest=name, action="store_true", help=text)
            continue
        if name in without_default:
            default = None
        needed = default is inspect.Parameter.empty
        told = "" if needed or default in (None, ()) else " Default: %(default)s."
        chosen = (choices or {}).get(name)
        placeholder: Any = None if chosen else name.rpartition("_")[2].upper()
        if kind == "range":
            placeholder = ("LOW", "HIGH")
        elif kind in _TYPES and (unit := re.search(r"\[([^\]\s]+)", text)):
            placeholder = unit[1]
        parser.add_argument(
            flag,
            dest=name,
            type=_TYPES.get(kind, str),
            default=None if needed else default,
            required=needed,
            nargs=2 if kind == "range" else "+" if kind.startswith("Sequence") else None,
            choices=chosen,
            metavar=placeholder,
            help=text + told,
        )


def arguments_of(
    options: argparse.Namespace, function: Callable[..., object], *left_out: str
) -> dict[str, Any]:
    """The given arguments for the parameters of a function, by name, except ``left_out``."""
    names = inspect.signature(function).parameters.keys() - set(left_out)
    return {name: value for name, value in vars(options).items() if name in names}


def add_path(
    parser: argparse.ArgumentParser, name: str, kind: str, text: str, **given: object
) -> None:
    """Add an argument or an option for a path; ``kind`` is its placeholder, such as FILE."""
    parser.add_argument(name, type=Path, metavar=kind, help=text, **given)  # type: ignore[arg-type]


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of all programs that read runs."""
    add_path(parser, "bags", "BAG", "bag folder, .mcap or .db3 file", nargs="+")
    add_arguments(parser, identify, ["accept_doubtful", "as_measured"])


def add_namespace_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for the namespace of a damper."""

    def namespace(text: str) -> str:
        if re.fullmatch(r"/?|(/?[A-Za-z_]\w*)(/[A-Za-z_]\w*)*", text, re.ASCII) is None:
            raise argparse.ArgumentTypeError(f"'{text}' is not a namespace such as /rig1")
        return text

    parser.add_argument(
        "--namespace", type=namespace, default="/", help="namespace of the damper (default /)"
    )


def add_port_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for the port of the live page."""

    def port(text: str) -> int:
        if not text.isdecimal() or int(text) > 65535:
            raise argparse.ArgumentTypeError(f"'{text}' is not a port: give a number up to 65535")
        return int(text)

    parser.add_argument(
        "--port",
        type=port,
        default=8770,
        help="port of the live page (default %(default)s; 0: any free port)",
    )


def add_json_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the option for :func:`write_json`."""
    add_path(parser, "--json", "FILE", f"write {what} as JSON")


def write_json(options: argparse.Namespace, document: Mapping[str, object]) -> None:
    """Write the document as JSON if the option is given."""
    if options.json is not None:
        write_text(options.json, json.dumps(document, indent=2, allow_nan=False) + "\n")


def add_result_options(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the options for :func:`write_result`."""
    add_json_option(parser, what)
    add_path(parser, "--plot", "FOLDER", "draw measured and predicted force of each run")
    parser.add_argument(
        "--plot-format",
        choices=FORMATS,
        nargs="+",
        default=["png"],
        help="format of the figures (default png)",
    )


def write_result(
    options: argparse.Namespace, document: Mapping[str, object], runs: Iterable[ComparedRun]
) -> None:
    """Write the document and draw the runs if the options are given; prints the figures' paths."""
    write_json(options, document)
    if options.plot is not None:
        compared = [run.comparison for run in runs]
        written = save_figures(compared, options.plot, options.plot_format)
        print("figures: " + ", ".join(map(str, written)))


class ProgressLine(StatusLine):
    """The progress of a search; a call returns whether the search should continue.

    Within the context, the first Ctrl-C stops the search, the second ends the program.
    """

    def __init__(self) -> None:
        self.stopped = False
        self._end = math.inf
        self._previous: Any = None

    def __enter__(self) -> ProgressLine:
        self._previous = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._previous)
        super().__exit__()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.stopped:
            raise KeyboardInterrupt
        self.stopped = True
        # Not through sys.stderr, because the signal may interrupt a write to it.
        os.write(2, b"\nstopping with the best result so far (Ctrl-C again ends at once)\n")

    def __call__(self, progress: GlobalProgress) -> bool:
        """Show the progress of the search; False after Ctrl-C."""
        parts = []
        if progress.generation > 0:
            parts.append(f"generation {progress.generation} of at most {progress.generations}")
        if math.isfinite(progress.best_cost):
            parts.append(f"misfit so far {math.sqrt(progress.best_cost):.5g}")
        if math.isfinite(progress.time_left):
            now = time.monotonic()
            # The displayed time left must not increase, even if the estimate doubles.
            self._end = min(self._end, now + progress.time_left)
            left = self._end - now
            late = left < 0.5 * progress.time_left
            parts.append("longer than expected" if late else f"at most {left:.0f} s left")
        self.show(f"{progress.stage}: {', '.join(parts)}" if parts else progress.stage)
        return not self.stopped
