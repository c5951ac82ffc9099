"""The documentation builds as a site, whole and without network; its lines are short."""

import json
import re
import runpy
from pathlib import Path

import pytest
from mkdocs.commands.build import build
from mkdocs.config import load_config

REPO = Path(__file__).resolve().parents[1]
PAGES = list(REPO.glob("*.md"))
for folder in ("docs", "models", "projects", "results"):
    PAGES += (REPO / folder).rglob("*.md")
LOADED = re.compile(
    r"""<(?:script|img|iframe)[^>]*\bsrc=["']?(?:https?:)?//|<link[^>]*\bhref=["']?(?:https?:)?//|"""
    r"""@import|url\(["']?(?:https?:)?//"""
)
CLASS = re.compile(r"register_module\([^)]*\)\nclass (\w+)")


def read_pages(folder: Path, *patterns: str) -> dict[Path, str]:
    """Text of the files in a folder that match one of the patterns, by path."""
    pages = {}
    for pattern in patterns:
        for path in folder.glob(pattern):
            pages[path] = path.read_text(encoding="utf-8")
    return pages


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    config = load_config(str(REPO / "mkdocs.yml"), site_dir=str(folder), strict=True)
    config.plugins.on_startup(command="build", dirty=False)
    build(config)  # a broken link, a missing page or a wrong anchor ends it: strict
    return folder


def test_nothing_is_loaded_from_the_network(site: Path):
    pages = read_pages(site, "**/*.html", "**/*.css")
    assert len(pages) > 50
    assert [path for path, text in pages.items() if LOADED.search(text)] == []


@pytest.mark.parametrize("words", ["score my own predictions", "fine-tune"])
def test_the_search_finds_what_a_user_would_type(site: Path, words: str):
    """Each page of the search's index has a title, which counts most."""
    entries = json.loads((site / "search/search_index.json").read_text())["docs"]
    assert any(words in entry["title"].lower() for entry in entries)


def test_the_front_page_has_the_picture_tiles_and_three_commands(site: Path):
    page = (site / "index.html").read_text(encoding="utf-8")
    text = re.sub(r"<[^>]+>", "", page)
    assert 'src="images/minicity.jpg"' in page
    assert len(re.findall(r"<li>\s*<p><strong>", page)) >= 6
    assert "make demo" in text
    assert "tools/infer.py" in text
    assert "tools/evaluate.py" in text


def test_no_table_or_list_is_left_as_text(site: Path):
    """MkDocs wants an empty line before each, where the code host does not."""
    left = re.compile(r"<p>[^<]*\| -|<p>(?:(?!</p>).)*\n(?:[*-]|1\.) ", re.DOTALL)
    pages = read_pages(site, "**/*.html")
    assert [path for path, text in pages.items() if left.search(text)] == []


def test_the_reference_has_every_registered_name(site: Path):
    names = set()
    for text in read_pages(REPO / "projects/GSMap/gsmap", "**/*.py").values():
        names.update(CLASS.findall(text))
    assert len(names) > 50
    pages = read_pages(site, "api/*.html", "methods/*.html")
    shown = "".join(pages.values())
    assert [name for name in names if not re.search(rf'id="gsmap\.[\w.]+\.{name}"', shown)] == []
    assert ":math:" not in shown
    assert "<math" in shown


def test_the_reference_says_what_to_import_and_what_a_module_takes(site: Path):
    shown = "".join(read_pages(site, "api/*.html").values())
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
    long = []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        if len(line) >= 120 and not line.startswith("|"):
            long.append(number)
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
    for page in named:
        assert (REPO / "docs" / page).exists() or f'"{page}": "' in outside, page


def test_the_navigation_is_one_book():
    """At most 40,000 words with twelve pages of methods; each further page adds 700.

    Figures belong to results/, lists to pages outside the navigation.
    """
    hooks = runpy.run_path(str(REPO / "docs/site_hooks.py"))
    config = hooks["on_config"](load_config(str(REPO / "mkdocs.yml")))  # adds the methods' pages
    pages = re.findall(r"[\w/]+\.md", str(config.nav))
    assert len(pages) > 40
    num_words = 0
    limit = 31_600
    for page in pages:
        file = REPO / hooks["OUTSIDE"].get(page, f"docs/{page}")
        num_words += len(file.read_text(encoding="utf-8").split())
        if page.startswith("methods/"):
            limit += 700
    assert num_words <= limit


def test_summary_and_changelog_are_short():
    """The figures that count in one page; a changelog of what a user gets, not a diary."""
    for name, words in (("docs/benchmarks.md", 1500), ("CHANGELOG.md", 600)):
        assert len((REPO / name).read_text(encoding="utf-8").split()) <= words, name
