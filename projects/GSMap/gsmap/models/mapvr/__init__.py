"""MapVR (arXiv 2306.10502): points supervised through their soft rasters."""
