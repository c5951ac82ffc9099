"""What may be wrong with a single sample's files."""


class BrokenSampleError(ValueError):
    """A sample cannot be used because one of its files is missing, damaged or empty.

    The data set raises it on, or skips and counts the sample, as its option ``broken_samples``
    says.
    """
