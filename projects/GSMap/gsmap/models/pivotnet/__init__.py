"""PivotNet (arXiv 2308.16477), which predicts elements as a variable number of pivots."""
