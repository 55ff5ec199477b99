"""Graphs of satellite navigation: pseudoranges, odometer, inertial start."""
