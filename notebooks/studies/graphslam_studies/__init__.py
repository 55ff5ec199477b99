"""Monte-Carlo studies of graphslam, and the worlds, readers, baselines and figures that only they use.

It plugs in by entry points (:mod:`graphslam.core.plugins`), and nothing in graphslam imports it.
"""
