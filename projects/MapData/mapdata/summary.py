"""Summary of a conversion: counts of samples and map elements, and omissions."""

from collections import Counter, defaultdict
from dataclasses import dataclass, field

from gsmap.datasets.annotations.record import MapSample

_EXAMPLES = 3  # largest number of examples that the summary names for each reason


@dataclass
class ConversionSummary:
    """Summary of one conversion, printed at its end.

    Args:
        classes: Classes of map elements, in label order.
        samples: Number of samples by split.
        instances: Number of map elements by class.
        problems: Number of omissions (samples or map elements that are left out) by their reason.
            Samples without any map element are counted here as well, although they are kept.
        examples: The first few omissions, such as tokens of samples, by their reason.
        notes: Further lines of the summary.
    """

    classes: tuple[str, ...]
    samples: Counter[str] = field(default_factory=Counter)
    instances: Counter[str] = field(default_factory=Counter)
    problems: Counter[str] = field(default_factory=Counter)
    examples: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    notes: list[str] = field(default_factory=list)

    def add_sample(self, split: str, sample: MapSample) -> None:
        """Count a sample of an annotation file, and its map elements.

        ``sample.instances`` is None for a sample without ground truth, and empty for ground truth
        without any element.
        """
        self.samples[split] += 1
        for instance in sample.instances or []:
            self.instances[self.classes[instance.label]] += 1
        if sample.instances is not None and not sample.instances:
            self.add_problem("sample without any map element in range (kept)", sample.token)

    def add_problem(self, reason: str, where: str, count: int = 1) -> None:
        """Count an omission.

        Args:
            reason: Description of the kind of omission.
            where: Name of the omission, such as a token; the first few are listed as examples.
            count: Number of omissions under this name.
        """
        self.problems[reason] += count
        if len(self.examples[reason]) < _EXAMPLES:
            self.examples[reason].append(where)

    def text(self) -> str:
        """Summary as lines for a terminal."""
        samples = ", ".join(f"{split} {count}" for split, count in self.samples.items()) or "none"
        counts = ", ".join(f"{name} {self.instances[name]}" for name in self.classes)
        lines = [f"samples: {samples}", f"map elements: {counts}"]
        for reason, count in self.problems.most_common():
            lines.append(f"{count:>7} x {reason}, for example {', '.join(self.examples[reason])}")
        return "\n".join(lines + self.notes)
