"""Point clouds in files, one per sweep: PCD, PLY, LAS, LAZ, NPZ and plain binary."""
