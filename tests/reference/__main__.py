"""Recompute a folder of reference outputs of the earlier systems with our models."""

import argparse
import sys
from pathlib import Path

from reference.golden import Golden
from reference.registry import plan, run_checks
from reference.report import format_table

REPO = Path(__file__).resolve().parents[2]


def parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("golden_dir", type=Path, help="folder of the reference files")
    parser.add_argument("--variant", default="A", help="suffix of the variant's files")
    parser.add_argument("--seed", default="A", help="seed string of weights and inputs")
    parser.add_argument("--recipes", type=Path, help="folder of the recipes, if not GOLDEN_DIR")
    parser.add_argument("--only", default="*", help="pattern of file names to recompute")
    return parser.parse_args()


def main() -> int:
    args = parse_args()
    inside = args.golden_dir / "models"
    folder = inside if inside.is_dir() else args.golden_dir
    if not folder.is_dir():
        sys.exit(f"{folder} is no folder.")
    golden = Golden(folder, REPO / "configs", args.variant, args.seed, args.recipes)
    rows = list(run_checks(golden, args.only))
    print(format_table(rows))
    for name in plan(golden)[1]:
        print(f"{name}: not compared, no check is registered for it")
    missed = sum(not row.passed for row in rows)
    print(f"{len(rows) - missed} of {len(rows)} quantities agree")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
