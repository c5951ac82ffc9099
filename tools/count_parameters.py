"""Print the parameters of a config's model by module; papers count the trainable ones."""

import argparse

from mmdet3d.registry import MODELS

from gsmap.checkpoints.parameters import count_parameters
from gsmap.engine.launch import read_config


def parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", help="config file")
    parser.add_argument("--depth", type=int, default=2, help="levels of modules to list")
    return parser.parse_args()


def main() -> None:
    args = parse_args()
    counts = count_parameters(MODELS.build(read_config(args.config).model), args.depth)
    width = max(len(count.module) for count in counts)
    print(f"{'module'.ljust(width)}  {'all':>12}  {'trainable':>12}")
    for count in counts:
        name = count.module or "model"
        print(f"{name.ljust(width)}  {count.total:>12,}  {count.trainable:>12,}")


if __name__ == "__main__":
    main()
