#!/usr/bin/env python
"""Write a page about a result file: figures, curves and frames in one HTML file.

Examples:
    python tools/report.py results.json --ann gsmap_nuscenes_val.arrow --out report.html
    python tools/report.py gsmap.json --compare maptr.json --names GSMap MapTR --ann val.arrow
"""

import argparse
from pathlib import Path

from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.visualization.page.page import PageOptions, page_data, write_page


def parse_args() -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, help="results in MapTR's JSON form")
    parser.add_argument("--ann", type=Path, required=True, help="annotation file (*.arrow)")
    parser.add_argument(
        "--out", type=output_file, default=Path("report.html"), help="page to write"
    )
    parser.add_argument(
        "--compare", type=Path, metavar="RESULTS", help="second result file, shown beside the first"
    )
    parser.add_argument("--names", nargs="+", help="a name for each result file")
    parser.add_argument(
        "--data-root", type=Path, help="root of the image paths; default: folder of --ann"
    )
    parser.add_argument("--max-frames", type=int, default=200, help="largest number of frames")
    parser.add_argument("--score-thr", type=float, default=0.4, help="initial score of the slider")
    parser.add_argument(
        "--image-width",
        type=int,
        default=320,
        help="largest width of images in pixels; of the camera ahead twice that",
    )
    parser.add_argument("--no-images", action="store_true", help="leave the camera images out")
    parser.add_argument(
        "--allow-mismatch",
        action="store_true",
        help="samples without results count as empty, results without ground truth are left out",
    )
    parser.add_argument(
        "--by",
        metavar="map|scene|distance|FILE",
        help="a table of AP by parts, as of tools/evaluate.py",
    )
    return parser.parse_args()


def main() -> str:
    args = parse_args()
    paths = [args.results, *([args.compare] if args.compare else [])]
    names = args.names or [f"{path.resolve().parent.name}/{path.stem}" for path in paths]
    if len(names) != len(paths) or len(set(names)) != len(names):
        raise ValueError(f"--names must give {len(paths)} different names, got {names}.")
    options = PageOptions(
        args.data_root,
        args.max_frames,
        args.score_thr,
        0 if args.no_images else args.image_width,
        args.allow_mismatch,
        args.by,
    )
    data = page_data(args.ann, dict(zip(names, paths, strict=True)), options)
    return write_page(args.out, data)


if __name__ == "__main__":
    run_command(main)
