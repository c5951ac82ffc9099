"""Matching of samples, AP_chamfer and AP_raster, reports, and result files."""
