"""The ablation of heads on stored features: paired, resumable, from a common checkpoint."""

import json
from argparse import ArgumentParser, Namespace
from pathlib import Path

import pytest

from benchmarks import heads
from benchmarks.shape import line_shapes

REPO = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_variants_of_a_head_are_trained_on_stored_features(
    minicity_root, minicity_annotations, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(REPO)
    maptr = "configs/maptr/maptr_r18_minicity.py"
    gsmap = "projects/GSMap/configs/gsmap_maptr_r18_minicity.py"
    variants = tmp_path / "variants.json"
    no_masks = f"{gsmap} model.map_head.loss_raster=None model.map_head.iou_cost=None"
    variants.write_text(json.dumps({"MapTR": maptr, "GSMap": gsmap, "no masks": no_masks}))
    args = Namespace(
        config=Path(maptr), checkpoint="maptr_r18_minicity", variants=variants, out=tmp_path,
        data_root=f"{minicity_root}/", iterations=0, batch=2, lr=3e-4, seeds=1, workers=1,
        from_scratch=False,
    )  # fmt: skip
    heads.run(args)
    # What GSMap adds starts neutral, so without a step every head finds what MapTR's finds.
    figures = [json.loads((tmp_path / f"{name}-0.json").read_text()) for name in ("MapTR", "GSMap")]
    assert figures[0] == pytest.approx(figures[1])
    assert figures[0]["chamfer/mAP"] > 0
    shapes = line_shapes(tmp_path / "MapTR-0/results.json", minicity_annotations["val"])
    assert len(shapes["divider"])
    args.out, args.iterations = tmp_path / "trained", 3
    args.out.mkdir()
    for part in ("train", "val"):
        (tmp_path / f"{part}.pt").rename(args.out / f"{part}.pt")
    with pytest.raises(ValueError, match="features of unknown settings: give another --out"):
        heads.run(args)
    (tmp_path / "settings.json").rename(args.out / "settings.json")
    heads.run(args)
    first = {path.name: path.stat().st_mtime_ns for path in args.out.glob("*-0.json")}
    assert len(first) == 3
    heads.run(args)  # what is there is not run again
    assert first == {path.name: path.stat().st_mtime_ns for path in args.out.glob("*-0.json")}
    assert "3 iterations of 2" in capsys.readouterr().out
    args.iterations = 4
    with pytest.raises(ValueError, match="figures of other settings: give another --out"):
        heads.run(args)
    variants.write_text(json.dumps({"new": maptr}))
    args.iterations, args.from_scratch = 0, True
    heads.run(args)
    new = json.loads((args.out / "new-0.json").read_text())
    assert new["chamfer/mAP"] < figures[0]["chamfer/mAP"] / 10


def test_features_of_another_checkpoint_are_not_used_for_new_variants(tmp_path, monkeypatch):
    monkeypatch.setattr(heads, "store_features", lambda cfg, checkpoint, part, path: path.touch())
    figures = {f"{m}/{c}/AP": -1.0 for m in heads.METRIC_NAMES for c in heads.CLASSES}
    figures |= {f"{metric}/mAP": 0.5 for metric in heads.METRIC_NAMES}
    monkeypatch.setattr(
        heads, "ordered_map", lambda work, tasks, *_, **__: [figures for _ in tasks]
    )
    config = str(REPO / "configs/maptr/maptr_r18_minicity.py")
    parser = ArgumentParser()
    heads.add_arguments(parser)
    for checkpoint, name in (("a.pth", "first"), ("a.pth", "second"), ("b.pth", "third")):
        variants = tmp_path / f"{name}.json"
        variants.write_text(json.dumps({name: config}))
        words = [config, checkpoint, str(variants), "--out", str(tmp_path / "out")]
        args = parser.parse_args([*words, "--data-root", str(tmp_path)])
        if checkpoint == "a.pth":
            heads.run(args)
    with pytest.raises(ValueError, match="out holds features or figures of other settings"):
        heads.run(args)
    assert not (tmp_path / "out/third.settings.json").exists()
    assert heads.cells(figures) == ["- / -"] * 3 + ["50.0 / 50.0"]
