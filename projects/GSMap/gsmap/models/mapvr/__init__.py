"""MapVR (arXiv 2306.10502): points supervised by their soft rasters."""
