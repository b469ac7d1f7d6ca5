"""The site: Sphinx reads pages and notebooks with MyST and the docstrings with napoleon; `make docs` builds it."""

import re
import shutil
from importlib.metadata import version as installed
from pathlib import Path

project = "ccdtools"
author = copyright = "The ccdtools developers"
version = release = installed("ccdtools")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
nb_execution_mode = "off"  # they are kept executed: `make notebooks`
shutil.rmtree(Path(__file__).parent / "notebooks", ignore_errors=True)
shutil.copytree(Path(__file__).parents[1] / "notebooks", Path(__file__).parent / "notebooks")
myst_heading_anchors = 4  # levels of headings that a link can lead to
suppress_warnings = ["ref.python"]  # a shape such as (nx, nu) in a docstring is no link to one of the attributes nx

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # types stand in the docstrings, with shapes and units
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_param = False
napoleon_use_rtype = False

html_theme = "pydata_sphinx_theme"
html_title = "ccdtools"
html_theme_options = {"show_prev_next": False, "secondary_sidebar_items": ["page-toc"]}

LITERAL = re.compile(r"(`[^`]*`)")


def bars_are_bars(app, what, name, obj, options, lines):
    """|x| in a docstring is an absolute value, not a substitution of reStructuredText."""
    for i, line in enumerate(lines):
        lines[i] = "".join(p if p.startswith("`") else p.replace("|", r"\|") for p in LITERAL.split(line))


def notebooks_are_pages(app, page, source):
    """A link to a notebook of the repository leads to its page."""
    source[0] = source[0].replace("](../../notebooks/", "](../notebooks/")


def setup(app):
    app.connect("source-read", notebooks_are_pages)
    app.connect("autodoc-process-docstring", bars_are_bars)
