"""Monte-Carlo studies of graphslam, and the worlds, readers, baselines and plots that only they use.

It is registered by entry points (:mod:`graphslam.core.plugins`), and nothing in graphslam imports it.
"""
