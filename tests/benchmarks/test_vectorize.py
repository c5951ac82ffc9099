"""The timing of vectorising."""

from argparse import Namespace

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
    vectorize.run(
        Namespace(config=CONFIG, checkpoint=checkpoint, truth=truth, data_root=None, samples=1)
    )
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[-3:] if line]
    assert [row[:2] for row in rows] == [["| 100 x 200", "1"], ["| 200 x 400", "1"]]
    assert all(float(row[2]) > 0 for row in rows)
