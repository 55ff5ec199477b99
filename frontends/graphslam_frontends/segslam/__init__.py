"""SegSLAM: particles over segments of the path, each with a submap of its own, that may be entered again."""
