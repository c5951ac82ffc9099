"""Rules between the state keys of an earlier system and ours, read in both directions."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

_NUMBER = "{i}"
Rules = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class KeyMap:
    """How the keys of one upstream architecture correspond to ours.

    Attributes:
        name: Name of the architecture.
        rules: Pairs of key prefixes (upstream's, ours); ``{i}`` stands for a number, the same on
            both sides, in order. The first that fits wins.
        unused: Upstream keys without a counterpart, whatever the rules say, and what upstream
            expects there, for conversion back; None where only some of its models hold the key.
        markers: Pairs of key prefixes (upstream's, ours) that, all present, tell this architecture
            from those of the methods that it is built on.
        idle: Pattern of further upstream keys without a counterpart, which conversion back leaves
            out.
        sign: What some keys of its release begin with, and none of ours.
    """

    name: str
    rules: Rules
    unused: Mapping[str, Tensor | None] = field(default_factory=dict)
    markers: Rules = (("", ""),)
    idle: str = "(?!)"
    sign: str = "pts_bbox_head."

    def is_marked(self, keys: Collection[str], upstream: bool) -> bool:
        """Return whether keys, upstream's or ours, tell this architecture."""
        patterns = [_pattern(pair[0 if upstream else 1]) for pair in self.markers]
        return all(any(pattern.match(key) for key in keys) for pattern in patterns)

    def is_unused(self, key: str) -> bool:
        """Return whether an upstream key has no counterpart."""
        return key in self.unused or re.match(self.idle, key) is not None

    def to_ours(self, key: str) -> str | None:
        """Return our name of an upstream key, or None if there is none."""
        return None if self.is_unused(key) else _rename(key, self.rules)

    def to_upstream(self, key: str) -> str | None:
        """Return upstream's name of one of our keys, or None if there is none."""
        return _rename(key, tuple((ours, upstream) for upstream, ours in self.rules))


def _pattern(template: str) -> re.Pattern[str]:
    """Compile a key prefix in which ``{i}`` stands for a number."""
    return re.compile(r"(\d+)".join(re.escape(part) for part in template.split(_NUMBER)))


def _rename(key: str, rules: Rules) -> str | None:
    """Replace the prefix of ``key`` by the first rule that fits."""
    for source, target in rules:
        if match := _pattern(source).match(key):
            for number in match.groups():
                target = target.replace(_NUMBER, number, 1)
            return target + key[match.end() :]
    return None


def rules_of(upstream: str, ours: str, names: str) -> Rules:
    """Return rules for several names.

    Args:
        upstream: What upstream's keys begin with.
        ours: What our keys begin with.
        names: What follows, with blanks between: ``theirs=ours``, or one for both.
    """
    pairs = (name.partition("=") for name in names.split())
    return tuple((upstream + theirs, ours + (own or theirs)) for theirs, _, own in pairs)


def zeros(prefix: str, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Return zeros for parameters without effect on any output; they take no memory."""
    return {prefix + key: torch.zeros(()).expand(shape) for key, shape in shapes.items()}
