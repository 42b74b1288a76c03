"""Configuration of the documentation site, which `make docs` builds.

The source folder of Sphinx is the root of the repository, so that links from pages to examples and to CONTRIBUTING.md
are the same on the site and on a code host. The site requests nothing from other hosts.
"""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "docs" / "_extensions"), str(ROOT / "src")]

import pathreplay  # noqa: E402

project = "pathreplay"
author = "The pathreplay authors"
version = release = pathreplay.__version__
project_copyright = author

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "mathml", "sections"]
root_doc = "docs/index"
include_patterns = ["docs/**.md", "examples/*/README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"]
exclude_patterns = [".*", "build", "dist", "runs", "src", "tests", "benchmarks", "stubs", "**/__pycache__"]
# Sections list the pages of a folder, which may be empty. Sphinx gives this warning no type by which to suppress it.
TOCTREES = logging.getLogger("sphinx.sphinx.directives.other")
TOCTREES.addFilter(lambda record: vars(record).get("subtype") != "empty_glob")

# Markdown is that of a code host: headings have its anchors, and formulas are between dollars.
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath", "colon_fence"]
highlight_language = "none"

# Docstrings name objects in single backticks.
default_role = "py:obj"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
# Signatures need no framework.
autodoc_mock_imports = ["torch", "jax"]
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
python_maximum_signature_line_length = 88

# `make docs` runs notebooks whose text has changed; PATHREPLAY_DOCS_NOTEBOOKS=off shows them without outputs.
nb_execution_mode = os.environ.get("PATHREPLAY_DOCS_NOTEBOOKS", "cache")
nb_execution_cache_path = str(ROOT / "build" / "notebooks")
nb_execution_timeout = 1800
nb_execution_raise_on_error = True
nb_merge_streams = True

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"pathreplay {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["_root"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
