"""Map heads."""
