"""MapQR: instance queries that scatter to their points and gather what these see."""
