"""What every command shares: how its words are read, and how it ends."""

import argparse
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain, takewhile
from typing import Any

BAD_INPUT = 2  # exit code, as argparse's for bad arguments
_LISTS = ("?", "*", "+")


class CommandParser(argparse.ArgumentParser):
    """A parser whose lists leave the positional arguments alone.

    argparse lets ``--eval chamfer raster CONFIG`` swallow ``CONFIG``. Here a list ends before a
    word that it cannot take (by its choices, its type, or a ``=`` in its metavar), and gives back
    its last words if positional arguments would be missing.
    """

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> Any:
        """Parse as argparse does, after a rearrangement with the positional arguments first."""
        words = list(sys.argv[1:] if args is None else args)
        return super().parse_known_args(self._positionals_first(words), namespace)

    def _positionals_first(self, words: list[str]) -> list[str]:
        """Rearrange the words, or leave them as they are if that would not help."""
        if self._subparsers is not None or "--" in words:
            return words
        groups: list[list[str]] = [[]]  # each but the first: an option and what follows it
        for word in words:
            if re.match(r"-(?!\.?\d|$)", word):
                groups.append([])
            groups[-1].append(word)
        actions = [self._option(group[0]) for group in groups[1:]]
        taken = [_taken(*pair) for pair in zip(actions, groups[1:], strict=True)]
        fixed = [action.nargs for action in self._get_positional_actions()]
        needed = sum(n if isinstance(n, int) else n in (None, "+") for n in fixed)
        free = len(words) - sum(taken)
        for i in reversed(range(len(taken))):
            if actions[i] is not None and actions[i].nargs in _LISTS and free < needed:
                given = min(needed - free, taken[i] - 1 - (actions[i].nargs == "+"))
                taken[i], free = taken[i] - given, free + given
        if free > needed and not set(_LISTS) & set(fixed):
            return words  # too many: argparse says it best
        rest = [group[n:] for group, n in zip(groups, [0, *taken], strict=True)]
        kept = [group[:n] for group, n in zip(groups[1:], taken, strict=True)]
        return list(chain(*rest, *kept))

    def _option(self, word: str) -> Any:
        """Find an option by its name or by how that begins; None for what it is not."""
        options = self._option_string_actions
        if word in options:
            return options[word]
        found = {id(action): action for name, action in options.items() if name.startswith(word)}
        return next(iter(found.values())) if len(found) == 1 else None


def _taken(action: Any, group: list[str]) -> int:
    """Count the words of a group that belong to its option, with the option itself."""
    if action is None:
        return 1 if "=" in group[0] else len(group)
    if action.nargs not in _LISTS:
        return min(len(group), 2 if action.nargs is None else 1 + action.nargs)
    values = group[1:2] if action.nargs == "?" else group[1:]
    return 1 + sum(1 for _ in takewhile(partial(_fits, action), values))


def _fits(action: argparse.Action, word: str) -> bool:
    """Whether a list may take a word."""
    if "=" in str(action.metavar) and "=" not in word:
        return False
    try:
        value = action.type(word) if callable(action.type) else word
    except (argparse.ArgumentTypeError, ValueError, TypeError):
        return False
    return action.choices is None or value in action.choices


def is_first_rank() -> bool:
    """Whether this process speaks for a run; known before the processes have met."""
    return os.environ.get("RANK", os.environ.get("SLURM_PROCID", "0")) == "0"


def run_command(command: Callable[[], str | None], heed_kill: bool = True) -> None:
    """Run a command, print what it reports, and leave in words whatever a user can cause.

    A file that cannot be read, understood or written, and whatever a ``raise`` statement says, end
    with ``error: ...`` and exit code 2; Ctrl-C with one line and 130; ``kill`` with 143; each after
    the clean-up of half-written files. A slip in the code keeps its traceback.

    Args:
        command: Returns what to print, or None.
        heed_kill: Whether ``kill`` lets the clean-up run; processes that wait for each other had
            better die at once.

    Raises:
        SystemExit: If the command fails or is interrupted.
    """
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # as in a shell's background
        signal.signal(signal.SIGINT, partial(_interrupt, os.getpid()))
    if heed_kill:
        signal.signal(signal.SIGTERM, _leave)
    try:
        report = command()
    except KeyboardInterrupt:
        if is_first_rank():
            sys.stderr.write("interrupted: nothing half-written is left\n")
        if "RANK" in os.environ and not heed_kill:
            sys.stderr.flush()
            os._exit(128 + signal.SIGINT)  # the interpreter's own end would wait for other ranks
        sys.exit(128 + signal.SIGINT)
    except (OSError, ValueError, TypeError, KeyError, RuntimeError) as error:
        if not _is_for_the_user(error):
            raise
        # a KeyError's own text is its message in quotes
        text = error.args[0] if type(error) is KeyError else error
        sys.stderr.write(f"error: {' '.join(str(text).split())}\n")
        sys.exit(BAD_INPUT)
    if report is not None:
        sys.stdout.write(f"{report}\n")


def _interrupt(main: int, _number: int, _frame: object) -> None:
    """Answer Ctrl-C in the command's own process; forked workers inherit this, and end with it."""
    if os.getpid() == main:
        raise KeyboardInterrupt


def _leave(number: int, _frame: object) -> None:
    """Leave through the clean-up of half-written files, as Ctrl-C does."""
    sys.exit(128 + number)


def _is_for_the_user(error: Exception) -> bool:
    """Whether the system, a parser or a ``raise`` statement speaks, and not Python of a slip."""
    parsing = isinstance(error, ValueError) and type(error) is not ValueError
    if parsing or isinstance(error, OSError):
        return True
    in_worker = type(error.__cause__).__name__ == "_RemoteTraceback"
    frames = [str(error.__cause__)] if in_worker else traceback.format_tb(error.__traceback__)
    statements = re.findall(r'^  File ".*\n    (.*)', "".join(frames), re.MULTILINE)
    return bool(statements) and statements[-1].startswith("raise ")
