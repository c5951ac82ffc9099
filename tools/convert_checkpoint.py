"""Convert a checkpoint of a method's original repository to the format of GSMap, or back."""

from pathlib import Path

from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write


def main() -> str:
    """Convert the checkpoint, and return a summary for the user."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("source", type=Path, help="checkpoint to read")
    parser.add_argument("target", type=output_file, help="checkpoint to write; must not exist")
    args = parser.parse_args()
    if args.target.exists():
        raise FileExistsError(f"{args.target} exists already: choose another name or remove it.")
    # Torch is slow to import, so the arguments are checked first.
    import torch

    from gsmap.checkpoints.convert import convert_state
    from gsmap.checkpoints.reading import read_weights

    weights = read_weights(args.source)
    try:
        # The keys of the weights show which of the two formats they have.
        state, summary = convert_state(weights)
    except ValueError as error:
        raise InputError(f"{args.source}: {error}") from error
    with atomic_write(args.target, "wb") as file:
        torch.save({"state_dict": state, "meta": {"converted": summary}}, file)
    return f"{summary}, {len(state)} tensors, {args.target}"


if __name__ == "__main__":
    run_command(main)
