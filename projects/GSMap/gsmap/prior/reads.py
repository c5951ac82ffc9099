"""Counts of the samples that a prior has been read at."""

from dataclasses import dataclass


@dataclass
class PriorReads:
    """Counts of the samples that a prior has been read at.

    A prior whose global frame differs from that of the poses raises no error: it has nothing near
    the samples. These counts show it.

    Attributes:
        samples: Number of samples.
        empty: Number of those with nothing of the prior in their range.
    """

    samples: int = 0
    empty: int = 0

    def add(self, is_empty: bool) -> None:
        """Count one more sample.

        Args:
            is_empty: Whether the prior has nothing in the range of the sample.
        """
        self.samples += 1
        self.empty += is_empty
