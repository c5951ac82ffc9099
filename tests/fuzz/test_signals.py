"""A part of ``python -m fuzz.signals``: what is left of a command after a signal."""

import pytest
from processes import REPO, run_python, search_path

pytestmark = pytest.mark.faults

ENDS = "Ctrl-C", "Ctrl-C twice", "kill", "kill -9", "terminal closed"


@pytest.mark.timeout(1800)  # five runs of a command
@pytest.mark.parametrize("command", ["check", "evaluate", "infer", "train, two ranks"])
def test_nothing_of_a_command_is_left_after_any_signal(
    command, minicity_root, minicity_annotations, tiny_config
):
    done = run_python(
        "-m", "fuzz.signals", "--data", minicity_root, tiny_config, "--command", command,
        "--end", *ENDS, "--limit", 300, env=search_path(REPO),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [line.count("nothing") for line in done.stdout.splitlines()[2:]] == [len(ENDS)]
