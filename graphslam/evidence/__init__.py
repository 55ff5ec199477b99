"""Evidence grids: log-odds maps of occupied and free space that copy in constant time (SegSLAM, section 2)."""
