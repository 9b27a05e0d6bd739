"""Settings of Sphinx; the pages are the repository's own documents.

python3 -m sphinx -W --keep-going -b html -c docs . OUT
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tfeti_dolfinx import __version__  # noqa: E402

project = "tfeti_dolfinx"
author = "The tfeti_dolfinx developers"
release = version = __version__

# links between the documents hold in the repository and here, since its root is the source
root_doc = "docs/index"
include_patterns = [
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "docs/*.md",
    "docs/developers/*.md",
    "environment/README.md",
]
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_codeautolink",
]
myst_enable_extensions = ["amsmath", "attrs_inline", "dollarmath"]
myst_heading_anchors = 3
# a page's program goes on from block to block
codeautolink_concat_default = True

autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "pydata_sphinx_theme"
html_title = f"tfeti_dolfinx {release}"
html_theme_options = {"show_toc_level": 2, "navbar_align": "left"}
html_show_sourcelink = False
