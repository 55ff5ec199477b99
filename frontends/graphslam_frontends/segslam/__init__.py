"""SegSLAM: a particle filter over path segments, each with its own submap, which may be re-entered."""
