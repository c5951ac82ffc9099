"""Samples that a prior was made of.

A model that is tested on these samples reads its own predictions, or their ground truth, in the
prior, so the figures of the test are too good.
"""

import hashlib
from collections.abc import Iterable

DIGEST_BYTES = 8
"""Size of the digest of a token in a file."""
MOST_SOURCES = 1_000_000
"""Largest number of samples that are stored; later ones are not."""


class PriorSources:
    """Samples that a prior was made of, as digests of their tokens.

    Args:
        content: Digests of ``DIGEST_BYTES`` bytes each, as `to_bytes` returns them.
    """

    def __init__(self, content: bytes = b"") -> None:
        starts = range(0, len(content), DIGEST_BYTES)
        self._digests = {content[start : start + DIGEST_BYTES] for start in starts}

    def __len__(self) -> int:
        return len(self._digests)

    def add(self, token: str) -> None:
        """Add a sample by its token. An empty token is unknown, and is left out."""
        if token and len(self._digests) < MOST_SOURCES:
            self._digests.add(_digest(token))

    def count(self, tokens: Iterable[str]) -> int:
        """Count the samples, given by their tokens, that the prior was made of."""
        return sum(_digest(token) in self._digests for token in tokens)

    def to_bytes(self) -> bytes:
        """Digests for a file, sorted, so that equal priors give equal files."""
        return b"".join(sorted(self._digests))


def _digest(token: str) -> bytes:
    return hashlib.blake2b(token.encode(), digest_size=DIGEST_BYTES).digest()
