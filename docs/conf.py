"""Settings of Sphinx; the pages are the repository's own documents.

python3 -m sphinx -W --keep-going -b html -c docs . OUT

With ``-t online`` types of other packages link to their pages, whose lists are fetched.
"""

import re
import sys
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

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
    "docs/guide/*.md",
    "docs/howto/*.md",
    "environment/README.md",
]
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_codeautolink",
]
myst_enable_extensions = ["amsmath", "attrs_inline", "dollarmath"]
myst_heading_anchors = 3
# a page's program goes on from block to block
codeautolink_concat_default = True

intersphinx_mapping = {
    "python": ("https://docs.python.org/3", None),
    "numpy": ("https://numpy.org/doc/stable", None),
    "mpi4py": ("https://mpi4py.readthedocs.io/en/stable", None),
    "petsc4py": ("https://petsc.org/release/petsc4py", None),
    "dolfinx": ("https://docs.fenicsproject.org/dolfinx/main/python", None),
}
if not tags.has("online"):  # type: ignore[name-defined]  # noqa: F821  # Sphinx puts it here
    intersphinx_mapping = {}

autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("Array", "ArrayLike", "Subdomains")}
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "pydata_sphinx_theme"
html_title = f"tfeti_dolfinx {release}"
html_theme_options = {
    "show_toc_level": 2,
    "navbar_align": "left",
    "header_links_before_dropdown": 8,
    "show_nav_level": 2,
}
html_show_sourcelink = False


def write_root_page(app: Sphinx, error: Exception | None) -> None:
    """Write ``index.html``, which leads to the first page: that is in a folder of its own."""
    if error is None and app.builder.format == "html":
        page = f"{root_doc}.html"
        (Path(app.outdir) / "index.html").write_text(
            f'<!doctype html><meta charset="utf-8"><title>{project}</title>'
            f'<meta http-equiv="refresh" content="0; url={page}"><a href="{page}">{project}</a>\n'
        )


def shorten_aliases(*event: Any) -> tuple[str | None, str | None]:
    """Return a signature with the names of type aliases alone."""
    signature, returned = (
        text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text) for text in event[-2:]
    )
    return signature, returned


def setup(app: Sphinx) -> None:
    """Connect what is done to signatures, and after a build."""
    app.connect("autodoc-process-signature", shorten_aliases)
    app.connect("build-finished", write_root_page)
