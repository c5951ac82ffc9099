"""The subcommands ``fps`` and ``step``; the models are imported only when one of them runs."""

import argparse


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommands ``fps`` and ``step``."""
    fps = subparsers.add_parser("fps", help="frames per second of whole models, batch 1")
    step = subparsers.add_parser("step", help="time and memory of a training step")
    for parser in (fps, step):
        parser.add_argument("configs", nargs="+", help="ratios are to the first of them")
        parser.add_argument("--size", type=int, nargs=2, default=(480, 800), metavar=("H", "W"))
        parser.add_argument("--device", default="cpu", help="cpu or cuda")
        parser.add_argument("--threads", type=int, default=2)
        parser.add_argument("--repeats", type=int, default=5)
        parser.add_argument("--fp16", action="store_true", help="mixed precision")
        parser.set_defaults(run=_run, subcommand=parser.prog.rsplit(" ", 1)[-1])
    step.add_argument("--batch", type=int, default=1)
    step.add_argument(
        "--rasters", nargs="+", default=["200x100"], metavar="HxW", help="of GSMap's loss"
    )


def _run(args: argparse.Namespace) -> None:
    """Run a subcommand."""
    from benchmarks import model

    {"fps": model.run_fps, "step": model.run_step}[args.subcommand](args)
