"""Hooks of MkDocs that show the repository's pages as a site (mkdocs.yml).

Markdown files outside docs/ become pages of the site. In the repository, links between Markdown
files are relative paths. The hooks turn them into links of the site. A link to a source file leads
to a page that shows the file. MkDocs calls the functions ``on_...`` by their names, in the order in
which they stand here.
"""

import html
import posixpath
import re
from importlib import import_module
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from gsmap.methods import METHODS

REPO = Path(__file__).resolve().parents[1]
# Page of the site -> Markdown file of the repository outside docs/.
OUTSIDE = {
    "overview.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "security.md": "SECURITY.md",
    "models.md": "models/README.md",
    "gsmap.md": "projects/GSMap/README.md",
    "minicity.md": "projects/MiniCity/README.md",
}
OUTSIDE |= {f"results/{path.name}": f"results/{path.name}" for path in REPO.glob("results/*.md")}
# The inverse: file of the repository -> page of the site.
PAGES = {source: page for page, source in OUTSIDE.items()}
LANGUAGES = {".py": "python", ".sh": "bash", ".json": "json"}
# The first two alternatives match fenced and inline code, which has no ``target`` and is kept. The
# third one matches a relative link ``](target#anchor)``. A link with a colon is a URL and no match.
LINK = re.compile(
    r"```.*?```|`[^`\n]*`|\]\((?P<target>[^)\s:#]+)(?P<anchor>#[^)\s]*)?\)", re.DOTALL
)
# HTML that mkdocstrings makes of docstrings: an equation, the heading of a class or function with
# its module and name, and the role before a name, which MkDocs would show as text.
MATH = re.compile(r":math:<code>(.*?)</code>", re.DOTALL)
NAME = re.compile(r'<h3 id="([\w.]+)\.(\w+)" class="doc doc-heading">.*?</h3>', re.DOTALL)
ROLE = re.compile(r":(?:class|func|meth):(?=<code>)")


def source_page(path: str) -> str:
    """Return the page that shows a file of the repository."""
    return f"source/{path}.md"


def links(text: str, folder: str) -> set[str]:
    """Return the files of the repository, outside docs/, that a page in ``folder`` links to."""
    paths = set()
    for match in LINK.finditer(text):
        if not match["target"]:  # the match is code
            continue
        path = posixpath.normpath(posixpath.join(folder, match["target"]))
        is_outside = not path.startswith(("docs/", "../"))
        if is_outside and (REPO / path).is_file():
            paths.add(path)
    return paths


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Insert the pages of the methods into the navigation, after ``methods.md``.

    They come in the order of `METHODS`, which lists the name and the title of each method. Methods
    without a page are left out.
    """
    # The navigation has exactly one part "Models", a list of entries {title: page}.
    sections = [part["Models"] for part in config.nav or () if "Models" in part]
    (models,) = sections
    # The enumeration starts at 1, so the number is the index after the entry of methods.md.
    position = next(n for n, page in enumerate(models, start=1) if "methods.md" in page.values())
    entries = []
    for method in METHODS:
        page = f"methods/{method.name}.md"
        if (REPO / "docs" / page).is_file():
            entries.append({method.title: page})
    models[position:position] = entries
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages outside docs/, and a page for each source file that a page links to."""
    linked = set()
    for file in files.documentation_pages():
        linked |= links(file.content_string, posixpath.dirname(f"docs/{file.src_uri}"))
    for page, source in OUTSIDE.items():
        text = (REPO / source).read_text(encoding="utf-8")
        linked |= links(text, posixpath.dirname(source))
        files.append(File.generated(config, page, content=text))
    for path in sorted(linked - PAGES.keys()):
        text = (REPO / path).read_text(encoding="utf-8")
        language = LANGUAGES.get(Path(path).suffix, "text")
        # Four backticks, as the text may contain fences of three.
        content = f"---\nsearch: {{exclude: true}}\n---\n# {path}\n\n````{language}\n{text}\n````\n"
        files.append(File.generated(config, source_page(path), content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the repository into links between pages of the site."""
    here = page.file.src_uri
    if here.startswith("source/"):  # shows a file as it is
        return markdown
    # Folder of the page's file in the repository, from which its links start.
    folder = posixpath.dirname(OUTSIDE.get(here, f"docs/{here}"))

    def site_link(match: re.Match[str]) -> str:
        target = match["target"]
        if not target:  # the match is code
            return match[0]
        path = posixpath.normpath(posixpath.join(folder, target))
        if path in PAGES:
            target_page = PAGES[path]
        elif path.startswith("docs/"):
            target_page = path.removeprefix("docs/")
        else:
            target_page = source_page(path)
        relative = posixpath.relpath(target_page, posixpath.dirname(here) or ".")
        return f"]({relative}{match['anchor'] or ''})"

    return LINK.sub(site_link, markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Convert equations to MathML, remove roles before names, and add import lines to headings."""
    # `convert` needs LaTeX with characters such as "<", which are escaped in HTML.
    content = MATH.sub(lambda match: convert(html.unescape(match[1])), content)
    return NAME.sub(with_import, ROLE.sub("", content))


def with_import(heading: re.Match[str]) -> str:
    """Return the heading of a class or function, followed by the line that imports it.

    The name is imported from the outermost package that lists it in ``__all__``. If no package
    lists it, the name is imported from the module that defines it.

    Args:
        heading: Match of ``NAME``, whose groups are the module and the name.
    """
    module, name = heading.groups()
    exporter = module
    package = ""
    for part in module.split("."):  # the packages a, a.b and a.b.c of a.b.c
        package = f"{package}.{part}" if package else part
        if name in getattr(import_module(package), "__all__", ()):
            exporter = package
            break
    return f"{heading[0]}<p><code>from {exporter} import {name}</code></p>"
