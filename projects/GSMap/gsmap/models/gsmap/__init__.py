"""GSMap: elements as ordered Gaussians, supervised as polylines and as masks."""
