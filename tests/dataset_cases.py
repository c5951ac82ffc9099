"""Configs of data sets, made to read the generated MiniCity."""

from pathlib import Path

from mmengine.config import Config

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
MINICITY = "_base_/datasets/minicity"
DEPTH_AND_MASKS = "maptrv2/maptrv2_r50_24e"
SWEEPS = "maptr/maptr_r50_pointpillars_24e"


def dataset_config(name: str, loader: str, root: Path, **changes) -> dict:
    config = Config.fromfile(CONFIGS / f"{name}.py")[loader].dataset
    config.update(data_root=str(root), ann_file=config.ann_file.replace("nuscenes", "minicity"))
    config.update(changes)
    return config
