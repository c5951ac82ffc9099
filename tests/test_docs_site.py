"""The documentation builds as a site, whole and without network; its lines are short."""

import json
import re
import runpy
from pathlib import Path

import pytest
from mkdocs.commands.build import build
from mkdocs.config import load_config

REPO = Path(__file__).resolve().parents[1]
PAGES = [
    path
    for folder in (REPO, *(REPO / name for name in ("docs", "models", "projects", "results")))
    for path in (folder.glob("*.md") if folder == REPO else folder.rglob("*.md"))
]
LOADED = re.compile(
    r"""<(?:script|img|iframe)[^>]*\bsrc=["']?(?:https?:)?//|<link[^>]*\bhref=["']?(?:https?:)?//|"""
    r"""@import|url\(["']?(?:https?:)?//"""
)
CLASS = re.compile(r"register_module\([^)]*\)\nclass (\w+)")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    config = load_config(str(REPO / "mkdocs.yml"), site_dir=str(folder), strict=True)
    config.plugins.on_startup(command="build", dirty=False)
    build(config)  # a broken link, a missing page or a wrong anchor ends it: strict
    return folder


def test_nothing_is_loaded_from_the_network(site: Path):
    pages = [*site.rglob("*.html"), *site.rglob("*.css")]
    assert len(pages) > 50
    assert [page for page in pages if LOADED.search(page.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("words", ["score my own predictions", "fine-tune"])
def test_the_search_finds_what_a_user_would_type(site: Path, words: str):
    """Each page of the search's index has a title, which counts most."""
    entries = json.loads((site / "search/search_index.json").read_text())["docs"]
    assert [entry for entry in entries if words in entry["title"].lower()]


def test_the_front_page_has_the_picture_tiles_and_three_commands(site: Path):
    page = (site / "index.html").read_text(encoding="utf-8")
    text = re.sub(r"<[^>]+>", "", page)
    assert 'src="images/minicity.jpg"' in page
    assert len(re.findall(r"<li>\s*<p><strong>", page)) >= 6
    assert all(command in text for command in ("make demo", "tools/infer.py", "tools/evaluate.py"))


def test_no_table_or_list_is_left_as_text(site: Path):
    """MkDocs wants an empty line before each, where the code host does not."""
    left = re.compile(r"<p>[^<]*\| -|<p>(?:(?!</p>).)*\n(?:[*-]|1\.) ", re.DOTALL)
    pages = {page: page.read_text(encoding="utf-8") for page in site.rglob("*.html")}
    assert [page for page, text in pages.items() if left.search(text)] == []


def test_the_reference_has_every_registered_name(site: Path):
    sources = (REPO / "projects/GSMap/gsmap").rglob("*.py")
    names = {name for path in sources for name in CLASS.findall(path.read_text(encoding="utf-8"))}
    assert len(names) > 50
    pages = [*(site / "api").glob("*.html"), *(site / "methods").glob("*.html")]
    shown = "".join(page.read_text(encoding="utf-8") for page in pages)
    assert {name for name in names if not re.search(rf'id="gsmap\.[\w.]+\.{name}"', shown)} == set()
    assert ":math:" not in shown
    assert "<math" in shown


def test_the_reference_says_what_to_import_and_what_a_module_takes(site: Path):
    shown = "".join(page.read_text(encoding="utf-8") for page in (site / "api").glob("*.html"))
    lines = set(re.findall(r"<code>(from [\w.]+ import \w+)</code>", shown))
    assert {
        "from gsmap import MapInferencer",
        "from gsmap.evaluation import ChamferConfig",
        "from gsmap.models.gsmap.cost import IoUCost",
    } <= lines
    for line in lines:
        exec(line, {})
    for name in ("gsmap.losses.RasterLoss", "gsmap.head.GSMapHead"):  # both inherit it
        assert f'id="gsmap.models.{name}.forward"' in shown


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPO)))
def test_lines_are_short(page: Path):
    """Table rows cannot be broken; everything else is shorter than 120 characters."""
    lines = enumerate(page.read_text(encoding="utf-8").splitlines(), start=1)
    long = [n for n, line in lines if len(line) >= 120 and not line.startswith("|")]
    assert long == [], f"{page}: lines of 120 characters or more"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPO)))
def test_a_spread_of_figures_is_named(page: Path):
    """A range (largest minus smallest) or a standard deviation; samples may be evenly spread."""
    text = page.read_text(encoding="utf-8")
    assert re.findall(r"(?<!evenly )\bspread\b", text) == []


def test_mkdocs_names_pages_that_exist():
    config = load_config(str(REPO / "mkdocs.yml"))
    named = re.findall(r"[\w/]+\.md", str(config.nav) + str(config.not_in_nav))
    outside = (REPO / "docs/site_hooks.py").read_text()
    assert [
        p for p in named if not (REPO / "docs" / p).exists() and f'"{p}": "' not in outside
    ] == []


def test_the_navigation_is_one_book():
    """At most 40,000 words with twelve pages of methods; each further page adds 700.

    Figures belong to results/, lists to pages outside the navigation.
    """
    hooks = runpy.run_path(str(REPO / "docs/site_hooks.py"))
    config = hooks["on_config"](load_config(str(REPO / "mkdocs.yml")))  # adds the methods' pages
    pages = re.findall(r"[\w/]+\.md", str(config.nav))
    files = [REPO / hooks["OUTSIDE"].get(page, f"docs/{page}") for page in pages]
    texts = [file.read_text(encoding="utf-8") for file in files]
    assert len(texts) > 40
    of_methods = [page for page in pages if page.startswith("methods/")]
    limit = 31_600 + 700 * len(of_methods)
    assert sum(len(text.split()) for text in texts) <= limit


def test_summary_and_changelog_are_short():
    """The figures that count in one page; a changelog of what a user gets, not a diary."""
    for name, words in (("docs/benchmarks.md", 1500), ("CHANGELOG.md", 600)):
        assert len((REPO / name).read_text(encoding="utf-8").split()) <= words, name
