"""What MkDocs needs to show the repository's pages as a site (mkdocs.yml).

Pages outside docs/ become pages of the site. Links between Markdown files stay as they work in the
repository; here they are turned into links of the site. A link to a file of code leads to a page
that shows it.
"""

import html
import posixpath
import re
from importlib import import_module
from itertools import accumulate
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from gsmap.methods import METHODS

REPO = Path(__file__).resolve().parents[1]
# page of the site -> file of the repository
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
PAGES = {source: page for page, source in OUTSIDE.items()}
LANGUAGES = {".py": "python", ".sh": "bash", ".json": "json"}
# fenced and inline code are left alone
LINK = re.compile(
    r"```.*?```|`[^`\n]*`|\]\((?P<target>[^)\s:#]+)(?P<anchor>#[^)\s]*)?\)", re.DOTALL
)
MATH = re.compile(r":math:<code>(.*?)</code>", re.DOTALL)
NAME = re.compile(r'<h3 id="([\w.]+)\.(\w+)" class="doc doc-heading">.*?</h3>', re.DOTALL)
ROLE = re.compile(r":(?:class|func|meth):(?=<code>)")


def source_page(path: str) -> str:
    """Return the page that shows a file of the repository."""
    return f"source/{path}.md"


def links(text: str, folder: str) -> set[str]:
    """Return the files of the repository, outside docs/, that a page in ``folder`` links to."""
    targets = (match["target"] for match in LINK.finditer(text) if match["target"])
    paths = (posixpath.normpath(posixpath.join(folder, target)) for target in targets)
    return {p for p in paths if not p.startswith(("docs/", "../")) and (REPO / p).is_file()}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages of the methods behind their comparison, in the order of their list."""
    (models,) = (part["Models"] for part in config.nav or () if "Models" in part)
    place = next(n for n, page in enumerate(models, start=1) if "methods.md" in page.values())
    pages = {method.title: f"methods/{method.name}.md" for method in METHODS}
    written = {title: page for title, page in pages.items() if (REPO / "docs" / page).is_file()}
    models[place:place] = [{title: page} for title, page in written.items()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages outside docs/ and a page for each file of code that a page links to."""
    shown = set()
    for file in files.documentation_pages():
        shown |= links(file.content_string, posixpath.dirname(f"docs/{file.src_uri}"))
    for page, source in OUTSIDE.items():
        text = (REPO / source).read_text(encoding="utf-8")
        shown |= links(text, posixpath.dirname(source))
        files.append(File.generated(config, page, content=text))
    for path in sorted(shown - PAGES.keys()):
        text = (REPO / path).read_text(encoding="utf-8")
        language = LANGUAGES.get(Path(path).suffix, "text")
        content = f"---\nsearch: {{exclude: true}}\n---\n# {path}\n\n````{language}\n{text}\n````\n"
        files.append(File.generated(config, source_page(path), content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the repository into links between pages of the site."""
    here = page.file.src_uri
    if here.startswith("source/"):
        return markdown
    folder = posixpath.dirname(OUTSIDE.get(here, f"docs/{here}"))

    def on_site(match: re.Match[str]) -> str:
        target = match["target"]
        if not target:
            return match[0]
        path = posixpath.normpath(posixpath.join(folder, target))
        if path in PAGES:
            found = PAGES[path]
        elif path.startswith("docs/"):
            found = path.removeprefix("docs/")
        else:
            found = source_page(path)
        relative = posixpath.relpath(found, posixpath.dirname(here) or ".")
        return f"]({relative}{match['anchor'] or ''})"

    return LINK.sub(on_site, markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Show equations as MathML, names without their roles, and where a name is imported from."""
    content = MATH.sub(lambda match: convert(html.unescape(match[1])), content)
    return NAME.sub(with_import, ROLE.sub("", content))


def with_import(heading: re.Match[str]) -> str:
    """Return the heading of a class or function, with the line that imports it below."""
    module, name = heading.groups()
    packages = accumulate(module.split("."), "{}.{}".format)
    offers = (path for path in packages if name in getattr(import_module(path), "__all__", ()))
    return f"{heading[0]}<p><code>from {next(offers, module)} import {name}</code></p>"
