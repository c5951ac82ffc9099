"""Rename a checkpoint between the format of the earlier systems and ours, whichever it is in."""

import argparse
import os
import sys
import tempfile
from pathlib import Path

import torch

from gsmap.checkpoints.convert import convert_state, read_state


def parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, help="checkpoint to read")
    parser.add_argument("target", type=Path, help="checkpoint to write; must not exist")
    return parser.parse_args()


def save_atomically(checkpoint: dict, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    os.close(handle)
    try:
        torch.save(checkpoint, temporary)
        os.replace(temporary, target)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def main() -> None:
    args = parse_args()
    if not args.source.is_file():
        sys.exit(f"{args.source} does not exist.")
    if args.target.exists():
        sys.exit(f"{args.target} exists already: choose another name or remove it.")
    try:
        state, done = convert_state(read_state(args.source))
    except ValueError as error:
        sys.exit(f"{args.source}: {error}")
    save_atomically({"state_dict": state, "meta": {"converted": done}}, args.target)
    print(f"{done}, {len(state)} tensors, {args.target}")


if __name__ == "__main__":
    main()
