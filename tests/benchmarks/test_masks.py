import argparse

from benchmarks import masks


def test_the_command_writes_a_table_per_reduction_and_band_and_one_of_misses(tmp_path, monkeypatch):
    monkeypatch.setattr(masks, "ERRORS_M", (1.0,))
    monkeypatch.setattr(masks, "SCALES_M", (0.25,))
    monkeypatch.setattr(masks, "LENGTHS_M", (10.0,))
    parser = argparse.ArgumentParser()
    masks.add_arguments(parser)
    args = parser.parse_args(f"--seeds 2 --out {tmp_path / 'out.md'}".split())
    masks.run(args)
    report = (tmp_path / "out.md").read_text()
    along, across = masks.scale_gradients("both", 0.75, 1.0, 0.25, seeds=2)
    assert f"| 1 m | {1e3 * along:+.2f} / {1e3 * across:+.2f} |" in report
    assert report.count("\n| --- |") == len(masks.REDUCTIONS) * len(masks.BANDS_M) + 1
    loss = masks.missed_line_loss("both", 0.75, 10.0, (128, 64))
    assert f"| both | 0.75 m | 128 x 64 | {loss:.3f} |" in report


def test_a_filled_mask_draws_the_centres_off_the_outline():
    assert masks.fit_crossing(filled=False, iterations=200) > 0.9
    assert masks.fit_crossing(filled=True, iterations=200) < 0.5
