"""Maps of whole drives: merging of frames, scores against the true map, files for other tools."""
