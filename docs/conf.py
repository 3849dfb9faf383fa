"""The documentation site: `make docs` builds it with broken links and references as errors."""

from typing import Any

from timberhand.reference.__main__ import write_built

project = "timberhand"
author = "the timberhand developers"
copyright = "the timberhand developers, Apache-2.0"

extensions = ["myst_parser", "sphinx_copybutton", "sphinxcontrib.mermaid"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4
myst_fence_as_directive = ["mermaid"]  # plain fences, so that forges draw them too
myst_links_external_new_tab = False

html_theme = "furo"
html_title = "timberhand"
html_show_sphinx = False
nitpicky = True


def setup(_: Any) -> None:
    """Write the reference pages that are generated and not committed, before Sphinx reads the pages."""
    write_built()
