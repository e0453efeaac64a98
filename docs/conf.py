"""How Sphinx builds the site: `make docs` writes it to build/docs."""

from sphinx.application import Sphinx

import sb3_follow_object

project = "sb3-follow-object"
author = "sb3-follow-object contributors"
project_copyright = author
version = release = sb3_follow_object.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
myst_heading_anchors = 3  # the ids that repository browsers give headings
highlight_language = "none"  # of blocks that name no language: command lines and folders
copybutton_exclude = ".linenos, .gp"

# Docstrings name things in single backticks: a link where the reference has the name, else code.
default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
python_maximum_signature_line_length = 80
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = project
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False


def setup(app: Sphinx) -> None:
    """Let links to CONTRIBUTING.md, which is at the repository's top, lead to its page."""
    app.connect("source-read", _link_contributing)


def _link_contributing(app: Sphinx, page: str, source: list[str]) -> None:
    source[0] = source[0].replace("](../CONTRIBUTING.md", "](contributing.md")
