#!/usr/bin/env python
"""Start TensorBoard with TensorBoard's options: ``python tools/watch.py --logdir work_dirs``.

Plugins of other packages are left out. The plugin of open3d, which mmdet3d installs, makes the
usual command ``tensorboard`` fail on machines without libusb.
"""

# Imported before all libraries: this handles Ctrl-C during their imports, and keeps them from
# reading settings files in the working folder.
import gsmap  # noqa: F401

# isort: split
from absl import app
from tensorboard import default, main_lib, program
from tensorboard.plugins.base_plugin import FlagsError

from gsmap.utils.cli import run_command
from gsmap.utils.errors import InputError


def main() -> None:
    # As in TensorBoard's command, except for the plugins: only its static ones.
    main_lib.global_init()
    board = program.TensorBoard(plugins=default.get_static_plugins())
    try:
        app.run(board.main, flags_parser=board.configure)  # parses the options of the command line
    except FlagsError as error:
        raise InputError(str(error)) from error


if __name__ == "__main__":
    run_command(main, clean_up_on_kill=False)  # TensorBoard handles `kill` itself
