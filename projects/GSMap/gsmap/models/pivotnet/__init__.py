"""PivotNet (arXiv 2308.16477): elements as their pivots, of any number."""
