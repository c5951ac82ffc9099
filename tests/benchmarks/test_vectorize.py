"""The timing of vectorising."""

from argparse import Namespace

import pytest
import torch

from benchmarks import vectorize
from gsmap.apis.map_inferencer import MapInferencer

CONFIG = "configs/hdmapnet/hdmapnet_r18_minicity.py"


def test_all_frames_but_the_first_are_timed_in_both_sizes(minicity_annotations, tmp_path, capsys):
    model = MapInferencer(CONFIG, device="cpu").model
    model.map_head.decoder.maps[0][-1].bias.data[0] = 100  # all is background: noise takes longest
    checkpoint = tmp_path / "random.pth"
    torch.save(model.state_dict(), checkpoint)
    truth = minicity_annotations["val"]
    args = Namespace(config=CONFIG, checkpoint=checkpoint, truth=truth, data_root=None, samples=0)
    with pytest.raises(ValueError, match="leave no frame after the first one: give two samples"):
        vectorize.run(args)
    args.samples = 1
    vectorize.run(args)
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[-3:] if line]
    assert [row[:2] for row in rows] == [["| 100 x 200", "1"], ["| 200 x 400", "1"]]
    assert all(float(row[2]) > 0 for row in rows)
