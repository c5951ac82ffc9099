from argparse import Namespace

from benchmarks import prior


def test_the_table_has_a_row_of_figures_for_each_rule(tmp_path):
    out = tmp_path / "prior.md"
    prior.run(Namespace(km=0.05, repeats=2, out=out))
    rows = [line.split(" | ") for line in out.read_text().splitlines() if line.startswith("| ")]
    names = [row[0].removeprefix("| ") for row in rows[2:]]
    assert names == ["KeepMaximum", "LastSeen", "HitMissCounts"]
    for row in rows[2:]:
        figures = [float(cell.removesuffix(" |")) for cell in row[1:]]
        assert all(figure > 0 for figure in figures)
