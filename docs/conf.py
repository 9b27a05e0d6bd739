"""Settings of Sphinx; the pages are the repository's own documents.

python3 -m sphinx -W --keep-going -b html -c docs . OUT

With ``-t online`` types of other packages link to their pages, whose lists are fetched; with
``-t executed`` each example is run at its quick size: its page has what it prints, some a 3D view.
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from subprocess import PIPE, STDOUT
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import unquote, urlsplit

from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

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
    "docs/examples/*.md",
    "docs/api/*.md",
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
    "sphinx-mathjax-offline",  # formulas without a network: MathJax lies in the site
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

TypeAliasForwardRef.__repr__ = lambda self: self.name  # type: ignore[method-assign]
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_type_aliases = {
    name: name for name in ("Array", "ArrayLike", "Gap", "GivenSubdomains", "Vector")
}
autodoc_member_order = "bysource"
toc_object_entries_show_parents = "hide"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # types of attributes stand in the signature

html_theme = "pydata_sphinx_theme"
html_title = project
html_theme_options = {
    "show_toc_level": 2,
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "show_nav_level": 2,
}
html_show_sourcelink = False
html_static_path = ["static"]
html_css_files = ["site.css"]
# pages without pages below them have nothing to list beside them
bare = ("README", "docs/index", "docs/install", "docs/validation", "docs/theory")
html_sidebars: dict[str, list[str]] = {page: [] for page in bare}

# made here: a page for each demo, and one for each class and function
EXAMPLES, API = ROOT / "docs" / "examples", ROOT / "docs" / "api"
API_LIST = ROOT / "docs" / "api.md"
VIEWS = ("ball_bearing_3d", "bolted_joint_3d", "clamped_connection_3d", "stacked_blocks_3d")
BLOCK = re.compile(r"^```\{eval-rst\}\n(.*?)^```$", re.DOTALL | re.MULTILINE)
ENTRY = re.compile(r"^\.\. (auto\w+):: (\S+)\n((?:   .*\n)*)", re.MULTILINE)
PICTURE = re.compile(r"\| (?:!\[(.*?)\]\((.*?)\))? *\| \[`(\w+)\.py`\]\(.*?\): (.*?) \|")


def cells_of(text: str) -> Iterator[tuple[bool, str]]:
    """Yield the cells of a program in jupytext's light form: whether it is code, and its text."""
    for block in re.split(r"^# \+\n(.*?)^# -$", text, flags=re.DOTALL | re.MULTILINE):
        if re.match(r"(#( |$)|\n)", block) is None:
            yield True, block.strip("\n")
            continue
        for part in re.split(r"\n{2,}(?=# )|\n{2,}(?=[^#\s])", block.strip("\n")):
            lines = part.splitlines()
            code = not all(line.startswith("#") for line in lines)
            if lines:
                yield code, part if code else "\n".join(line[2:] for line in lines)


def write_examples(app: Sphinx) -> None:
    """Write a page for each demo: its text, its program, and the pictures that it draws."""
    EXAMPLES.mkdir(exist_ok=True)
    for path in sorted((ROOT / "demos").glob("[a-z]*.py")):
        title, *parts = cells_of(path.read_text())
        page = [title[1] if not title[0] else path.stem]
        page += [f"{{download}}`{path.name} <../../demos/{path.name}>`"]
        page += [f"```python\n{text}\n```" if code else text for code, text in parts]
        pictures = sorted((ROOT / "docs/pictures").glob(f"{path.stem}*"))
        page += ["## Pictures"] * bool(pictures)
        page += [f"![{picture.stem}](../pictures/{picture.name})" for picture in pictures]
        if app.tags.has("executed"):
            page += ["## What it prints", f"With `--quick`:\n\n```text\n{printed(path)}\n```"]
            if path.stem in VIEWS:
                scripts = (
                    f"<script src='../../_static/{s}.js'></script>" for s in ("view", path.stem)
                )
                page += ["## Turn it", "```{raw} html\n" + "\n".join(scripts) + "\n```"]
        write_if_new(EXAMPLES / f"{path.stem}.md", "\n\n".join(page) + "\n")


def printed(path: Path) -> str:
    """Run a demo at its quick size, and write the view in 3D of some; what it prints, and logs."""
    command = [sys.executable, str(path), "--quick"]
    if path.stem in VIEWS:
        view = ROOT / "docs/static" / f"{path.stem}.js"
        command = [sys.executable, str(ROOT / "docs/view.py"), path.stem, str(view)]
    given: dict[str, Any] = {"env": {**os.environ, "PYTHONPATH": str(ROOT)}, "text": True}
    with TemporaryDirectory() as folder:
        done = subprocess.run(command, cwd=folder, stderr=STDOUT, stdout=PIPE, **given)
    if done.returncode != 0:
        raise RuntimeError(f"{path.name} --quick:\n{done.stdout}")
    return done.stdout.strip()


def write_if_new(target: Path, text: str) -> None:
    """Write a page, unless it is there already: Sphinx would read it again."""
    if not target.exists() or target.read_text() != text:
        target.write_text(text)


def write_api(app: Sphinx) -> None:
    """Write a page for each entry of the API's list."""
    API.mkdir(exist_ok=True)
    for block in BLOCK.findall(API_LIST.read_text()):
        for directive, name, options in ENTRY.findall(block):
            entry = f".. currentmodule:: tfeti_dolfinx\n.. {directive}:: {name}\n{options}"
            short = name.rpartition(".")[2]
            write_if_new(API / f"{short}.md", f"# {short}\n\n```{{eval-rst}}\n{entry}```\n")


def list_api(app: Sphinx, page: str, source: list[str]) -> None:
    """Make a list with a link to each entry's page, and its first line, of the API's blocks."""
    if page != "docs/api":
        return
    names: list[str] = []

    def listed(block: re.Match[str]) -> str:
        lines = []
        for _, name, _ in ENTRY.findall(block[1]):
            short = name.rpartition(".")[2]
            names.append(short)
            path = name if "." in name else f"tfeti_dolfinx.{name}"
            module, _, attribute = path.rpartition(".")
            text = (getattr(import_module(module), attribute).__doc__ or "").strip()
            summary = text.split("\n\n")[0].replace("\n", " ").removesuffix(" Collective.")
            lines.append(f"* [{short}](api/{short}.md): {' '.join(summary.split())}")
        return "\n".join(lines)

    text = BLOCK.sub(listed, source[0])
    table = "\n".join(f"api/{name}" for name in names)
    source[0] = f"{text}\n```{{toctree}}\n:hidden:\n\n{table}\n```\n"


def make_cards(app: Sphinx, page: str, source: list[str]) -> None:
    """Make cards of the gallery's tables, which lead to the pages of the demos."""
    if page != "docs/gallery":
        return
    rows: list[str] = []
    lines: list[str] = []
    names: list[str] = []
    for line in [*source[0].splitlines(), ""]:
        row = PICTURE.fullmatch(line)
        if row is not None:
            alt, file, name, text = row.groups()
            names.append(name)
            if name in VIEWS and app.tags.has("executed"):
                text += f" ([turn it](examples/{name}.md#turn-it))"
            image = f"[![{alt}]({file})](examples/{name}.md)\n\n" if file else ""
            rows.append(
                f"````{{container}} card\n{image}[{name}](examples/{name}.md): {text}\n````"
            )
        elif rows and not line.startswith("|"):
            lines += ["`````{container} cards", *rows, "`````", line]
            rows = []
        elif not line.startswith("|"):
            lines.append(line)
    table = "\n".join(f"examples/{name}" for name in names)
    source[0] = "\n".join(lines) + f"\n```{{toctree}}\n:hidden:\n\n{table}\n```\n"


def keep_numbers_whole(app: Sphinx, page: str, source: list[str]) -> None:
    """Keep sums, shares and powers in tables on one line."""

    def kept(row: re.Match[str]) -> str:
        parts = row[0].split("`")
        for i, text in enumerate(parts[::2]):
            text = re.sub(r"(?<=\d) (?=[+%])|(?<=\+) (?=\d)", "\N{NO-BREAK SPACE}", text)
            parts[2 * i] = re.sub(r"(?<=\de)-(?=\d)", "\N{NON-BREAKING HYPHEN}", text)
        return "`".join(parts)

    source[0] = re.sub(r"^\|.*$", kept, source[0], flags=re.MULTILINE)


def shorten_signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returns: Any
) -> tuple[str, Any] | None:
    """Show types of a dataclass as they are written, and nothing where no user makes one."""
    if what != "class" or signature is None:
        return None
    if name.endswith((".Options", ".Report")) or signature in ("(*args, **kwargs)", "(*values)"):
        return "", returns
    if is_dataclass(obj) and re.search(r"~|<factory>|\b_", signature):
        parts: list[str] = []
        for field in sorted(fields(obj), key=lambda field: field.kw_only):
            parts += ["*"] * (field.kw_only and "*" not in parts)
            default = "" if field.default is MISSING else f" = {field.default!r}"
            default = default if field.default_factory is MISSING else " = ..."
            default = re.sub(r"<function (\w+) at \w+>", r"\1", default)
            parts += [f"{field.name}: {field.type}{default}"] * (
                field.init and field.name[0] != "_"
            )
        return f"({', '.join(parts)})", returns
    return None


def mend_source_links(
    app: Sphinx, page: str, template: str, context: dict[str, Any], tree: Any
) -> None:
    """Lead from the source of a module to entries whose names begin with another module, too."""
    if not page.startswith("_modules/"):
        return
    named = {entry[1].rpartition(".")[2]: entry[1] for entry in ENTRY.findall(API_LIST.read_text())}

    def whole(link: re.Match[str]) -> str:
        name = named.get(link[1], link[1])
        path = name if "." in name else f"tfeti_dolfinx.{name}"
        return f"/{link[1]}.html#{path}{link[2]}"

    pattern = r"/(\w+)\.html#[\w.]*?\.\1((?:\.\w+)?)(?=\")"
    context["body"] = re.sub(pattern, whole, context["body"])


def write_root_page(app: Sphinx, error: Exception | None) -> None:
    """Write ``index.html``, which leads to the first page: that is in a folder of its own."""
    if error is None and app.builder.format == "html":
        page = f"{root_doc}.html"
        (Path(app.outdir) / "index.html").write_text(
            f'<!doctype html><meta charset="utf-8"><title>{project}</title>'
            f'<meta http-equiv="refresh" content="0; url={page}"><a href="{page}">{project}</a>\n'
        )


class Page(HTMLParser):
    """Collect the links of a page, and what links may lead to in it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links, self.anchors = set[str](), {""}
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take note of the attributes of a tag."""
        self.anchors |= {value for key, value in attrs if key in ("id", "name") and value}
        self.links |= {value for key, value in attrs if key in ("href", "src") and value}


def follow_links(app: Sphinx, error: Exception | None) -> None:
    """Raise an error if a link of the site leads nowhere; others' pages are not asked."""
    if error is not None or app.builder.format != "html":
        return
    root = Path(app.outdir).resolve()
    files = [path for path in root.rglob("*.html") if "_static" not in path.parts]
    pages = {path: Page(path) for path in files}
    lost = []
    for path, page in pages.items():
        for link in page.links:
            address = urlsplit(link)
            if address.scheme or address.netloc:
                continue
            target = (path.parent / unquote(address.path)).resolve() if address.path else path
            anchors = pages[target].anchors if target in pages else {""}
            if not target.exists() or (
                target in pages and unquote(address.fragment) not in anchors
            ):
                lost.append(f"{path.relative_to(root)}: {link}")
    if lost:
        raise RuntimeError("links that lead nowhere:\n" + "\n".join(sorted(lost)))


def setup(app: Sphinx) -> None:
    """Connect what is done before a build, to pages, and after it."""
    app.connect("builder-inited", write_examples)
    app.connect("builder-inited", write_api)
    app.connect("source-read", make_cards)
    app.connect("source-read", list_api)
    app.connect("source-read", keep_numbers_whole)
    app.connect("autodoc-process-signature", shorten_signature)
    app.connect("html-page-context", mend_source_links)
    app.connect("build-finished", write_root_page)
    app.connect("build-finished", follow_links)
