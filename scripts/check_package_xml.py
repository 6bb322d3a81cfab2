"""Check package.xml files against the schema in test/schema and by the rules of catkin_pkg."""

from __future__ import annotations

import sys
from pathlib import Path

from catkin_pkg.package import InvalidPackage, parse_package
from lxml import etree

SCHEMA = Path(__file__).resolve().parent.parent / "test" / "schema" / "package_format3.xsd"


def problems(path: Path) -> list[str]:
    """Return the faults of the file, in words; empty if it is valid."""
    schema = etree.XMLSchema(etree.parse(str(SCHEMA)))
    try:
        document = etree.parse(str(path))
    except etree.XMLSyntaxError as error:
        return [f"{path}: {error}"]
    if not schema.validate(document):
        return [f"{path}:{entry.line}: {entry.message}" for entry in schema.error_log]
    warnings: list[str] = []
    try:
        parse_package(str(path), warnings=warnings)
    except InvalidPackage as error:
        return [f"{path}: {error}"]
    return [f"{path}: {warning}" for warning in warnings]


def main() -> int:
    """Check the files named on the command line; the exit code is 1 if one is invalid."""
    paths = [Path(name) for name in sys.argv[1:]]
    found = [problem for path in paths for problem in problems(path)]
    for problem in found:
        print(problem, file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
