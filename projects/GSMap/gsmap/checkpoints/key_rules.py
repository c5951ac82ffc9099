"""Rules that rename the state keys of upstream code to the keys of this project, and back.

"Upstream" is the code that the authors of a model published. A state key is the name of a tensor in
the weights of a model, such as ``img_backbone.conv1.weight``.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

_NUMBER = "{i}"  # placeholder of a number in a key prefix
Rules = tuple[tuple[str, str], ...]  # pairs of key prefixes, (upstream, here)


@dataclass(frozen=True)
class KeyMap:
    """Correspondence between the keys of an upstream architecture and of this project.

    Attributes:
        name: Name of the architecture.
        rules: Key prefixes in pairs (upstream, here). ``{i}`` stands for a number; the numbers
            of both sides are equal and in equal order. The first rule that matches is applied.
        unused: Upstream keys without a counterpart here, with the values that conversion to
            upstream's format writes. The value None means that only some upstream models have the
            key, so it is not written. These keys take precedence over ``rules``.
        markers: Key prefixes in pairs (upstream, here). If a key with each prefix is present, the
            keys belong to this architecture, not to one that it is built on. The empty prefix of
            the default is present in every key.
        ignored_pattern: Regular expression for the start of further upstream keys without a
            counterpart. Conversion to upstream's format does not write them. The default matches
            nothing.
        upstream_prefix: Prefix that only keys in upstream's format have. It identifies the format.
    """

    name: str
    rules: Rules
    unused: Mapping[str, Tensor | None] = field(default_factory=dict)
    markers: Rules = (("", ""),)
    ignored_pattern: str = "(?!)"
    upstream_prefix: str = "pts_bbox_head."

    def is_marked(self, keys: Collection[str], upstream: bool) -> bool:
        """Whether each marker of this architecture is the prefix of a state key.

        Args:
            keys: State keys.
            upstream: Whether the keys have upstream's format.
        """
        for upstream_marker, our_marker in self.markers:
            pattern = _pattern(upstream_marker if upstream else our_marker)
            if not any(pattern.match(key) for key in keys):
                return False
        return True

    def is_unused(self, key: str) -> bool:
        """Whether an upstream key has no counterpart."""
        return key in self.unused or re.match(self.ignored_pattern, key) is not None

    def to_ours(self, key: str) -> str | None:
        """Key of this project for an upstream key, or None if it has no counterpart."""
        return None if self.is_unused(key) else _rename(key, rules=self.rules)

    def to_upstream(self, key: str) -> str | None:
        """Upstream key for a key of this project, or None if no rule matches."""
        reversed_rules = []
        for upstream, ours in self.rules:
            reversed_rules.append((ours, upstream))
        return _rename(key, rules=tuple(reversed_rules))


def _pattern(template: str) -> re.Pattern[str]:
    """Compile a key prefix in which ``{i}`` stands for a number."""
    literals = map(re.escape, template.split(_NUMBER))
    return re.compile(r"(\d+)".join(literals))


def _rename(key: str, rules: Rules) -> str | None:
    """Replace the prefix of a key by the first rule that matches; None if no rule matches."""
    for old_prefix, new_template in rules:
        match = _pattern(old_prefix).match(key)
        if match is not None:
            new_prefix = new_template
            for number in match.groups():
                new_prefix = new_prefix.replace(_NUMBER, number, 1)
            return new_prefix + key[match.end() :]
    return None


def rules_of(upstream: str, ours: str, names: str) -> Rules:
    """Make rules for several keys with common prefixes.

    Args:
        upstream: Prefix of upstream's keys.
        ours: Prefix of the keys of this project.
        names: Continuations of both prefixes, separated by blanks. Each is ``theirs=ours``, or one
            name if both are equal. A continuation may itself be the prefix of several keys.

    Returns:
        Pairs of key prefixes (upstream, here), in the order of ``names``.
    """
    rules: list[tuple[str, str]] = []
    for name in names.split():
        their_name, _, our_name = name.partition("=")  # `our_name` is empty without "="
        rules.append((upstream + their_name, ours + (our_name or their_name)))
    return tuple(rules)


def zeros(prefix: str, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Make zeros for parameters that have no effect on any output.

    Each tensor is expanded from one value, so it takes almost no memory.

    Args:
        prefix: Prefix of the keys.
        shapes: Shapes by the remainder of the key.

    Returns:
        Tensors by complete key, for ``KeyMap.unused``. They must not be changed in place.
    """
    return {prefix + key: torch.zeros(()).expand(shape) for key, shape in shapes.items()}
