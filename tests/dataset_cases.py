"""Configs of data sets, made to read the generated MiniCity."""

from pathlib import Path

from method_cases import cases_of_methods
from mmengine.config import Config

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
MINICITY = "_base_/datasets/minicity"
DEPTH_AND_MASKS = next(iter(cases_of_methods("DEPTH_AND_MASKS").values()), "")
SWEEPS = "maptr/maptr_r50_pointpillars_24e"


def dataset_config(name: str, loader: str, root: Path, **changes) -> dict:
    config = Config.fromfile(CONFIGS / f"{name}.py")[loader].dataset
    config.update(data_root=str(root), ann_file=config.ann_file.replace("nuscenes", "minicity"))
    config.update(changes)
    return config
