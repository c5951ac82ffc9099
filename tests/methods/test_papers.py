"""The settings of each method's configs against the numbers that its paper or release prints.

The numbers are in ``gsmap/models/<method>/paper.json``. A setting that no number is known of is not
there.
"""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
from paper_cases import head_of, load

from gsmap.methods import METHODS

REPO = Path(__file__).resolve().parents[2]
PAPERS = {method.name: method.paper() for method in METHODS}
SETTINGS = [
    (config, path, value)
    for paper in PAPERS.values()
    for config, settings in paper["settings"].items()
    for path, value in settings.items()
]
HEADS = [
    (config, published) for paper in PAPERS.values() for config, published in paper["heads"].items()
]


def setting(config: Any, path: str) -> Any:
    for key in path.split("."):
        config = config[int(key)] if key.isdecimal() else config[key]
    return config


def plain(value: Any) -> Any:
    """Return a setting as a JSON file has it, its numbers to twelve digits."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    return float(f"{value:.12g}") if isinstance(value, float) else value


@pytest.mark.parametrize(("config", "path", "value"), SETTINGS)
def test_a_config_says_what_was_published(config: str, path: str, value: Any):
    assert plain(setting(load(config), path)) == plain(value)


@pytest.mark.parametrize(("config", "published"), HEADS, ids=[config for config, _ in HEADS])
def test_a_head_has_the_published_queries_and_weights(config: str, published: dict[str, Any]):
    head = head_of(config)
    assert [group.num for group in head.query_groups] == published["queries"]
    assert {name: loss.loss_weight for name, loss in head.losses.items()} == published["losses"]
    assert [cost.weight for cost in head.assigner.match_costs] == published["costs"]
    weights = {name: aux.loss_weight for name, aux in head.aux_heads.items()}
    assert weights == published.get("aux", {})
    focal = head.loss_cls
    assert (focal.loss_weight, focal.alpha, focal.gamma) == (2.0, 0.25, 2.0)
    assert (head.num_points, head.embed_dims, len(head.decoder.layers)) == (20, 256, 6)


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_a_paper_has_its_page_and_its_row_in_the_comparison(method):
    paper = PAPERS[method.name]
    lines = (REPO / "docs/methods.md").read_text().splitlines()
    rows = [line for line in lines if line.startswith(f"| {method.title}, ")]
    assert len(rows) == 1, f"docs/methods.md needs one row of {method.title}."
    (row,) = rows
    assert all(f"{number:,}" in row for number in paper["parameters"].values())
    assert f"arxiv.org/abs/{paper['arxiv']}" in row


def test_the_comparison_has_the_rows_of_all_papers():
    spec = spec_from_file_location("method_tables", REPO / "docs/method_tables.py")
    tables = module_from_spec(spec)
    spec.loader.exec_module(tables)
    text = tables.PAGE.read_text(encoding="utf-8")
    assert tables.with_tables(text) == text, "run: python docs/method_tables.py"
    for method in METHODS:
        assert f"| {method.title}, [{method.paper()['arxiv']}](" in text
    with pytest.raises(ValueError, match="needs one pair of the markers <!-- overview"):
        tables.with_tables("# A page without tables")
