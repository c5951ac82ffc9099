"""A part of ``python -m fuzz.signals``: what is left of a command after a signal."""

import os

import pytest
from processes import REPO, run_python

ENDS = "Ctrl-C", "Ctrl-C twice", "kill", "kill -9", "terminal closed"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("commands", "ends"), [(["check", "evaluate", "infer"], ENDS), (["train, two ranks"], ENDS[1:])]
)
def test_nothing_of_a_command_is_left_after_any_signal(
    commands, ends, minicity_root, minicity_annotations, tiny_config
):
    paths = [str(REPO), str(REPO / "tests"), os.environ.get("PYTHONPATH", "")]
    done = run_python(
        "-m", "fuzz.signals", "--data", minicity_root, tiny_config, "--command", *commands,
        "--end", *ends, env={"PYTHONPATH": os.pathsep.join(paths)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [line.count("nothing") for line in done.stdout.splitlines()[2:]] == [
        len(ends) for _ in commands
    ]
