"""Lines of classes that have queries of their own, with masks: what PivotNet and BeMapNet share."""
