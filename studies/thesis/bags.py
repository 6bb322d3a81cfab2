"""``python -m studies bags``: the thesis' runs as bags, re-synthesised from its published sets."""

from __future__ import annotations

import argparse
from pathlib import Path

from mr_damper_ros.io.bag_files import BagError
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.models.published import CONDITIONS, Condition, find
from mr_damper_ros.tools.console import program
from studies.program import say
from studies.thesis.facts import ERRATA, is_clean
from studies.thesis.runs import recording_name, synthesise

_DESCRIPTION = """\
Make bags of the runs in the thesis, one folder for each condition, from the published parameter
sets. They are re-synthesised, not the original recordings.
"""

_EPILOG = "conditions:\n" + "\n".join(
    f"  {each.name}{'' if is_clean(each) else '   (erratum)'}" for each in CONDITIONS
)


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="folder for the bags")
    chosen = "conditions to make, such as 2.5mm_1Hz_0.0A (default: all without errata)"
    add("--conditions", nargs="+", metavar="NAME", help=chosen)
    wrong = "also make the conditions whose published row is in error; name and metadata mark them"
    add("--errata", action="store_true", help=wrong)
    add("--seed", type=int, default=0, help="seed of the noise (default %(default)s)")
    add("--overwrite", action="store_true", help="replace existing bags")


def _chosen(options: argparse.Namespace) -> list[Condition]:
    if options.conditions is None:
        return [c for c in CONDITIONS if options.errata or is_clean(c)]
    conditions = list(dict.fromkeys(find(name) for name in options.conditions))
    for condition in conditions:
        if not (options.errata or is_clean(condition)):
            raise ValueError(
                f"{condition.name} is an erratum ({ERRATA[condition]}): add --errata to make it "
                "nevertheless"
            )
    return conditions


def _make(options: argparse.Namespace) -> int:
    if options.seed < 0:
        raise ValueError(f"the seed is {options.seed}: it must not be negative")
    paths = {options.folder / recording_name(each): each for each in _chosen(options)}
    existing = [path for path in paths if path.exists()]
    if existing and not options.overwrite:
        raise BagError(
            f"{existing[0]} exists already: choose another folder or add --overwrite to replace it"
        )
    for number, (path, condition) in enumerate(paths.items(), start=1):
        say(f"{number} of {len(paths)}: {path.name}")
        write_bag(path, synthesise(condition, seed=options.seed), overwrite=options.overwrite)
    say("")
    print(
        f"{len(paths)} {'bag' if len(paths) == 1 else 'bags'} in {options.folder}, re-synthesised "
        "from the published parameter sets; not the original recordings"
    )
    marked = [path.name for path, condition in paths.items() if condition in ERRATA]
    if marked:
        print(f"errata, not to be compared with other conditions: {', '.join(marked)}")
    return 0


main = program("studies bags", _DESCRIPTION, _options, _make, _EPILOG)
