"""AP_chamfer and AP_raster."""
