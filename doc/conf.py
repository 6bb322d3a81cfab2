"""Settings of the documentation site that ``make doc`` builds; offline, as the reader may be."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE / "extensions")]

project = "mr_damper_ros"
author = "the mr_damper_ros maintainers"
copyright = author
release = re.findall(r"<version>(.*?)</version>", (HERE.parent / "package.xml").read_text())[0]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "numpydoc",
    "formulas",
    "generated_pages",
]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["extensions"]
suppress_warnings = ["epub.unknown_project_files"]

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {
    name: name for name in ("Array", "ArrayLike", "Law", "Report", "RunSource", "State")
}
python_use_unqualified_type_names = True
maximum_signature_line_length = 88
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
add_module_names = False

html_theme = "furo"
html_title = f"mr_damper_ros {release}"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}


def _plain_signature(
    app: object,
    what: str,
    name: str,
    entry: object,
    options: object,
    signature: str | None,
    result: str | None,
) -> tuple[str | None, str | None] | None:
    """A signature without what only Sphinx and dataclasses understand."""
    if signature is None:
        return None
    alias = r"TypeAliasForwardRef\('(\w+)'\)"
    plain = re.sub(alias, r"\1", signature).replace("<factory>", "...")
    return plain, result and re.sub(alias, r"\1", result)


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", _plain_signature)
