"""Learning targets: occupancy, surface samples, signed distances."""
