#!/usr/bin/env python
"""Write a page about a result file, with figures, curves and frames, or film a drive.

Examples:
    python tools/report.py results.json --ann gsmap_nuscenes_val.arrow --out report.html
    python tools/report.py gsmap.json --compare maptr.json --names GSMap MapTR --ann val.arrow
    python tools/report.py results.json --ann val.arrow --scene scene-0003 --out drive.mp4
"""

import argparse
from pathlib import Path

from gsmap.evaluation.analysis.calibration import LAWS
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.visualization.film import write_drive_film
from gsmap.visualization.page.page import PageOptions, is_own_page, page_data, write_page

_PAGE = Path("report.html")  # page to write without --out
_PAGE_SUFFIXES = (".html", ".htm")
_FILM_SUFFIX = ".mp4"
# Width of a page's images without --image-width. The option has no default, so that a film, to
# which it does not apply, can refuse it.
_IMAGE_WIDTH_PX = 320


def parse_args() -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, help="results in MapTR's JSON form")
    parser.add_argument("--ann", type=Path, required=True, help="annotation file (*.arrow)")
    parser.add_argument(
        "--out",
        type=output_file,
        default=_PAGE,
        help="page to write (default: report.html), or a film (*.mp4) of one drive",
    )
    parser.add_argument(
        "--compare", type=Path, metavar="RESULTS", help="second result file, shown beside the first"
    )
    parser.add_argument("--names", nargs="+", help="a name for each result file")
    parser.add_argument(
        "--data-root", type=Path, help="root of the image paths; default: folder of --ann"
    )
    parser.add_argument("--max-frames", type=int, default=200, help="largest number of frames")
    parser.add_argument(
        "--score-thr",
        type=float,
        default=0.4,
        help="least score of the elements that are drawn; a page has a slider to change it",
    )
    parser.add_argument(
        "--image-width",
        type=int,
        help="largest width of a page's images in pixels (320); doubled for the camera ahead",
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
        help="add a table of AP of each part of the data, as --by of tools/evaluate.py",
    )
    parser.add_argument(
        "--allow-other-split",
        action="store_true",
        help="accept models of another training split, although places of --ann may be in it",
    )
    parser.add_argument(
        "--law",
        choices=LAWS,
        help="distribution of the errors (default: the one of the model's calibration, or normal)",
    )
    parser.add_argument(
        "--changes", type=Path, help="changes of the map (tools/build_map.py --changes), for a page"
    )
    parser.add_argument("--scene", help="drive of a film; default: the first one of --ann")
    args = parser.parse_args()
    suffix = args.out.suffix.lower()
    if suffix not in (*_PAGE_SUFFIXES, _FILM_SUFFIX):
        names = " or ".join([*_PAGE_SUFFIXES, _FILM_SUFFIX])
        parser.error(f"--out {args.out}: give a name that ends with {names}")
    is_film = suffix == _FILM_SUFFIX
    if is_film and (args.by or args.allow_mismatch or args.image_width is not None):
        parser.error("--by, --allow-mismatch and --image-width apply to pages: leave them out")
    if is_film and (args.allow_other_split or args.law or args.changes):
        parser.error("--allow-other-split, --law and --changes apply to pages: leave them out")
    if args.no_images and args.image_width is not None:
        parser.error("--image-width is for images, and --no-images leaves them out: give one")
    if args.scene and not is_film:
        parser.error(
            "--scene applies to films: give --out NAME.mp4; a page has a field for the scene"
        )
    return args


def main() -> str:
    """Write the page or the film, and return a summary, which `run_command` prints."""
    # Whether another program has written the default page. The file is read before `parse_args`:
    # from then on, an output must not be read, because it could also be an input by mistake.
    is_foreign = _PAGE.exists() and not is_own_page(_PAGE)
    args = parse_args()
    # Without --out, `args.out` is the object `_PAGE` itself, the default. A user who gives the name
    # of a page with --out may replace a file of another program.
    if args.out is _PAGE and is_foreign:
        raise FileExistsError(f"{_PAGE} exists and is no page of this command: give --out PAGE.")
    paths = [args.results]
    if args.compare:
        paths.append(args.compare)
    # By default, a result file is named FOLDER/NAME, without its suffix.
    names = args.names or [f"{path.resolve().parent.name}/{path.stem}" for path in paths]
    if len(names) != len(paths) or len(set(names)) != len(names):
        raise InputError(f"--names must give {len(paths)} different names, got {names}.")
    results = dict(zip(names, paths, strict=True))
    if args.no_images:
        image_width_px = 0  # leaves the images of a page out
    elif args.image_width is not None:
        image_width_px = args.image_width
    else:
        image_width_px = _IMAGE_WIDTH_PX
    if args.out.suffix.lower() == _FILM_SUFFIX:
        return write_drive_film(
            args.out,
            annotations=args.ann,
            results=results,
            scene=args.scene,
            data_root=args.data_root,
            score_thr=args.score_thr,
            images=not args.no_images,
            max_frames=args.max_frames,
        )
    options = PageOptions(
        data_root=args.data_root,
        max_frames=args.max_frames,
        score_thr=args.score_thr,
        image_width=image_width_px,
        allow_mismatch=args.allow_mismatch,
        by=args.by,
        allow_other_split=args.allow_other_split,
        law=args.law,
        changes=args.changes,
    )
    data = page_data(args.ann, results, options)
    return write_page(args.out, data)


if __name__ == "__main__":
    run_command(main)
