#!/usr/bin/env python
"""Watch runs in TensorBoard: ``python tools/watch.py --logdir work_dirs``; the options are its own.

The plugins of other packages are left out: open3d's, which mmdet3d brings, ends the usual command
on machines without libusb.
"""

import sys

from absl import app
from tensorboard import default, main_lib, program
from tensorboard.plugins.base_plugin import FlagsError


def main() -> None:
    main_lib.global_init()
    board = program.TensorBoard(plugins=default.get_static_plugins())
    try:
        app.run(board.main, flags_parser=board.configure)
    except FlagsError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
